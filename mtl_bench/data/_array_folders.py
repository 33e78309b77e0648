"""Dense data sets that are distributed as NumPy arrays, one file a frame and a field.

    {train,val}/<folder>/N.npy      N from 0, height x width (x channels) of a frame

Source: the archives of MTAN (Liu, Johns, Davison, CVPR 2019), which later papers train on. They
have no validation split: a fifth of `train`, drawn with a fixed seed, is split "val" here (159 of
NYUv2's 795 frames, 595 of Cityscapes' 2975), and the folder `val`, which papers report, is split
"test". `recipe.data.train_frames = "all"` trains on the whole folder, as those papers did; there is
no split "val" then. Images are kept in 8 bits. Every file is checked as it is read.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import NEIGHBOURS, Dataset, DecodedFrame, Kind, Report
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.recipe import Data
from mtl_bench.data import npy

IMAGE = "image"  # the folder; other folders are fields
FOLDER_OF = {"train": "train", "val": "train", "test": "val"}  # of a split
VALIDATION = 0.2  # of the folder `train`
FARTHEST_M = 1000.0  # depth beyond it is not in metres
Size = tuple[int, int]  # height, width


class ArrayFolders(Dataset):
    """One split of a data set in this layout; a subclass says which folders hold its fields."""

    has_camera: ClassVar[bool] = False
    folders: ClassVar[Mapping[str, tuple[str, ...]]]  # of a field: the first of these that is there

    def open_split(self) -> None:
        data, split = self.data, self.split
        if NEIGHBOURS in self.needs:
            raise ValueError(f"{data.dataset} has single frames: no task can compare neighbours")
        if data.train_frames not in ("published", "all"):
            raise ValueError(
                f"recipe.data.train_frames must be published or all, not '{data.train_frames}'"
            )
        self.folder = self.root / FOLDER_OF[split]
        self._paths = {name: self._folder_of(name) for name in sorted(self.needs)}
        names = stems(self.folder / IMAGE)
        held_out = validation(names)
        if split == "train" and data.train_frames == "published":
            names = [name for name in names if name not in held_out]
        elif split == "val" and data.train_frames == "all":
            raise ValueError(
                "recipe.data.train_frames = all leaves no frame for validation: set it to "
                "published, or recipe.evaluate.split to test"
            )
        elif split == "val":
            names = [name for name in names if name in held_out]
        self.names = names
        for field, folder in self._paths.items():
            lacking = sorted(set(names).difference(stems(folder)))
            if lacking:
                raise ValueError(
                    f"{folder / lacking[0]}.npy: missing, one of {len(lacking)} frames without "
                    f"{field}; see all with 'mtl-bench data check {self.root}'"
                )

    @classmethod
    def example(cls, root: Path, data: Data) -> bool:
        from mtl_bench.data import scenes

        scenes.write(
            root, data.height, data.width, 8, 2, 2, data.seed, progress=False, layout=cls.layout
        )
        return True

    @classmethod
    def check(cls, root: Path, deep: bool = False) -> Report:
        from mtl_bench.data.check_arrays import check

        return check(cls, root, deep)

    @classmethod
    def image_files(cls, root: Path, split: str) -> dict[str, Path]:
        raise ValueError(f"{cls.layout}: its images are arrays; give image files to predict on")

    @classmethod
    def folder_in(cls, folder: Path, field: str) -> Path | None:
        """The folder of a field that is there."""
        found = (folder / name for name in cls.folders[field])
        return next((path for path in found if path.is_dir()), None)

    def _folder_of(self, field: str) -> Path:
        found = self.folder_in(self.folder, field)
        if found is None:
            raise ValueError(f"{self.folder}: no folder {' or '.join(self.folders[field])} in it")
        return found

    def read(self, name: str) -> DecodedFrame:
        path = self.folder / IMAGE / f"{name}.npy"
        image_HW3 = read_image(path)
        own: Size = (image_HW3.shape[0], image_HW3.shape[1])
        fields = {}
        for field, folder in self._paths.items():
            array = self.read_field(folder / f"{name}.npy", field)
            if array.shape[:2] != own:
                raise ValueError(
                    f"{folder / name}.npy: {_times(array.shape)} pixels, its image has "
                    f"{_times(own)}"
                )
            array = self._at_input(array, cv2.INTER_NEAREST_EXACT) if self.training else array
            value = torch.from_numpy(np.ascontiguousarray(array))
            fields[field] = value.permute(2, 0, 1).contiguous() if value.dim() == 3 else value
        shrinks = own[0] * own[1] > self.data.height * self.data.width
        image_HW3 = self._at_input(image_HW3, cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return DecodedFrame([torch.from_numpy(image_HW3).permute(2, 0, 1)], fields=fields)

    def _at_input(self, array: NDArray[Any], interpolation: int) -> NDArray[Any]:
        size = (self.data.width, self.data.height)
        if array.shape[1::-1] == size:
            return array
        return np.asarray(cv2.resize(array, size, interpolation=interpolation))

    @classmethod
    def read_field(cls, path: Path, field: str) -> NDArray[Any]:
        """A frame's values [H,W] or [H,W,3] as samples have them.

        Raises:
            ValueError: an array of another shape, type or range.
        """
        kind = cls.fields[field]
        if kind is Kind.IDS:
            return read_labels(path, len(cls.labels))
        return read_normals(path) if kind is Kind.NORMALS else read_depth(path, kind)


def stems(folder: Path) -> list[str]:
    """Names of a folder's arrays in the order of their numbers.

    Raises:
        ValueError: no array in it.
    """
    found = [path.stem for path in folder.glob("*.npy")]
    if not found:
        raise ValueError(f"{folder}: no *.npy in it")
    return sorted(found, key=lambda stem: (len(stem), stem))


def validation(names: list[str]) -> frozenset[str]:
    """The frames of the folder `train` that training leaves out: the same ones whenever asked."""
    order = np.random.default_rng(0).permutation(len(names))
    return frozenset(names[index] for index in order[: round(VALIDATION * len(names))])


# --- arrays ---------------------------------------------------------------------------------------


def load(path: Path, channels: int) -> NDArray[Any]:
    """A finite array [H,W], or [H,W,channels] of more than one.

    Raises:
        ValueError: no such file, no array, or one of another shape or type.
    """
    array = npy.read(path)
    if channels == 1 and array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim != (2 if channels == 1 else 3) or (channels > 1 and array.shape[2] != channels):
        raise ValueError(
            f"{path}: {_times(array.shape)}, not height x width" + f" x {channels}" * (channels > 1)
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{path}: values that are not finite; 0 marks what has none")
    return array


def read_image(path: Path) -> NDArray[np.uint8]:
    """RGB [H,W,3]."""
    image = load(path, 3)
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    low, high = float(image.min()), float(image.max())
    if low < -1e-3 or high > 1 + 1e-3:
        raise ValueError(f"{path}: colours from {low:g} to {high:g}, not from 0 to 1")
    return np.asarray(np.rint(image * 255).clip(0, 255), np.uint8)


def read_labels(path: Path, classes: int) -> NDArray[np.int32]:
    """Class indices [H,W]; -1, which marks what has no label, as IGNORE."""
    labels = load(path, 1)
    low, high = labels.min(), labels.max()
    if low < -1 or high >= classes or (labels != np.rint(labels)).any():
        raise ValueError(
            f"{path}: labels from {low:g} to {high:g}, not whole numbers from -1 (none) to "
            f"{classes - 1}: put the folder with labels of {classes} classes in its place"
        )
    labels = labels.astype(np.int32)
    return np.where(labels < 0, IGNORE, labels)


def read_depth(path: Path, kind: Kind) -> NDArray[np.float32]:
    """Depth in metres or inverse depth (raw disparity / 65535) [H,W]; 0 = no value."""
    depth = load(path, 1)
    low, high = float(depth.min()), float(depth.max())
    limit, unit = (FARTHEST_M, "metres") if kind is Kind.DEPTH else (1.0, "disparity / 65535")
    if low < 0 or high > limit:
        raise ValueError(
            f"{path}: {kind.name.lower().replace('_', ' ')} from {low:g} to {high:g}, not "
            f"from 0 (none) to {limit:g} ({unit})"
        )
    return depth.astype(np.float32)


def read_normals(path: Path) -> NDArray[np.float32]:
    """Unit normals [H,W,3]; of length 0 where there is none. Those that a resize shortened are
    made 1 long again; what is shorter than a half is mixed of several and is none."""
    normals = load(path, 3).astype(np.float32)
    length_HW1 = np.sqrt(np.square(normals).sum(-1, keepdims=True))
    if length_HW1.max() > 1.5:
        raise ValueError(f"{path}: normals up to {length_HW1.max():g} long, not 1")
    return np.where(length_HW1 > 0.5, normals / np.maximum(length_HW1, 0.5), 0)


def _times(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))
