"""A tiny tree in KITTI raw's layout, written with OpenCV: noise images, a wall of points."""

from pathlib import Path

import cv2
import numpy as np

from mtl_bench.core import config
from mtl_bench.data.kitti import Kitti
from mtl_bench.data.kitti_splits import Frame

HEIGHT, WIDTH = 16, 48
SIZES = {"2011_09_26": (16, 48), "2011_09_28": (15, 47)}  # as KITTI's, days differ a little
TRAIN, VAL, TEST = (
    "2011_09_26_drive_0001_sync",
    "2011_09_26_drive_0005_sync",
    "2011_09_26_drive_0002_sync",
)
OTHER_DAY = "2011_09_28_drive_0002_sync"  # of the test split
FOCAL, WALL_M = 20.0, 10.0


def put_png(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), array)


def file(root: Path, drive: str, folder: str, number: int, suffix: str = ".png") -> Path:
    return root / drive[:10] / drive / folder / "data" / f"{number:010d}{suffix}"


def improved(root: Path, drive: str, number: int, camera: str = "02") -> Path:
    """Where the official package has it, beside the root."""
    inner = Path(drive, "proj_depth", "groundtruth", f"image_{camera}", f"{number:010d}.png")
    return root.parent / "data_depth_annotated" / "val" / inner


def write_calibration(root: Path, date: str) -> None:
    """Two rectified cameras, 0.5 m apart; the scanner's axes turned into the camera's."""
    height, width = SIZES[date]
    lines = ["calib_time: 01-Jan-2000 12:00:00", "R_rect_00: 1 0 0 0 1 0 0 0 1"]
    for camera, x in (("02", 0.0), ("03", -0.5 * FOCAL)):
        center = f"{(width - 1) / 2} 0 0 {FOCAL} {(height - 1) / 2} 0 0 0 1 0"
        lines.append(f"S_rect_{camera}: {width} {height}")
        lines.append(f"P_rect_{camera}: {FOCAL} 0 " + center.replace(" 0 0", f" {x} 0", 1))
    folder = root / date
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    (folder / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")


def wall() -> np.ndarray:
    """[N,4] points across the view, 10 m ahead."""
    y, z = np.meshgrid(np.linspace(-9, 9, 37), np.linspace(-3, 3, 13))
    x = np.full(y.shape, WALL_M)
    return np.stack([x, y, z, np.ones_like(x)], -1).reshape(-1, 4).astype("<f4")


def instance_ids(size: tuple[int, int]) -> np.ndarray:
    ids = np.full(size, 7, np.uint16)
    ids[:4] = 23
    ids[8:12, 4:10] = 26001
    return ids


def write_drive(root: Path, drive: str, numbers, camera: str = "02", labels: bool = True) -> None:
    """Images, scans and labels of some frames of a drive."""
    size = SIZES[drive[:10]]
    write_calibration(root, drive[:10])
    for number in numbers:
        random = np.random.default_rng([int(drive[17:21]), number])
        image = random.integers(0, 256, (*size, 3), np.uint8)
        put_png(file(root, drive, f"image_{camera}", number), image)
        scan = file(root, drive, "velodyne_points", number, ".bin")
        scan.parent.mkdir(parents=True, exist_ok=True)
        scan.write_bytes(wall().tobytes())
        if labels:
            put_png(file(root, drive, f"label_{camera}", number), instance_ids(size))


def write_tree(root: Path) -> Path:
    """Training frames 3 to 5 between neighbours, validation and test frames of two days."""
    write_drive(root, TRAIN, range(2, 7))
    write_drive(root, VAL, (4, 6, 24), labels=False)
    write_drive(root, TEST, (3, 6, 9))
    write_drive(root, OTHER_DAY, (3, 6))
    for number in (6, 9):
        depth = np.full(SIZES["2011_09_26"], 5 * 256, np.uint16)
        depth[0] = 0
        put_png(improved(root, TEST, number), depth)
    return root


def open_tree(root: Path, split: str = "train", **changes) -> Kitti:
    settings = {
        "video": True,
        "panoptic": True,
        "augment": config.Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)
        if split == "train"
        else None,
        "loss": config.Loss(center_sigma=2.0, small_area=10),
    }
    data = changes.pop("data", config.Data(dataset="kitti", height=HEIGHT, width=WIDTH))
    return Kitti(root, split, data, **{**settings, **changes})


def names(drive: str, *numbers: int, camera: str = "02") -> list[str]:
    return [Frame(drive, camera, number).name for number in numbers]
