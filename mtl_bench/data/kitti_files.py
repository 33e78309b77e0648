"""KITTI raw on disk: where each file lies and what it says, in NumPy.

    <date>/calib_cam_to_cam.txt, calib_velo_to_cam.txt
    <date>/<drive>/image_02|03/data/<10 digits>.png|.jpg        8-bit RGB; 02 left, 03 right
    <date>/<drive>/velodyne_points/data/<10 digits>.bin
    <date>/<drive>/label_02|03/data/<10 digits>.png             16-bit instance ids, ours

The improved depth maps (Uhrig et al., 3DV 2017), `<drive>/proj_depth/groundtruth/image_02/*.png`,
lie under `<date>/`, or as their own package has them: in the root or beside it, in a folder
`data_depth_annotated` or not, under `train/` and `val/` or not. Every error is a ValueError of one
line.
"""

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data import png
from mtl_bench.data.kitti_splits import CAMERAS, Frame

CAMERA_HEIGHT_M = 1.65  # of every drive, above the ground (Geiger et al., IJRR 2013)
RECORD = "pseudo_labels.json"  # in the root where the labels are a network's
DEPTH_PACKAGE = "data_depth_annotated"
IMAGES = (".jpeg", ".jpg", ".png")  # the lossless one last: it counts where there are several
_DATE = re.compile(r"\d{4}_\d\d_\d\d")
_CALIBRATION, _SCANNER = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"


def is_date(name: str) -> bool:
    """Whether a folder is called as KITTI's days of recording: 2011_09_26."""
    return bool(_DATE.fullmatch(name))


class Tree:
    """What is there: every folder is listed once, and no file opened.

    Args:
        labels: where the label files are, in place of the root.

    Raises:
        ValueError: no such folder, or no day of recording in it.
    """

    def __init__(self, root: Path, labels: Path | None = None) -> None:
        if not root.is_dir():
            raise ValueError(f"{root}: no such folder; --data takes the folder of KITTI's days")
        self.root, self._labels_root = root, labels or root
        self.dates = sorted(path.name for path in root.iterdir() if is_date(path.name))
        if not self.dates:
            raise ValueError(
                f"{root}: no day such as 2011_09_26 in it; expected KITTI raw's layout, "
                f"<date>/<drive>/image_02/data/"
            )
        self._endings: dict[tuple[str, str, str], dict[int, str]] = {}  # of files, by number
        self._improved: dict[tuple[str, str], Path] = {}
        packages = [base / name for base in (root, root.parent) for name in ("", DEPTH_PACKAGE)]
        self._depth_roots = [base / half for base in packages for half in ("train", "val", "")]

    # --- places -----------------------------------------------------------------------------------

    def _in_drive(self, frame: Frame, folder: str, suffix: str = ".png") -> Path:
        drive = self.root / frame.date / frame.drive
        return drive / folder / "data" / f"{frame.number:010d}{suffix}"

    def _original(self, frame: Frame) -> Path:
        return self._in_drive(frame, f"image_{frame.camera}")

    def image(self, frame: Frame) -> Path:
        """As it was distributed, or as it was converted to save disk space."""
        path = self._original(frame)
        return path.with_suffix(
            self._files(frame, self._original, IMAGES).get(frame.number, ".png")
        )

    def labels(self, frame: Frame) -> Path:
        path = self._in_drive(frame, f"label_{frame.camera}")
        return self._labels_root / path.relative_to(self.root)

    def scan(self, frame: Frame) -> Path:
        return self._in_drive(frame, "velodyne_points", ".bin")

    def improved(self, frame: Frame) -> Path:
        """In the first folder of its layouts that there is, else where it is looked for first."""
        key = frame.drive, frame.camera
        if key not in self._improved:
            inner = Path(frame.drive, "proj_depth", "groundtruth", f"image_{frame.camera}")
            folders = [base / inner for base in (self.root / frame.date, *self._depth_roots)]
            self._improved[key] = next((path for path in folders if path.is_dir()), folders[0])
        return self._improved[key] / f"{frame.number:010d}.png"

    # --- what is there ----------------------------------------------------------------------------

    def _files(
        self, frame: Frame, path_of: Callable[[Frame], Path], endings: Sequence[str] = (".png",)
    ) -> dict[int, str]:
        """Of the folder that holds a frame's file."""
        key = path_of.__name__, frame.drive, frame.camera
        if key not in self._endings:
            self._endings[key] = _files_in(path_of(frame).parent, endings)
        return self._endings[key]

    def has_image(self, frame: Frame) -> bool:
        return frame.number in self._files(frame, self._original, IMAGES)

    def has_labels(self, frame: Frame) -> bool:
        return frame.number in self._files(frame, self.labels)

    def has_scan(self, frame: Frame) -> bool:
        return frame.number in self._files(frame, self.scan, (".bin",))

    def has_improved(self, frame: Frame) -> bool:
        return frame.number in self._files(frame, self.improved)

    def has_neighbours(self, frame: Frame, stride: int = 1) -> bool:
        return all(self.has_image(frame.later(step)) for step in (-stride, stride))

    @property
    def predicted_labels(self) -> bool:
        """Whether the label files are a network's, which nothing may be measured against."""
        return (self.root / RECORD).is_file()

    def drives(self) -> list[str]:
        """Names of the drives' folders, in order."""
        folders = (path for date in self.dates for path in (self.root / date).iterdir())
        return sorted(path.name for path in folders if path.is_dir())

    def frames(self) -> Iterator[Frame]:
        """Every frame that has an image, in order."""
        for drive in self.drives():
            for camera in CAMERAS.values():
                first = Frame(drive, camera, 0)
                for number in sorted(self._files(first, self._original, IMAGES)):
                    yield first.later(number)


def _files_in(folder: Path, endings: Sequence[str]) -> dict[int, str]:
    """Endings by number; of a frame that has several files, the last ending's."""
    if not folder.is_dir():
        return {}
    try:
        with os.scandir(folder) as entries:  # 95k names in all: Path objects would take seconds
            names = [entry.name for entry in entries]
    except OSError as error:
        raise ValueError(f"{folder}: cannot be listed ({error.strerror})") from error
    return {
        int(name[:10]): ending
        for ending in endings
        for name in names
        if name.endswith(ending) and len(name) == 10 + len(ending) and name[:10].isdecimal()
    }


# --- calibration ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """One rectified camera of a day."""

    P_34: NDArray[np.float64]  # from the rectified axes of camera 00 to this one's pixels
    R_33: NDArray[np.float64]  # from camera 00's own axes to the rectified ones
    size: tuple[int, int]  # of its images: height, width

    @property
    def K_33(self) -> NDArray[np.float64]:
        return self.P_34[:, :3]


def is_calibrated(date_folder: Path) -> bool:
    return (date_folder / _CALIBRATION).exists()


def read_camera(date_folder: Path, camera: str) -> Camera:
    """The day's `P_rect`, `R_rect_00` and `S_rect`.

    Raises:
        ValueError: the file is missing or lacks one of them, or a focal length is impossible.
    """
    path = date_folder / _CALIBRATION
    values = _read_values(path)
    P_34 = _matrix(path, values, f"P_rect_{camera}", (3, 4))
    width, height = _matrix(path, values, f"S_rect_{camera}", (2,))
    if min(P_34[0, 0], P_34[1, 1]) <= 0:
        raise ValueError(f"{path}: impossible focal length in P_rect_{camera}")
    R_33 = _matrix(path, values, "R_rect_00", (3, 3))
    return Camera(P_34, R_33, (int(height), int(width)))


def baseline_m(date_folder: Path) -> float:
    """Distance between the two colour cameras."""
    left, right = (read_camera(date_folder, camera).P_34 for camera in CAMERAS.values())
    return float((left[0, 3] - right[0, 3]) / left[0, 0])


def scanner_to_pixels(date_folder: Path, camera: Camera) -> NDArray[np.float64]:
    """[3,4] projection of the scanner's points into a camera's image.

    Raises:
        ValueError: the scanner's calibration is missing or lacks R or T.
    """
    path = date_folder / _SCANNER
    values = _read_values(path)
    to_camera_44, rectify_44 = np.eye(4), np.eye(4)
    to_camera_44[:3, :3] = _matrix(path, values, "R", (3, 3))
    to_camera_44[:3, 3] = _matrix(path, values, "T", (3,))
    rectify_44[:3, :3] = camera.R_33
    return camera.P_34 @ rectify_44 @ to_camera_44


def _read_values(path: Path) -> dict[str, str]:
    if not path.is_file():
        raise ValueError(f"{path}: missing; unpack {path.parent.name}_calib.zip")
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    return {key: text for key, _, text in (line.partition(":") for line in lines)}


def _matrix(
    path: Path, values: dict[str, str], key: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    try:
        numbers = [float(word) for word in values[key].split()]
    except KeyError:
        raise ValueError(f"{path}: no {key} in this calibration") from None
    except ValueError as error:
        raise ValueError(f"{path}: {key} is not numbers ({error})") from None
    if len(numbers) != math.prod(shape) or not all(map(math.isfinite, numbers)):
        raise ValueError(
            f"{path}: {key} has {len(numbers)} numbers, not {math.prod(shape)} finite ones"
        )
    return np.array(numbers).reshape(shape)


# --- contents -------------------------------------------------------------------------------------


def read_improved_m(path: Path) -> NDArray[np.float32]:
    """[H,W] depth in metres, 0 = no value; the file stores 256 times that."""
    return png.read(path, 16).astype(np.float32) / np.float32(256)
