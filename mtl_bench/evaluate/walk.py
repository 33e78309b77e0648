"""A model on a split -> metrics, their protocol and a few pictures. Never trains, never picks.

Predictions are compared at the size of the ground truth, by the protocols that the recipe names.
Depth errors are reported twice: `depth_median` scales each image by the ratio of medians (it looks
at the truth), `depth_dgc` by the camera's height above the predicted road (it does not).
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.geometry import depth_from_inverse
from mtl_bench.data.batch import Batch
from mtl_bench.data.cityscapes import Cityscapes
from mtl_bench.data.labels import LabelSet, labels_of
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.evaluate.collector import (
    Collector,
    DepthScore,
    Evaluation,
    Prediction,
    add_depth,
    true_size,
)
from mtl_bench.model import Model, Outputs
from mtl_bench.tasks.depth import protocols
from mtl_bench.tasks.panoptic import postprocess

__all__ = ["Collector", "Evaluation", "Prediction", "Progress", "evaluate", "evaluating"]
__all__ += ["open_passes", "predict", "true_size"]

Progress = Callable[[int, int], None]  # frames done, frames in all


@dataclass(frozen=True)
class Pass:
    """One walk over a split."""

    measured: list[protocols.Protocol]
    cell: config.Cell  # with the tasks that are needed
    dataset: Cityscapes


def evaluate(
    model: Model,
    cell: config.Cell,
    root: Path,
    device: torch.device,
    split: str | None = None,
    batch_size: int = 8,
    progress: Progress | None = None,
    labels: LabelSet | None = None,
) -> Evaluation:
    """Evaluate in float32 by the recipe's protocols.

    Args:
        split: in place of the protocols' own.
        progress: told the frames done and in all, over all passes.
        labels: None: the data set's.

    Raises:
        ValueError: a split without ground truth, or a prediction that is not finite.
    """
    labels = labels or labels_of(cell.recipe.data.dataset)
    main, *others = open_passes(cell, root, split)
    done, total = 0, sum(len(each.dataset) for each in (main, *others))

    def predictions(each: Pass) -> Iterator[tuple[Batch, Prediction]]:
        nonlocal done
        for batch in eval_batches(each.dataset, batch_size):
            batch = batch.to(device)
            yield batch, predict(model, batch, each.cell, labels, true_size(batch))
            done += len(batch.names)
            if progress:
                progress(done, total)

    collector = Collector(cell, labels, len(main.dataset), main.measured)
    further: list[DepthScore] = []
    with evaluating(model), torch.inference_mode():
        for batch, prediction in predictions(main):
            collector.update(batch, prediction)
        for other in others:
            scores = [DepthScore(protocol) for protocol in other.measured]
            for batch, prediction in predictions(other):
                for slot in range(len(batch.names)):
                    add_depth(scores, batch, prediction, slot)
            further += scores
    return collector.result(main.measured[0].split, device, further)


def open_passes(cell: config.Cell, root: Path, split: str | None = None) -> list[Pass]:
    """The walks that a cell's evaluation takes, the main protocol's first; decodes nothing.

    Worth a call before training: it finds what would stop the evaluation after it.

    Raises:
        ValueError: a protocol that the data set cannot serve, or a split that lacks its files.
    """
    opened: list[Pass] = []
    for measured in protocols.passes(protocols.of_cell(cell, split)):
        own = cell
        if opened and not any("dgc" in protocol.scalings for protocol in measured):
            own = replace(cell, tasks=("depth",), single_task=False, video=False)  # no road needed
        first = measured[0]
        dataset = open_dataset(own, first.split, root, training=False, truth=first.truth)
        opened.append(Pass(measured, own, dataset))
    return opened


def predict(
    model: Model, batch: Batch, cell: config.Cell, labels: LabelSet, size: tuple[int, int]
) -> Prediction:
    """Run the network and the post-processing; the depth's scale is found at the input's size."""
    outputs = model.net(batch.image_B3HW)
    if "depth" in cell.tasks and cell.recipe.evaluate.flip:
        outputs = _flip_averaged(model, batch.image_B3HW, outputs)
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


def _flip_averaged(model: Model, image_B3HW: Tensor, outputs: Outputs) -> Outputs:
    """The finest inverse depth averaged with that of the mirrored image; all else as it is."""
    mirrored = model.net(image_B3HW.flip(-1)).inverse_depth[0].flip(-1)
    return replace(outputs, inverse_depth=[(outputs.inverse_depth[0] + mirrored) / 2])


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
