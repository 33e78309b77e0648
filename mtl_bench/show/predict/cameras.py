"""Which camera took an image: intrinsics and mounting from a file, from numbers, or a guess.

An image that lies in a known data set's folders has its calibration there; it is found without
being named.
"""

import math
from dataclasses import dataclass
from pathlib import Path

from mtl_bench.data import cameras
from mtl_bench.data.cameras import Mounted, matrix

GUESSED_FOV_DEG = 60.0  # across the image


@dataclass(frozen=True)
class Given:
    """What a user says of the camera; at most one source of intrinsics."""

    camera: Path | None = None  # a camera JSON
    calibration: Path | None = None  # a calibration file
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
    camera = _from_given(path, size, given) or cameras.of_layout(path, size) or _guess(size)
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
        return cameras.from_json(given.camera)
    if given.calibration is not None:
        return cameras.from_calibration(given.calibration, path, size)
    if given.focal_and_center is not None:
        return Mounted(matrix(*given.focal_and_center), None, 0.0, "--fx --fy --cx --cy")
    return None


def _guess(size: tuple[int, int]) -> Mounted:
    focal = size[1] / 2 / math.tan(math.radians(GUESSED_FOV_DEG) / 2)
    K_33 = matrix(focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2)
    source = f"guessed: {GUESSED_FOV_DEG:g} degrees across the image, axis in its middle"
    return Mounted(K_33, None, 0.0, source, guessed=True)


def _possible(*values: float) -> bool:
    return all(map(math.isfinite, values)) and min(values) > 0
