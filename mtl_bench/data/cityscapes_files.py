"""Cityscapes on disk: where each file lies and what it says, in NumPy.

`<folder>/<split>/<city>/<city>_<sequence>_<frame><suffix>`; the annotated frame of a snippet has
its neighbours in `leftImg8bit_sequence`. Every error is a ValueError of one line that names the
file, the value and the remedy.
"""

import functools
import json
import math
import os
import re
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.files import is_litter
from mtl_bench.core.labels import DIVISOR, LARGEST_ID
from mtl_bench.data import pictures, png
from mtl_bench.data.labels import KNOWN_LABEL_IDS


@dataclass(frozen=True)
class Kind:
    """One of the data set's packages."""

    folder: str
    suffix: str
    what: str  # in a sentence: "3 frames lack their ..."
    bits: int | None = None  # of a PNG
    also: str | None = None  # another suffix that files may have

    @property
    def package(self) -> str:
        return f"{self.folder}_trainvaltest.zip"


_PNG, _JPEG = "_leftImg8bit.png", "_leftImg8bit.jpg"  # as distributed; as converted
IMAGE = Kind("leftImg8bit", _PNG, "image", 8, _JPEG)
SEQUENCE = Kind("leftImg8bit_sequence", _PNG, "neighbour frame", 8, _JPEG)
LABELS = Kind("gtFine", "_gtFine_instanceIds.png", "label file", 16)
DISPARITY = Kind("disparity", "_disparity.png", "disparity map", 16)
CAMERA = Kind("camera", "_camera.json", "camera file")
EGO_MASK = Kind("", "ego_mask.png", "ego mask", 8)  # one for the whole data set, optional

EGO_ID, SKY_ID = 1, 23  # label ids without static surface behind their pixels

_NAME = re.compile(r"(?P<city>.+)_(?P<sequence>\d{6})_(?P<frame>\d{6})")


# --- names and places -----------------------------------------------------------------------------


def split_name(name: str) -> tuple[str, str, int]:
    """City, sequence, frame number.

    Raises:
        ValueError: another form than city_000000_000019.
    """
    match = _NAME.fullmatch(name)
    if not match:
        raise ValueError(f"'{name}' is no frame's name, such as aachen_000000_000019")
    return match["city"], match["sequence"], int(match["frame"])


def neighbour(name: str, step: int) -> str:
    """The name of the frame that many frames later."""
    city, sequence, frame = split_name(name)
    return f"{city}_{sequence}_{frame + step:06d}"


def file_of(folder: Path, kind: Kind, name: str) -> Path:
    """A frame's file of a kind; the folder is `<root>/<kind.folder>/<split>`."""
    path = folder / name.rsplit("_", 2)[0] / f"{name}{kind.suffix}"
    if kind.also and not path.exists():
        other = path.with_name(f"{name}{kind.also}")
        return other if other.exists() else path
    return path


def names_in(folder: Path, kind: Kind) -> set[str]:
    """Frames that have a file of this kind; one directory listing a city, no file is opened."""
    if not folder.is_dir():
        return set()
    try:
        cities = [c for c in os.scandir(folder) if c.is_dir() and not is_litter(c.name)]
        files = [file.name for city in cities for file in os.scandir(city)]
    except OSError as error:
        raise ValueError(f"{error.filename}: cannot be listed ({error.strerror})") from error
    names = [name for name in files if not is_litter(name)]
    endings = (kind.suffix, kind.also or kind.suffix)
    return {name.removesuffix(end) for end in endings for name in names if name.endswith(end)}


def annotated_names(root: Path, split: str) -> list[str]:
    """Frames of `leftImg8bit/<split>`, sorted.

    Raises:
        ValueError: the folder is missing, unreadable or empty, or holds other names.
    """
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder; --data takes the folder that holds leftImg8bit")
    folder = root / IMAGE.folder / split
    names = sorted(names_in(folder, IMAGE))
    if not names:
        raise ValueError(
            f"{folder}: no *{IMAGE.suffix} in it; "
            f"expected Cityscapes' layout, {IMAGE.folder}/{split}/<city>/"
        )
    for name in names:
        split_name(name)
    return names


def with_neighbours(names: set[str], present: set[str], stride: int = 1) -> set[str]:
    """Those of the names whose neighbours, so many frames away, are present, too."""
    return {
        name for name in names if {neighbour(name, -stride), neighbour(name, stride)} <= present
    }


def unlabelled_names(root: Path, split: str, stride: int = 1) -> list[str]:
    """Frames that pseudo labels can be made for, sorted.

    They have no label file, but a camera (their own or their annotated frame's) and both neighbours
    in `leftImg8bit_sequence/<split>`.
    """
    present = names_in(root / SEQUENCE.folder / split, SEQUENCE)
    labelled = names_in(root / LABELS.folder / split, LABELS)
    sequences = {split_name(name)[:2] for name in annotated_names(root, split)}
    own = {name for name in present - labelled if split_name(name)[:2] in sequences}
    return sorted(with_neighbours(own, present, stride))


def camera_names(annotated: Set[str], names: Set[str]) -> dict[str, str]:
    """Whose camera file holds for a frame: its own, or that of its sequence's nearest annotated
    frame; frames of other sequences are left out."""
    known: dict[tuple[str, str], dict[int, str]] = {}
    for name in sorted(annotated):
        city, sequence, frame = split_name(name)
        known.setdefault((city, sequence), {})[frame] = name
    cameras = {name: name for name in annotated}
    for name in names - annotated:
        city, sequence, frame = split_name(name)
        if (city, sequence) in known:
            near = known[city, sequence]
            cameras[name] = near[min(near, key=lambda other: abs(other - frame))]
    return cameras


def reprojection_mask(frames: int, labelled: int, ego_mask: bool) -> str:
    """In words: what keeps ego vehicle and sky out of the photometric loss, `none` or ...

    Args:
        frames: training frames.
        labelled: those of them that have a label file.
        ego_mask: whether the data set has an ego mask.
    """
    if labelled == frames:
        return "labels"
    other = EGO_MASK.suffix if ego_mask else "none"
    return f"labels, or {other} where a frame lacks them" if labelled else other


# --- contents -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels of the frame; distances in metres."""

    fx: float
    fy: float
    u0: float
    v0: float
    baseline_m: float  # between the stereo pair
    height_m: float  # above the ground
    pitch_rad: float  # positive looks down


def read_camera(path: Path) -> Camera:
    """A frame's own camera file: its extrinsics are in the vehicle's axes, on the ground."""
    try:
        values = json.loads(path.read_text())
        intrinsic, extrinsic = values["intrinsic"], values["extrinsic"]
        focal_and_center = [float(intrinsic[key]) for key in ("fx", "fy", "u0", "v0")]
        mounting = [float(extrinsic[key]) for key in ("baseline", "z", "pitch")]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    except KeyError as error:
        raise ValueError(f"{path}: no {error} in this camera file") from error
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not a camera file ({error})") from error
    camera = Camera(*focal_and_center, *mounting)
    if not (all(map(math.isfinite, vars(camera).values())) and min(camera.fx, camera.fy) > 0):
        raise ValueError(f"{path}: impossible camera {camera}")
    return camera


def read_image(path: Path) -> NDArray[np.uint8]:
    """[H,W,3] RGB."""
    return pictures.read(path, bits=8)


def read_instance_ids(path: Path) -> NDArray[np.uint16]:
    """[H,W]: a label id, or label id * 1000 + number for one thing of several."""
    ids = png.read(path, 16)
    known = known_instance_ids()[ids]
    if not known.all():
        unknown = np.unique(ids[~known])
        raise ValueError(
            f"{path}: unknown instance id {unknown[0]} on {np.count_nonzero(~known)} pixels; "
            f"label ids are 0 to {max(KNOWN_LABEL_IDS)}, alone or times {DIVISOR} plus a number"
        )
    return ids


@functools.cache
def known_instance_ids() -> NDArray[np.bool_]:
    """[65536] which values a label file may hold."""
    ids = np.arange(LARGEST_ID + 1)
    return np.isin(np.where(ids < DIVISOR, ids, ids // DIVISOR), list(KNOWN_LABEL_IDS))


def read_ego_mask(path: Path) -> NDArray[np.uint16]:
    """[H,W] instance ids that know nothing but the ego vehicle: its id where the file is not 0."""
    return np.where(png.read(path, 8), np.uint16(EGO_ID), np.uint16(0))


def read_depth_m(path: Path, camera: Camera) -> NDArray[np.float32]:
    """[H,W] depth in metres, 0 = no value: baseline * fx / disparity, where the file stores
    256 * disparity + 1 and 0 for none."""
    stored = png.read(path, 16).astype(np.float32)
    disparity = np.maximum(stored - 1, 0) / 256
    depth_m = np.zeros(stored.shape, np.float32)
    np.divide(camera.baseline_m * camera.fx, disparity, out=depth_m, where=disparity > 0)
    return depth_m


def check_same_size(
    path: Path, size: tuple[int, ...], image_path: Path, expected: tuple[int, ...]
) -> None:
    """Raises: ValueError where a file's height and width are not those of its image."""
    if tuple(size[:2]) != tuple(expected[:2]):
        raise ValueError(
            f"{path}: {size[0]}x{size[1]} pixels, but {image_path.name} has "
            f"{expected[0]}x{expected[1]}; all files of a frame must be of one size"
        )
