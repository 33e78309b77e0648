"""The video stage's labels: what a trained model predicts on frames that no human labelled.

Naive-Student's idea (Chen et al., ECCV 2020) as MGNet uses it: predictions averaged over scales and
mirror images, grouped into instances, written in Cityscapes' format (`pseudo_frames`) with a record
of what made them, `<out>/pseudo_labels.json`. For KITTI, which has no human labels, a model trained
on Cityscapes labels the training frames.

Departures from MGNet's public code: small stuff segments stay (a small pole is still a pole), and
human labels are neither copied nor touched. Shapes: B frames, C classes, H x W pixels.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.plain import to_dict
from mtl_bench.data.cityscapes_files import read_image
from mtl_bench.data.kitti import to_size
from mtl_bench.data.kitti_files import RECORD
from mtl_bench.data.labels import IGNORE, LabelSet, labels_of
from mtl_bench.data.layouts import KITTI, layout_of
from mtl_bench.evaluate.pseudo_frames import Frames, Size, frames_of, write
from mtl_bench.evaluate.walk import Progress, evaluating
from mtl_bench.model import Model, Outputs
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.targets import DIVISOR

PIXELS = 2**18  # of the input images that go through the network at once; one frame at least
GROUPING = ("center_threshold", "nms_kernel", "top_k")  # what of config.Evaluate labels depend on


class Maps(NamedTuple):
    """The panoptic outputs, averaged: probabilities in place of logits."""

    probability_BCHW: Tensor
    center_B1HW: Tensor
    offset_B2HW: Tensor


def ensure(
    model: Model,
    cell: config.Cell,
    root: Path,
    out: Path | None,
    device: torch.device,
    progress: Progress | None = None,
    split: str = "train",
) -> Path:
    """Label a split's frames: in Cityscapes' layout those of the sequences that have both
    neighbours and no human label.

    Stopped and called again it goes on, and on the CPU ends with the same bytes.

    Args:
        cell: `recipe.pseudo` says how to predict, `recipe.evaluate` how to group pixels.
        out: a new or empty folder, or one that such a call began; None: KITTI's own.
        progress: told how many frames have labels, at the start and after each.

    Returns:
        Of Cityscapes, the folder that `open_dataset` takes as `sequence_labels`; of KITTI, `out`.

    Raises:
        ValueError: a cell without the panoptic task, options without meaning, no frame to label,
            an `out` with human labels or labels of another making, a prediction that is not finite.
    """
    _check(cell, root)
    labels = labels_of(cell.recipe.data.dataset)
    frames = frames_of(root, out, split, cell.recipe)
    _claim_folder(frames, _record(model, cell, frames, labels))

    done = frames.done()
    count = len(done)
    if progress:
        progress(count, len(frames.names))
    with evaluating(model), torch.inference_mode():
        for name, maps in _predictions(model, cell, frames, done, device):
            frames.write(name, instance_ids(maps, cell, labels)[0])
            count += 1
            if progress:
                progress(count, len(frames.names))
    return frames.folder


def _check(cell: config.Cell, root: Path) -> None:
    if "panoptic" not in cell.tasks:
        raise ValueError(f"cell {cell.slug} has no panoptic task: it cannot make pseudo labels")
    if cell.video and layout_of(root) == KITTI:
        raise ValueError(
            "video is for Cityscapes' sequences: KITTI's labels are pseudo labels already; "
            "set video=false"
        )
    options = cell.recipe.pseudo
    if not options.scales or min(options.scales) <= 0:
        raise ValueError(f"pseudo.scales must be positive numbers, not {list(options.scales)}")
    if not 0 <= options.min_confidence <= 1:
        raise ValueError(f"pseudo.min_confidence must be 0 to 1, not {options.min_confidence}")


# --- prediction -----------------------------------------------------------------------------------


def pass_sizes(recipe: config.Recipe, size: Size | None = None) -> list[Size]:
    """Input sizes of the passes: the recipe's (or another), scaled, to the nearest that the network
    divides."""
    stride = recipe.network.strides[-1]

    def scaled(length: int, scale: float) -> int:
        return max(round(length * scale / stride), 1) * stride

    height, width = size or (recipe.data.height, recipe.data.width)
    return [(scaled(height, scale), scaled(width, scale)) for scale in recipe.pseudo.scales]


def average(
    net: Callable[[Tensor], Outputs], image_B3HW: Tensor, sizes: list[Size], flip: bool
) -> Maps:
    """Means over passes at these sizes and, with `flip`, of the mirrored image; at its own size."""
    passes = [(size, mirrored) for size in sizes for mirrored in (False, True)[: 1 + flip]]
    sums = _one_pass(net, image_B3HW, *passes[0])
    for size, mirrored in passes[1:]:
        parts = _one_pass(net, image_B3HW, size, mirrored)
        sums = Maps(*(total + part for total, part in zip(sums, parts, strict=True)))
    return Maps(*(total / len(passes) for total in sums))


def _one_pass(
    net: Callable[[Tensor], Outputs], image_B3HW: Tensor, size: Size, mirrored: bool
) -> Maps:
    """The image seen at another size, as augmentation resizes, or mirrored; turned back."""
    height, width = image_B3HW.shape[2:]
    if size != (height, width):
        image_B3HW = F.interpolate(image_B3HW, size, mode="bilinear", antialias=True)
    outputs = net(image_B3HW.flip(-1) if mirrored else image_B3HW)
    assert outputs.semantic_BCHW is not None
    assert outputs.center_B1HW is not None
    assert outputs.offset_B2HW is not None
    probability_BCHW = outputs.semantic_BCHW.float().softmax(1)
    maps = Maps(probability_BCHW, outputs.center_B1HW, outputs.offset_B2HW)
    if mirrored:
        maps = Maps(*(x.flip(-1) for x in maps))
        y_B1HW, x_B1HW = maps.offset_B2HW.split(1, 1)
        maps = maps._replace(offset_B2HW=torch.cat([y_B1HW, -x_B1HW], 1))
    return _resized(maps, (height, width))


def _resized(maps: Maps, size: Size) -> Maps:
    if maps.center_B1HW.shape[2:] == size:
        return maps
    outputs = postprocess.resize(Outputs(*maps), *size)
    return Maps(outputs.semantic_BCHW, outputs.center_B1HW, outputs.offset_B2HW)  # type: ignore[arg-type]


def instance_ids(maps: Maps, cell: config.Cell, labels: LabelSet) -> NDArray[np.uint16]:
    """Cityscapes' ids [B,H,W].

    Thing pixels of a frame without a center keep the bare label id (crowd); pixels less certain
    than `pseudo.min_confidence` get 0 and no vote. Unlike `postprocess.to_instance_ids`, classes
    that are trained but not evaluated are written: the ego vehicle masks the reprojection.
    """
    confidence_BHW, class_BHW = maps.probability_BCHW.max(1)
    panoptic_BHW = postprocess.panoptic(
        class_BHW.masked_fill(confidence_BHW < cell.recipe.pseudo.min_confidence, IGNORE),
        maps.center_B1HW,
        maps.offset_B2HW,
        labels.things,
        replace(cell.recipe.evaluate, stuff_area=0),
    )
    panoptic = panoptic_BHW.cpu().numpy()
    void = panoptic == postprocess.VOID
    label_id_of_class = labels.label_id_of_class().astype(int)
    label_ids = label_id_of_class[np.where(void, IGNORE, panoptic // DIVISOR)]
    number = np.where(void, 0, panoptic % DIVISOR)
    return np.where(number > 0, label_ids * DIVISOR + number, label_ids).astype(np.uint16)


def _predictions(
    model: Model,
    cell: config.Cell,
    frames: Frames,
    done: set[str],
    device: torch.device,
) -> Iterator[tuple[str, Maps]]:
    """Predictions for the frames that are not done, one by one at their own size.

    Batches are cut from all the frames, not from those that are left: a frame's last bits may
    depend on its batch.
    """
    flip = cell.recipe.pseudo.flip
    batches = (
        (group.names[start : start + count], group.size)
        for group in frames.groups()
        for count in [max(1, PIXELS // (group.size[0] * group.size[1]))]
        for start in range(0, len(group.names), count)
    )
    for batch, size in batches:
        if done.issuperset(batch):
            continue
        images = [read_image(frames.image(name)) for name in batch]
        image_B3HW = torch.stack([_to_input(image, size) for image in images]).to(device)
        maps = average(model.net, image_B3HW.float() / 255, pass_sizes(cell.recipe, size), flip)
        if not all(x.isfinite().all() for x in maps):
            raise ValueError(f"the prediction is not finite in a frame of {batch}")
        for slot, (name, image) in enumerate(zip(batch, images, strict=True)):
            if name not in done:
                yield name, _resized(Maps(*(x[slot : slot + 1] for x in maps)), image.shape[:2])


def _to_input(image_HW3: NDArray[np.uint8], size: Size) -> Tensor:
    """[3,H,W] at the input's size, as the reader resizes frames."""
    return torch.from_numpy(to_size(image_HW3, *size, cv2.INTER_AREA)).permute(2, 0, 1)


# --- files ----------------------------------------------------------------------------------------


def _record(
    model: nn.Module, cell: config.Cell, frames: Frames, labels: LabelSet
) -> dict[str, Any]:
    """What the labels depend on; no paths, as folders move."""
    recipe = cell.recipe
    weights = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        weights.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        weights.update(tensor.cpu().contiguous().flatten().view(torch.uint8).numpy())
    record = {"protocol": config.PROTOCOL, "weights": weights.hexdigest(), "labels": labels.name}
    record |= frames.record()
    if isinstance(record["input"], list):
        record["passes"] = [list(size) for size in pass_sizes(recipe, tuple(record["input"]))]
    return {
        **record,
        **to_dict(recipe.pseudo),
        **{key: getattr(recipe.evaluate, key) for key in GROUPING},
    }


def _claim_folder(frames: Frames, record: dict[str, Any]) -> None:
    """Write the record into a fresh folder, or compare with the one that is there.

    Raises:
        ValueError: labels of another or of unknown making are there.
    """
    out, path = frames.out, frames.out / RECORD
    if path.is_file():
        try:
            there = json.loads(path.read_text())
        except ValueError as error:
            raise ValueError(f"{path} is damaged ({error}); choose another --out") from error
        other = [key for key in record if there.get(key) != record[key]]
        if other:
            raise ValueError(
                f"{out} holds pseudo labels that were made with other {', '.join(other)}; choose "
                f"another --out, or delete that folder"
            )
        return
    unknown = frames.stranger()
    if unknown:
        raise ValueError(f"{unknown} is not of this command's making; choose another --out")
    write(path, json.dumps(record, indent=1).encode() + b"\n")
