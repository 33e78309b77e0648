"""Which frames get pseudo labels, and how these lie on disk: one class a layout.

Cityscapes: frames of the sequences without human labels, into a folder of their own.

    <out>/gtFine/<split>/<city>/<name>_gtFine_labelIds.png      8 bits
    <out>/gtFine/<split>/<city>/<name>_gtFine_instanceIds.png   16 bits, written last: frame done

KITTI: the split's frames, beside their images. No class there is the ego vehicle: unlabeled.

    <out>/<date>/<drive>/label_02|03/data/<10 digits>.png       16 bits, Cityscapes' instance ids
"""

import hashlib
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.dataset import LabelGroup
from mtl_bench.core.files import is_litter, write_bytes
from mtl_bench.core.labels import DIVISOR
from mtl_bench.core.recipe import Recipe
from mtl_bench.data import cityscapes_files as files
from mtl_bench.data import kitti_files, kitti_splits, pictures, png
from mtl_bench.data.cityscapes_files import LABELS, SEQUENCE, Kind

LABEL_IDS = Kind("gtFine", "_gtFine_labelIds.png", "label map", 8)


class CityscapesFrames:
    """Frames of `leftImg8bit_sequence` that have both neighbours and no human label."""

    def __init__(self, root: Path, out: Path | None, split: str, recipe: Recipe) -> None:
        if out is None:
            raise ValueError("say where the labels go, --out DIR: a new or empty folder")
        self.source, self.out = root / SEQUENCE.folder / split, out
        self.folder = out / LABELS.folder / split
        self.size = (recipe.data.height, recipe.data.width)
        self.names = files.unlabelled_names(root, split, recipe.data.stride)
        if not self.names:
            raise ValueError(
                f"{self.source}: no frame without a human label that has both neighbours; unpack "
                f"{SEQUENCE.package}, or render the built-in scenes with recipe.data.frames="
                f"{2 * recipe.data.stride + 2} or more"
            )
        if self.folder.resolve().is_relative_to((root / LABELS.folder).resolve()):
            raise ValueError(f"{out}: the data set's own labels belong there; choose another --out")

    def groups(self) -> Iterator[LabelGroup]:
        yield LabelGroup(self.names, self.size)

    def image(self, name: str) -> Path:
        return files.file_of(self.source, SEQUENCE, name)

    def done(self) -> set[str]:
        return files.names_in(self.folder, LABELS).intersection(self.names)

    def stranger(self) -> Path | None:
        return _first(self.out.rglob("*_gtFine_*"))

    def record(self) -> dict[str, Any]:
        first = self.image(min(files.names_in(self.source, SEQUENCE)))
        return {
            "split": self.source.name,
            "first frame": hashlib.sha256(first.read_bytes()).hexdigest(),  # tells data sets apart
            "input": list(self.size),
        }

    def write(self, name: str, ids_HW: NDArray[np.uint16]) -> None:
        label_HW = np.where(ids_HW < DIVISOR, ids_HW, ids_HW // DIVISOR).astype(np.uint8)
        for kind, array in ((LABEL_IDS, label_HW), (LABELS, ids_HW)):
            _write(files.file_of(self.folder, kind, name), array)


class KittiFrames:
    """A split's frames that have an image, or all of the tree's; each day's at its own size."""

    def __init__(self, root: Path, out: Path | None, split: str, recipe: Recipe) -> None:
        self.out = self.folder = out = out or root
        self.stride = recipe.network.strides[-1]
        self.tree, self._labels = kitti_files.Tree(root), kitti_files.Tree(root, labels=out)
        if split == "all":
            frames = list(self.tree.frames())
        else:
            listed = kitti_splits.frames_of(root, split)
            frames = [frame for frame in listed if self.tree.has_image(frame)]
        if not frames:
            raise ValueError(
                f"{root}: none of the frames of the split {split}; '--split all' labels every frame"
            )
        self._frames = {frame.name: frame for frame in frames}
        self.names = list(self._frames)

    def groups(self) -> Iterator[LabelGroup]:
        for _, names in groupby(self.names, lambda name: name[:10]):
            day = list(names)
            header = pictures.read_header(self.image(day[0]))
            yield LabelGroup(day, (self._divisible(header.height), self._divisible(header.width)))

    def _divisible(self, length: int) -> int:
        return max(round(length / self.stride), 1) * self.stride

    def image(self, name: str) -> Path:
        return self.tree.image(self._frames[name])

    def done(self) -> set[str]:
        return {name for name, frame in self._frames.items() if self._labels.has_labels(frame)}

    def stranger(self) -> Path | None:
        return _first(self.out.glob("*/*/label_0[23]/data/*.png"))

    def record(self) -> dict[str, Any]:
        return {"input": "the frames' own size"}  # of any split: frames' names tell them apart

    def write(self, name: str, ids_HW: NDArray[np.uint16]) -> None:
        ids_HW = np.where(ids_HW == files.EGO_ID, np.uint16(0), ids_HW)
        _write(self._labels.labels(self._frames[name]), ids_HW)


def _first(paths: Iterable[Path]) -> Path | None:
    return next((path for path in paths if not is_litter(path.name)), None)


def _write(path: Path, array_HW: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, png.encode(array_HW))
