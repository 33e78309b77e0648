"""Cameras of single images: what files of Cityscapes, KITTI and OpenCV say, found or named.

An image that lies in one of these layouts has its calibration there.
"""

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.files import is_litter
from mtl_bench.data import cityscapes_files as cityscapes
from mtl_bench.data import kitti_files as kitti

KITTI_FILE = "calib_cam_to_cam.txt"
OPENCV_SUFFIXES = (".yaml", ".yml", ".xml")


@dataclass(frozen=True)
class Mounted:
    """A camera: intrinsics in pixels of its images, and how it is mounted."""

    K_33: NDArray[np.float64]
    height_m: float | None  # above the road; None: not known
    pitch_rad: float  # to the road, positive looks down
    source: str  # where all this comes from, in words
    guessed: bool = False


def of_layout(path: Path, size: tuple[int, int]) -> Mounted | None:
    """From the folders that the image lies in: Cityscapes' or KITTI's."""
    path = path.resolve()
    for folder in path.parents:
        if folder.name in (cityscapes.IMAGE.folder, cityscapes.SEQUENCE.folder):
            name = path.stem.removesuffix(Path(cityscapes.IMAGE.suffix).stem)
            cameras = folder.parent / cityscapes.CAMERA.folder / path.relative_to(folder).parent
            if not cameras.is_dir():
                return None
            nearest = cityscapes.camera_names(_names_in(cameras), {name}).get(name)
            kind = cityscapes.CAMERA.suffix
            return from_json(cameras / f"{nearest}{kind}") if nearest else None
        if re.fullmatch(r"image_\d\d", folder.name):
            calibration = folder.parent.parent / KITTI_FILE
            return from_calibration(calibration, path, size) if calibration.is_file() else None
    return None


@functools.lru_cache(4)
def _names_in(cameras: Path) -> frozenset[str]:
    """Frames that have a camera file in this folder."""
    names = (file.name for file in cameras.glob(f"*{cityscapes.CAMERA.suffix}"))
    own = (name for name in names if not is_litter(name))
    return frozenset(name.removesuffix(cityscapes.CAMERA.suffix) for name in own)


def from_json(path: Path) -> Mounted:
    """Of a camera file of Cityscapes."""
    camera = cityscapes.read_camera(path)
    K_33 = matrix(camera.fx, camera.fy, camera.u0, camera.v0)
    return Mounted(K_33, camera.height_m, camera.pitch_rad, str(path))


def from_calibration(calibration: Path, path: Path, size: tuple[int, int]) -> Mounted:
    """Of OpenCV, or of KITTI: the rectified camera of the image's folder image_02 or image_03;
    elsewhere 02."""
    if calibration.suffix.lower() in OPENCV_SUFFIXES:
        return _from_opencv(calibration, size)
    if calibration.name != KITTI_FILE:
        raise ValueError(
            f"{calibration}: neither a calibration of OpenCV ({', '.join(OPENCV_SUFFIXES)}) nor "
            f"KITTI's, which is called {KITTI_FILE}"
        )
    found = re.findall(r"image_(\d\d)", str(path))
    number = found[-1] if found else "02"
    camera = kitti.read_camera(calibration.parent, number)
    _check_size(calibration, size, camera.size)
    height_m = kitti.CAMERA_HEIGHT_M
    source = f"{calibration}, camera {number}; height {height_m} m, which is KITTI's"
    return Mounted(camera.K_33, height_m, 0.0, source)


def _from_opencv(path: Path, size: tuple[int, int]) -> Mounted:
    """What OpenCV's calibration writes, or ROS's in the same words: `camera_matrix`, and the
    images' size where it is there."""
    try:
        text = path.read_text(encoding="utf-8")
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        values = _data_of(storage.getNode("camera_matrix"))
        bent = any(_data_of(storage.getNode("distortion_coefficients")))
        own = [int(storage.getNode(f"image_{side}").real()) for side in ("height", "width")]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a calibration file as OpenCV writes it") from error
    if len(values) != 9:
        raise ValueError(f"{path}: no camera_matrix with data of 3x3 numbers in it")
    K_33 = np.array(values).reshape(3, 3)
    if not np.isfinite(K_33).all() or min(K_33[0, 0], K_33[1, 1]) <= 0:
        raise ValueError(f"{path}: impossible camera_matrix {values}")
    if min(own) > 0:
        _check_size(path, size, (own[0], own[1]))
    note = "; its lens distortion is not undone: undistort the images first" if bent else ""
    return Mounted(K_33, None, 0.0, f"{path}{note}")


def _data_of(matrix: cv2.FileNode) -> list[float]:
    data = None if matrix.empty() else matrix.getNode("data")
    return [] if data is None else [float(data.at(i).real()) for i in range(data.size())]


def _check_size(calibration: Path, size: tuple[int, int], own: tuple[int, int]) -> None:
    if size != own:
        raise ValueError(
            f"{calibration}: for images of {own[0]}x{own[1]} pixels, not {size[0]}x{size[1]}; take "
            f"the image's own calibration"
        )


def matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Intrinsics [3,3]."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
