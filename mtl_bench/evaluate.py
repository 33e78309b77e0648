"""A model on a split -> metrics, their protocol and a few pictures. Never trains, never picks.

Predictions are compared at the size of the ground truth. Depth errors are always reported twice:
`depth_median` scales each image by the ratio of medians (it looks at the truth), `depth_dgc` by the
camera's height above the predicted road (it does not).
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench import config, postprocess
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.data.targets import class_of_instance_id
from mtl_bench.geometry import depth_from_inverse
from mtl_bench.metrics.depth import DepthErrors, evaluation_mask, median_scale
from mtl_bench.metrics.panoptic import PanopticQuality
from mtl_bench.metrics.semantic import SemanticIoU
from mtl_bench.model import Model

PICTURES = 4  # frames kept for the report

Progress = Callable[[int, int], None]  # frames done, frames in all


@dataclass
class Evaluation:
    """What an evaluation hands on: numbers, how they were made, and frames to look at."""

    metrics: dict[str, float]  # flat and dotted; undefined ones (no such class or pixel) are absent
    protocol: dict[str, Any]
    samples: dict[str, Any] = field(default_factory=dict)  # names, and arrays [n,H,W,...]


@dataclass
class Prediction:
    """One batch's predictions, at the size asked for; what the cell's tasks lack is None."""

    class_BHW: Tensor | None = None
    instance_ids_BHW: Tensor | None = None  # Cityscapes' ids, int32
    depth_B1HW: Tensor | None = None  # unscaled
    dgc_scale_B: Tensor | None = None
    dgc_source_B: Tensor | None = None  # index into postprocess.DGC_SOURCES


def evaluate(
    model: Model,
    cell: config.Cell,
    root: Path,
    device: torch.device,
    split: str | None = None,
    batch_size: int = 8,
    progress: Progress | None = None,
    labels: LabelSet = CITYSCAPES20,
) -> Evaluation:
    """Evaluate in float32 on a split (None: the recipe's).

    Raises:
        ValueError: a split without ground truth, or a prediction that is not finite.
    """
    split = split or cell.recipe.evaluate.split
    dataset = open_dataset(cell, split, root, training=False)
    collector = Collector(cell, labels, total=len(dataset))
    with evaluating(model), torch.inference_mode():
        for batch in eval_batches(dataset, batch_size):
            batch = batch.to(device)
            collector.update(batch, predict(model, batch, cell, labels, true_size(batch)))
            if progress:
                progress(collector.seen, len(dataset))
    return collector.result(split, device)


def predict(
    model: Model, batch: Batch, cell: config.Cell, labels: LabelSet, size: tuple[int, int]
) -> Prediction:
    """Run the network and the post-processing; the depth's scale is found at the input's size."""
    outputs = model.net(batch.image_B3HW)
    result = Prediction()
    road_BHW = None
    if "panoptic" in cell.tasks:
        road_BHW = outputs.semantic_BCHW.argmax(1) == labels.index("road")
    if "depth" in cell.tasks:
        depth_B1HW = depth_from_inverse(outputs.inverse_depth[0].float())
        if not depth_B1HW.isfinite().all():
            raise ValueError(f"the predicted depth is not finite in a frame of {batch.names}")
        result.dgc_scale_B, result.dgc_source_B = postprocess.dgc_scale(
            depth_B1HW,
            batch.K_B33,
            batch.camera_height_m_B,
            road_BHW,
            pitch_rad_B=batch.camera_pitch_rad_B,
        )
    if size != tuple(batch.image_B3HW.shape[2:]):
        outputs = postprocess.resize(outputs, *size)
    if "depth" in cell.tasks:
        result.depth_B1HW = depth_from_inverse(outputs.inverse_depth[0].float())
    if "panoptic" in cell.tasks:
        result.class_BHW = outputs.semantic_BCHW.argmax(1)
        panoptic_BHW = postprocess.panoptic(
            result.class_BHW,
            outputs.center_B1HW,
            outputs.offset_B2HW,
            labels.things,
            cell.recipe.evaluate,
        )
        result.instance_ids_BHW = postprocess.to_instance_ids(panoptic_BHW, labels)
    return result


class Collector:
    """Adds up batches of predictions into the metrics, the protocol and the pictures."""

    def __init__(self, cell: config.Cell, labels: LabelSet, total: int) -> None:
        self.cell, self.labels, self.total = cell, labels, total
        self.quality, self.iou = PanopticQuality(labels), SemanticIoU(labels)
        ev = cell.recipe.evaluate
        self.depth = {"depth_median": DepthErrors(ev), "depth_dgc": DepthErrors(ev)}
        self.sources = np.zeros(len(postprocess.DGC_SOURCES), np.int64)
        self.scale_ratios: list[float] = []  # dgc over median
        self.seen = 0
        self.sizes: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (0, 0))
        self.pictured = set(np.linspace(0, total - 1, min(PICTURES, total)).round().astype(int))
        self.samples: dict[str, list] = {}

    def update(self, batch: Batch, prediction: Prediction) -> None:
        """Compare one batch; the frames' order is the split's."""
        rows, columns = batch.image_B3HW.shape[2:]
        self.sizes = ((rows, columns), true_size(batch))
        for slot, name in enumerate(batch.names):
            picture = {"names": name, "image": _picture(batch, slot)}
            if prediction.instance_ids_BHW is not None:
                picture |= self._panoptic(batch, prediction, slot)
            if prediction.depth_B1HW is not None:
                picture |= self._depth(batch, prediction, slot)
            if self.seen in self.pictured:
                for key, value in picture.items():
                    self.samples.setdefault(key, []).append(value)
            self.seen += 1

    def _panoptic(self, batch: Batch, prediction: Prediction, slot: int) -> dict[str, NDArray]:
        true_HW = _array(batch.instance_ids_BHW, slot, batch)
        predicted_HW = _array(prediction.instance_ids_BHW, slot, batch)
        self.quality.update(predicted_HW, true_HW)
        true_class_HW = class_of_instance_id(self.labels)[true_HW]
        self.iou.update(_array(prediction.class_BHW, slot, batch), true_class_HW)
        return {"instance_ids": predicted_HW, "true_instance_ids": true_HW}

    def _depth(self, batch: Batch, prediction: Prediction, slot: int) -> dict[str, NDArray]:
        ev = self.cell.recipe.evaluate
        true_m_HW = _array(batch.depth_m_BHW, slot, batch)
        depth_HW = _array(prediction.depth_B1HW, slot, batch)[0]
        mask_HW = evaluation_mask(true_m_HW, ev)
        ratio = median_scale(depth_HW, true_m_HW, mask_HW) if mask_HW.any() else 1.0
        self.depth["depth_median"].update(depth_HW * ratio, true_m_HW)

        assert prediction.dgc_source_B is not None
        assert prediction.dgc_scale_B is not None
        source = int(prediction.dgc_source_B[slot])
        self.sources[source] += 1
        if source != postprocess.FAILED:
            scale = float(prediction.dgc_scale_B[slot])
            self.depth["depth_dgc"].update(depth_HW * scale, true_m_HW)
            if mask_HW.any():
                self.scale_ratios.append(scale / ratio)
        scaled_m_HW = (depth_HW * ratio).clip(0, ev.max_depth_m)
        return {"depth_m": scaled_m_HW.astype(np.float16), "true_depth_m": true_m_HW}

    def result(self, split: str, device: torch.device) -> Evaluation:
        """Everything seen so far as one evaluation."""
        metrics: dict[str, float] = {}
        if "panoptic" in self.cell.tasks:
            metrics |= _flat("panoptic", self.quality.compute())
            metrics |= _flat("semantic", self.iou.compute())
        if "depth" in self.cell.tasks:
            for name, errors in self.depth.items():
                metrics |= _flat(name, errors.compute())
            metrics["depth.without_truth"] = self.depth["depth_median"].without_truth
            metrics["dgc.failed"] = int(self.sources[postprocess.FAILED])
            metrics["dgc.fallback"] = int(self.sources[postprocess.NORMALS])
            if self.scale_ratios:
                metrics["dgc.to_median"] = float(np.mean(self.scale_ratios))
                metrics["dgc.to_median_sd"] = float(np.std(self.scale_ratios))
        samples = {
            key: values if key == "names" else np.stack(values)
            for key, values in self.samples.items()
        }
        return Evaluation(metrics, self._protocol(split, device), samples)

    def _protocol(self, split: str, device: torch.device) -> dict[str, Any]:
        ev = self.cell.recipe.evaluate
        input_size, true_size = self.sizes
        protocol: dict[str, Any] = {
            "dataset": self.cell.recipe.data.dataset,
            "split": split,
            "frames": self.seen,
            "input": list(input_size),
            "compared_at": list(true_size),
            "engine": "eager",
            "precision": "fp32",
            "device": device.type,
            "ignored_classes": [label.name for label in self.labels.labels if not label.evaluated],
        }
        if "panoptic" in self.cell.tasks:
            protocol |= {
                "panoptic_rules": "cityscapesscripts; ignored classes are void",
                "center_threshold": ev.center_threshold,
                "nms_kernel": ev.nms_kernel,
                "top_k": ev.top_k,
                "stuff_area": ev.stuff_area,
            }
        if "depth" in self.cell.tasks:
            protocol |= {
                "depth_range_m": [ev.min_depth_m, ev.max_depth_m],
                "depth_crop": ev.depth_crop,
                "depth_scalings": ["median", "dgc"],
                "depth_pixels": "where the truth has a value; predicted sky and ego vehicle count",
                "depth_mean": "over images; those whose dgc failed are counted, not averaged",
                "dgc_ground": "predicted road" if "panoptic" in self.cell.tasks else "normals",
            }
        return protocol


@contextlib.contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Evaluation mode inside; every module's own mode as it was after."""
    modes = [(module, module.training) for module in model.modules()]
    model.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


def true_size(batch: Batch) -> tuple[int, int]:
    for truth in (batch.instance_ids_BHW, batch.depth_m_BHW):
        if truth is not None:
            return int(truth.shape[1]), int(truth.shape[2])
    raise ValueError(f"no ground truth for {batch.names[0]}: choose a split that has it")


def _array(value: Tensor | None, slot: int, batch: Batch) -> NDArray:
    if value is None:
        raise ValueError(f"no ground truth for {batch.names[slot]}: choose a split that has it")
    return value[slot].cpu().numpy()


def _picture(batch: Batch, slot: int) -> NDArray[np.uint8]:
    """The input image [H,W,3] at the size of the ground truth."""
    image = batch.image_B3HW[slot : slot + 1]
    if true_size(batch) != tuple(image.shape[2:]):
        image = F.interpolate(image, true_size(batch), mode="bilinear", align_corners=False)
    return (image[0] * 255).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy()


def _flat(prefix: str, values: dict) -> dict[str, float]:
    """Dotted keys: `per_class` becomes `<prefix>.class.<name>.<key>`; NaN is dropped."""
    flat: dict[str, float] = {}
    for key, value in values.items():
        if key == "per_class":
            for name, numbers in value.items():
                flat |= _flat(f"{prefix}.class.{name}", numbers)
        elif not np.isnan(value):
            flat[f"{prefix}.{key}"] = value
    return flat
