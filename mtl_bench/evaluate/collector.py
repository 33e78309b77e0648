"""Adds up predictions, batch by batch, into metrics, the protocol that made them and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core import config
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import LabelSet
from mtl_bench.tasks.depth import protocols
from mtl_bench.tasks.depth.errors import DepthErrors, evaluation_mask, median_scale
from mtl_bench.tasks.depth.protocols import Protocol
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.iou import SemanticIoU
from mtl_bench.tasks.panoptic.quality import PanopticQuality
from mtl_bench.tasks.panoptic.targets import class_of_instance_id

PICTURES = 4  # frames kept for the report, at fixed places of the split
FLIP = "inverse depth is the mean with that of the mirrored image, mirrored back"

Size = tuple[int, int]  # height, width
Picture = dict[str, Any]  # a frame and its maps [H,W,...]


@dataclass
class Evaluation:
    """What an evaluation hands on: numbers, how they were made, and frames to look at."""

    metrics: dict[str, float]  # flat and dotted; undefined ones (no such class or pixel) are absent
    protocol: dict[str, Any]
    samples: dict[str, Any] = field(default_factory=dict)  # names, and arrays [n,H,W,...]; the
    # same with keys `extremes.*` for the worst and the best frame, with their `pq`


@dataclass
class Prediction:
    """One batch's predictions, at the size asked for; what the cell's tasks lack is None."""

    class_BHW: Tensor | None = None
    instance_ids_BHW: Tensor | None = None  # Cityscapes' ids, int32
    depth_B1HW: Tensor | None = None  # unscaled
    dgc_scale_B: Tensor | None = None
    dgc_source_B: Tensor | None = None  # index into postprocess.DGC_SOURCES


class DepthScore:
    """The depth errors of one protocol over its frames."""

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.errors = {scaling: DepthErrors(protocol) for scaling in protocol.scalings}
        self.sources = np.zeros(len(postprocess.DGC_SOURCES), np.int64)
        self.scale_ratios: list[float] = []  # dgc over median
        self.frames = 0
        self.sizes: dict[Size, None] = {}  # of the truth, in the order of their appearance

    def update(self, depth_HW: NDArray, true_m_HW: NDArray, dgc: float, source: int) -> float:
        """Add an image; returns the ratio of medians, 1 without truth."""
        self.frames += 1
        self.sizes[true_m_HW.shape[0], true_m_HW.shape[1]] = None
        mask_HW = evaluation_mask(true_m_HW, self.protocol)
        ratio = median_scale(depth_HW, true_m_HW, mask_HW) if mask_HW.any() else 1.0
        self.errors["median"].update(depth_HW * ratio, true_m_HW)
        if "dgc" in self.errors:
            self.sources[source] += 1
            if source != postprocess.FAILED:
                self.errors["dgc"].update(depth_HW * dgc, true_m_HW)
                if mask_HW.any():
                    self.scale_ratios.append(dgc / ratio)
        return ratio

    def metrics(self) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for scaling, errors in self.errors.items():
            metrics |= _flat(f"depth_{scaling}", errors.compute())
        metrics["depth.without_truth"] = self.errors["median"].without_truth
        if "dgc" in self.errors:
            metrics["dgc.failed"] = int(self.sources[postprocess.FAILED])
            metrics["dgc.fallback"] = int(self.sources[postprocess.NORMALS])
            if self.scale_ratios:
                metrics["dgc.to_median"] = float(np.mean(self.scale_ratios))
                metrics["dgc.to_median_sd"] = float(np.std(self.scale_ratios))
        return metrics

    def record(self) -> dict[str, Any]:
        """What a row keeps of the protocol and of the frames that it met."""
        return {**self.protocol.record(), "frames": self.frames, "compared_at": _one(self.sizes)}


def add_depth(
    scores: Sequence[DepthScore], batch: Batch, prediction: Prediction, slot: int
) -> tuple[NDArray, NDArray, float]:
    """Add one frame to every score; its depth and truth [H,W], the first one's ratio of medians."""
    true_m_HW = _array(batch.depth_m_BHW, slot, batch)
    depth_HW = _array(prediction.depth_B1HW, slot, batch)[0]
    assert prediction.dgc_source_B is not None
    assert prediction.dgc_scale_B is not None
    dgc, source = float(prediction.dgc_scale_B[slot]), int(prediction.dgc_source_B[slot])
    ratios = [score.update(depth_HW, true_m_HW, dgc, source) for score in scores]
    return depth_HW, true_m_HW, ratios[0]


class Collector:
    """Adds up the main pass over a split.

    Args:
        total: frames of the split.
        measured: protocols of this pass, the cell's main one first; None: that one alone.
    """

    def __init__(
        self,
        cell: config.Cell,
        labels: LabelSet,
        total: int,
        measured: Sequence[Protocol] | None = None,
    ) -> None:
        self.cell, self.labels, self.total = cell, labels, total
        self.quality, self.iou = PanopticQuality(labels), SemanticIoU(labels)
        measured = measured or protocols.of_cell(cell)[:1]
        self.scores = [DepthScore(protocol) for protocol in measured]
        self.seen = self.with_panoptic_truth = 0
        self.input: Size = (0, 0)
        self.sizes: dict[Size, None] = {}
        self.pictured = set(np.linspace(0, total - 1, min(PICTURES, total)).round().astype(int))
        self.samples: list[Picture] = []
        self.extremes: list[Picture] = []  # ordered by pq

    def update(self, batch: Batch, prediction: Prediction) -> None:
        """Compare one batch; the frames' order is the split's."""
        rows, columns = batch.image_B3HW.shape[2:]
        self.input = (rows, columns)
        self.sizes[true_size(batch)] = None
        for slot, name in enumerate(batch.names):
            picture: Picture = {"names": name, "image": _picture(batch, slot)}
            if prediction.instance_ids_BHW is not None:
                picture |= self._panoptic(batch, prediction, slot)
            if prediction.depth_B1HW is not None:
                picture |= self._depth(batch, prediction, slot)
            pq = picture.pop("pq", float("nan"))
            if self.seen in self.pictured:
                self.samples.append(picture)
            if not np.isnan(pq):
                self.extremes = _outermost([*self.extremes, {**picture, "pq": pq}])
            self.seen += 1

    def _panoptic(self, batch: Batch, prediction: Prediction, slot: int) -> Picture:
        predicted_HW = _array(prediction.instance_ids_BHW, slot, batch)
        if batch.instance_ids_BHW is None:
            return {"instance_ids": predicted_HW}
        self.with_panoptic_truth += 1
        true_HW = _array(batch.instance_ids_BHW, slot, batch)
        pq = self.quality.update(predicted_HW, true_HW).pq
        true_class_HW = class_of_instance_id(self.labels)[true_HW]
        self.iou.update(_array(prediction.class_BHW, slot, batch), true_class_HW)
        return {"instance_ids": predicted_HW, "true_instance_ids": true_HW, "pq": pq}

    def _depth(self, batch: Batch, prediction: Prediction, slot: int) -> Picture:
        depth_HW, true_m_HW, ratio = add_depth(self.scores, batch, prediction, slot)
        farthest_m = self.scores[0].protocol.max_depth_m
        scaled_m_HW = (depth_HW * ratio).clip(0, farthest_m).astype(np.float16)
        return {"depth_m": scaled_m_HW, "true_depth_m": true_m_HW}

    # --- results ----------------------------------------------------------------------------------

    def result(
        self, split: str, device: torch.device, further: Sequence[DepthScore] = ()
    ) -> Evaluation:
        """Everything seen so far as one evaluation.

        Args:
            further: scores of other passes. Their metrics' keys begin with their protocols' names,
                as do those of this pass's further protocols.
        """
        metrics: dict[str, float] = {}
        if self.with_panoptic_truth:
            metrics |= _flat("panoptic", self.quality.compute())
            metrics |= _flat("semantic", self.iou.compute())
        also = [*self.scores[1:], *further]
        if "depth" in self.cell.tasks:
            metrics |= self.scores[0].metrics()
            for score in also:
                name = score.protocol.name
                metrics |= {f"{name}.{key}": value for key, value in score.metrics().items()}
        samples = _stacked(self.samples)
        samples |= {f"extremes.{key}": value for key, value in _stacked(self.extremes).items()}
        protocol = self._protocol(split, device)
        if also:
            protocol["also"] = {score.protocol.name: score.record() for score in also}
        return Evaluation(metrics, protocol, samples)

    def _protocol(self, split: str, device: torch.device) -> dict[str, Any]:
        ev, main = self.cell.recipe.evaluate, self.scores[0].protocol
        protocol: dict[str, Any] = {
            "name": main.title,
            "dataset": self.cell.recipe.data.dataset,
            "split": split,
            "frames": self.seen,
            "published_frames": main.frames_published,
            "input": list(self.input),
            "compared_at": _one(self.sizes),
            "engine": "eager",
            "precision": "fp32",
            "device": device.type,
            "ignored_classes": [label.name for label in self.labels.labels if not label.evaluated],
        }
        if "panoptic" in self.cell.tasks:
            protocol |= {
                "panoptic_rules": "cityscapesscripts; ignored classes are void",
                "panoptic_truth": self._panoptic_truth(),
                "center_threshold": ev.center_threshold,
                "nms_kernel": ev.nms_kernel,
                "top_k": ev.top_k,
                "stuff_area": ev.stuff_area,
            }
        if "depth" in self.cell.tasks:
            protocol |= {
                "depth_source": main.source,
                "depth_truth": main.truth,
                "depth_range_m": [main.min_depth_m, main.max_depth_m],
                "depth_crop": main.depth_crop,
                "depth_scalings": list(main.scalings),
                "depth_pixels": "where the truth has a value; predicted sky and ego vehicle count",
                "depth_mean": "over images; those whose dgc failed are counted, not averaged",
                "depth_flip": FLIP if ev.flip else "none",
                "dgc_ground": "predicted road" if "panoptic" in self.cell.tasks else "normals",
            }
        return protocol

    def _panoptic_truth(self) -> str:
        if not self.with_panoptic_truth:
            return "none in this split: no panoptic metrics"
        return f"{self.with_panoptic_truth} of {self.seen} frames"


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


def _outermost(pictures: list[Picture]) -> list[Picture]:
    """The worst and the best of them, ordered."""
    ordered = sorted(pictures, key=lambda picture: picture["pq"])
    return [ordered[0], ordered[-1]] if len(ordered) > 2 else ordered


def _stacked(pictures: list[Picture]) -> dict[str, Any]:
    """What all have, key by key: lists of names and numbers, arrays of one size."""
    keys = [key for key in (pictures or [{}])[0] if all(key in picture for picture in pictures)]
    columns = {key: [picture[key] for picture in pictures] for key in keys}
    plain = ("names", "pq")
    return {k: v if k in plain else np.stack(_of_one_size(v)) for k, v in columns.items()}


def _of_one_size(pictures: list[NDArray]) -> list[NDArray]:
    """All at the first one's size: KITTI's frames differ by some pixels, a report's must not."""
    height, width = pictures[0].shape[:2]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    return [p[rows * p.shape[0] // height, columns * p.shape[1] // width] for p in pictures]


def _one(sizes: dict[Size, None]) -> list:
    """The size, or all of them where frames differ."""
    found = [list(size) for size in sizes]
    return found[0] if len(found) == 1 else found


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
