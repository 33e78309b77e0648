"""The video stage's labels: what a trained model predicts on frames that no human labelled.

Naive-Student's idea (Chen et al., ECCV 2020) as MGNet uses it: predictions averaged over scales and
mirror images, grouped into instances, written as the data set wants them with a record of what
made them, `<out>/pseudo_labels.json`. Where a data set has no human labels, a model that was
trained on another one labels the training frames.

Departures from MGNet's public code: small stuff segments stay (a small pole is still a pole), and
human labels are neither copied nor touched. Shapes: B frames, C classes, H x W pixels.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core.config import PROTOCOL
from mtl_bench.core.dataset import LabelFrames
from mtl_bench.core.files import read_json, write_json
from mtl_bench.core.labels import DIVISOR, IGNORE, LabelSet
from mtl_bench.core.plain import to_dict
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Maps, Size, Task
from mtl_bench.data import pictures, png
from mtl_bench.tasks.panoptic import grouping

RECORD = "pseudo_labels.json"
PIXELS = 2**18  # of the input images that go through the network at once; one frame at least
GROUPING = ("center_threshold", "nms_kernel", "top_k")  # what of config.Evaluate labels depend on


def label(
    task: Task,
    model: nn.Module,
    frames: LabelFrames,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Label frames.

    Stopped and called again it goes on, and on the CPU ends with the same bytes.

    Args:
        task: whose maps these are; of its recipe, `pseudo` says how to predict, `evaluate` how to
            group pixels.
        model: in evaluation mode.
        progress: told how many frames have labels, at the start and after each.

    Returns:
        The folder with the labels.

    Raises:
        ValueError: labels of another making, or a prediction that is not finite.
    """
    recipe = task.recipe
    _claim_folder(frames, _record(model, recipe, frames, task.labels))
    done = frames.done()
    count = len(done)
    if progress:
        progress(count, len(frames.names))
    with torch.inference_mode():
        for name, maps in _predictions(task, model, recipe, frames, done, device):
            frames.write(name, instance_ids(maps, recipe, task.labels)[0])
            count += 1
            if progress:
                progress(count, len(frames.names))
    return frames.folder


# --- prediction -----------------------------------------------------------------------------------


def pass_sizes(recipe: Recipe, size: Size | None = None) -> list[Size]:
    """Input sizes of the passes: the recipe's (or another), scaled, to the nearest that the network
    divides."""
    stride = recipe.network.strides[-1]

    def scaled(length: int, scale: float) -> int:
        return max(round(length * scale / stride), 1) * stride

    height, width = size or (recipe.data.height, recipe.data.width)
    return [(scaled(height, scale), scaled(width, scale)) for scale in recipe.pseudo.scales]


def average(task: Task, net: nn.Module, image_B3HW: Tensor, sizes: list[Size], flip: bool) -> Maps:
    """Means over passes at these sizes and, with `flip`, of the mirrored image; at its own size."""
    passes = [(size, mirrored) for size in sizes for mirrored in (False, True)[: 1 + flip]]
    sums = _one_pass(task, net, image_B3HW, *passes[0])
    for size, mirrored in passes[1:]:
        part = _one_pass(task, net, image_B3HW, size, mirrored)
        sums = {name: total + part[name] for name, total in sums.items()}
    return {name: total / len(passes) for name, total in sums.items()}


def _one_pass(task: Task, net: nn.Module, image_B3HW: Tensor, size: Size, mirrored: bool) -> Maps:
    """The image seen at another size, as augmentation resizes, or mirrored; turned back.

    "semantic" holds probabilities in place of logits.
    """
    own = (image_B3HW.shape[2], image_B3HW.shape[3])
    if size != own:
        image_B3HW = F.interpolate(image_B3HW, size, mode="bilinear", antialias=True)
    maps: Maps = net(image_B3HW.flip(-1) if mirrored else image_B3HW).maps[task.name]
    maps = maps | {"semantic": maps["semantic"].float().softmax(1)}
    if mirrored:
        maps = {name: map_.flip(-1) for name, map_ in maps.items()}
        y_B1HW, x_B1HW = maps["offset"].split(1, 1)
        maps["offset"] = torch.cat([y_B1HW, -x_B1HW], 1)
    return _resized(task, maps, own)


def _resized(task: Task, maps: Maps, size: Size) -> Maps:
    return maps if tuple(maps["center"].shape[2:]) == size else task.resized(maps, size)


def instance_ids(maps: Maps, recipe: Recipe, labels: LabelSet) -> NDArray[np.uint16]:
    """Cityscapes' ids [B,H,W].

    Thing pixels of a frame without a center keep the bare label id (crowd); pixels less certain
    than `pseudo.min_confidence` get 0 and no vote. Unlike `grouping.to_instance_ids`, classes that
    are trained but not evaluated are written: the ego vehicle masks the reprojection.
    """
    confidence_BHW, class_BHW = maps["semantic"].max(1)
    panoptic_BHW = grouping.panoptic(
        class_BHW.masked_fill(confidence_BHW < recipe.pseudo.min_confidence, IGNORE),
        maps["center"],
        maps["offset"],
        labels.things,
        replace(recipe.evaluate, stuff_area=0),
    )
    panoptic = panoptic_BHW.cpu().numpy()
    void = panoptic == grouping.VOID
    label_id_of_class = labels.label_id_of_class().astype(int)
    label_ids = label_id_of_class[np.where(void, IGNORE, panoptic // DIVISOR)]
    number = np.where(void, 0, panoptic % DIVISOR)
    return np.where(number > 0, label_ids * DIVISOR + number, label_ids).astype(np.uint16)


def _predictions(
    task: Task,
    model: nn.Module,
    recipe: Recipe,
    frames: LabelFrames,
    done: set[str],
    device: torch.device,
) -> Iterator[tuple[str, Maps]]:
    """Predictions for the frames that are not done, one by one at their own size.

    Batches are cut from all the frames, not from those that are left: a frame's last bits may
    depend on its batch.
    """
    flip = recipe.pseudo.flip
    batches = (
        (group.names[start : start + count], group.size)
        for group in frames.groups()
        for count in [max(1, PIXELS // (group.size[0] * group.size[1]))]
        for start in range(0, len(group.names), count)
    )
    for batch, size in batches:
        if done.issuperset(batch):
            continue
        images = [pictures.read(frames.image(name), bits=8) for name in batch]
        image_B3HW = torch.stack([_to_input(image, size) for image in images]).to(device)
        sizes = pass_sizes(recipe, size)
        maps = average(task, model.get_submodule("net"), image_B3HW.float() / 255, sizes, flip)
        if not all(map_.isfinite().all() for map_ in maps.values()):
            raise ValueError(f"the prediction is not finite in a frame of {batch}")
        for slot, (name, image) in enumerate(zip(batch, images, strict=True)):
            if name not in done:
                own = {key: map_[slot : slot + 1] for key, map_ in maps.items()}
                yield name, _resized(task, own, (image.shape[0], image.shape[1]))


def _to_input(image_HW3: NDArray[np.uint8], size: Size) -> Tensor:
    """[3,H,W] at the input's size, as the reader resizes frames."""
    return torch.from_numpy(png.to_size(image_HW3, *size, cv2.INTER_AREA)).permute(2, 0, 1)


# --- files ----------------------------------------------------------------------------------------


def _record(
    model: nn.Module, recipe: Recipe, frames: LabelFrames, labels: LabelSet
) -> dict[str, Any]:
    """What the labels depend on; no paths, as folders move."""
    weights = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        weights.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        weights.update(tensor.cpu().contiguous().flatten().view(torch.uint8).numpy())
    record = {"protocol": PROTOCOL, "weights": weights.hexdigest(), "labels": labels.name}
    record |= frames.record()
    if isinstance(record["input"], list):
        record["passes"] = [list(size) for size in pass_sizes(recipe, tuple(record["input"]))]
    return {
        **record,
        **to_dict(recipe.pseudo),
        **{key: getattr(recipe.evaluate, key) for key in GROUPING},
    }


def _claim_folder(frames: LabelFrames, record: dict[str, Any]) -> None:
    """Write the record into a fresh folder, or compare with the one that is there.

    Raises:
        ValueError: labels of another or of unknown making are there.
    """
    out, path = frames.out, frames.out / RECORD
    there = read_json(path)
    if there is not None:
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
    out.mkdir(parents=True, exist_ok=True)
    write_json(path, record)
