"""Which camera took an image: intrinsics and mounting from a file, from numbers, or a guess.

An image that lies in Cityscapes' or KITTI's layout has its calibration there; it is found without
being named.
"""

import functools
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data import cityscapes_files as cityscapes
from mtl_bench.data import kitti_files as kitti

KITTI_FILE = "calib_cam_to_cam.txt"
GUESSED_FOV_DEG = 60.0  # across the image


@dataclass(frozen=True)
class Mounted:
    """A camera: intrinsics in pixels of its images, and how it is mounted."""

    K_33: NDArray[np.float64]
    height_m: float | None  # above the road; None: not known
    pitch_rad: float  # to the road, positive looks down
    source: str  # where all this comes from, in words
    guessed: bool = False


@dataclass(frozen=True)
class Given:
    """What a user says of the camera; at most one source of intrinsics."""

    camera: Path | None = None  # Cityscapes' camera JSON
    calibration: Path | None = None  # KITTI's
    focal_and_center: tuple[float, float, float, float] | None = None  # fx, fy, cx, cy
    height_m: float | None = None

    def __post_init__(self) -> None:
        named = (self.camera, self.calibration, self.focal_and_center)
        if sum(source is not None for source in named) > 1:
            raise ValueError("--camera, --calib and --fx ... exclude each other: give one of them")
        if self.focal_and_center is not None and not _possible(*self.focal_and_center):
            raise ValueError(f"impossible intrinsics fx, fy, cx, cy = {self.focal_and_center}")
        if self.height_m is not None and not 0 < self.height_m < math.inf:
            raise ValueError(f"--camera-height {self.height_m:g} is no height in metres")


def camera_of(path: Path, size: tuple[int, int], given: Given) -> Mounted:
    """The camera that took an image or video of this height and width.

    What the user gave counts first, then files of the data set that the image lies in, then a
    guess. A height that the user gave replaces the file's.

    Raises:
        ValueError: unreadable files, a file for images of another size, or a height, which asks
            for metres, without intrinsics.
    """
    camera = _from_given(path, size, given) or _from_data_set(path, size) or _guess(size)
    cx, cy = camera.K_33[:2, 2]
    if not (0 < cx < size[1] and 0 < cy < size[0]):
        raise ValueError(
            f"{path}: {size[0]}x{size[1]} pixels, but the optical axis of its intrinsics "
            f"({camera.source}) is at x = {cx:g}, y = {cy:g}: they are another camera's"
        )
    if given.height_m is None:
        return camera
    if camera.guessed:
        raise ValueError(
            f"{path}: --camera-height asks for metres, which takes the camera's intrinsics, too: "
            f"give --camera, --calib or --fx --fy --cx --cy"
        )
    source = f"{camera.source}; height from --camera-height"
    return Mounted(camera.K_33, given.height_m, camera.pitch_rad, source)


def _from_given(path: Path, size: tuple[int, int], given: Given) -> Mounted | None:
    if given.camera is not None:
        return _from_cityscapes(given.camera)
    if given.calibration is not None:
        return _from_kitti(given.calibration, path, size)
    if given.focal_and_center is not None:
        return Mounted(_matrix(*given.focal_and_center), None, 0.0, "--fx --fy --cx --cy")
    return None


def _from_data_set(path: Path, size: tuple[int, int]) -> Mounted | None:
    """From the folders that the image lies in: Cityscapes' or KITTI's."""
    path = path.resolve()
    for folder in path.parents:
        if folder.name in (cityscapes.IMAGE.folder, cityscapes.SEQUENCE.folder):
            name = path.name.removesuffix(cityscapes.IMAGE.suffix)
            cameras = folder.parent / cityscapes.CAMERA.folder / path.relative_to(folder).parent
            if not cameras.is_dir():
                return None
            nearest = cityscapes.camera_names(_names_in(cameras), {name}).get(name)
            kind = cityscapes.CAMERA.suffix
            return _from_cityscapes(cameras / f"{nearest}{kind}") if nearest else None
        if re.fullmatch(r"image_\d\d", folder.name):
            calibration = folder.parent.parent / KITTI_FILE
            return _from_kitti(calibration, path, size) if calibration.is_file() else None
    return None


@functools.lru_cache(4)
def _names_in(cameras: Path) -> frozenset[str]:
    """Frames that have a camera file in this folder."""
    files = cameras.glob(f"*{cityscapes.CAMERA.suffix}")
    return frozenset(file.name.removesuffix(cityscapes.CAMERA.suffix) for file in files)


def _guess(size: tuple[int, int]) -> Mounted:
    focal = size[1] / 2 / math.tan(math.radians(GUESSED_FOV_DEG) / 2)
    K_33 = _matrix(focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2)
    source = f"guessed: {GUESSED_FOV_DEG:g} degrees across the image, axis in its middle"
    return Mounted(K_33, None, 0.0, source, guessed=True)


def _from_cityscapes(path: Path) -> Mounted:
    camera = cityscapes.read_camera(path)
    K_33 = _matrix(camera.fx, camera.fy, camera.u0, camera.v0)
    return Mounted(K_33, camera.height_m, camera.pitch_rad, str(path))


def _from_kitti(calibration: Path, path: Path, size: tuple[int, int]) -> Mounted:
    """The rectified camera of the image's folder image_02 or image_03; elsewhere 02."""
    if calibration.name != KITTI_FILE:
        raise ValueError(f"{calibration}: KITTI's intrinsics are in a file called {KITTI_FILE}")
    found = re.findall(r"image_(\d\d)", str(path))
    number = found[-1] if found else "02"
    camera = kitti.read_camera(calibration.parent, number)
    if size != camera.size:
        raise ValueError(
            f"{calibration}: for images of {camera.size[0]}x{camera.size[1]} pixels, not "
            f"{size[0]}x{size[1]}; take the calibration of the image's own date"
        )
    height_m = kitti.CAMERA_HEIGHT_M
    source = f"{calibration}, camera {number}; height {height_m} m, which is KITTI's"
    return Mounted(camera.K_33, height_m, 0.0, source)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _possible(*values: float) -> bool:
    return all(map(math.isfinite, values)) and min(values) > 0
