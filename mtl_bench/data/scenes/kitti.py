"""Writes scenes as KITTI raw would: one drive a scene, with the files that training and tests read.

    <date>/calib_cam_to_cam.txt, calib_velo_to_cam.txt          one camera a date
    <date>/<drive>/image_02/data/<10 digits>.png                every frame; the left camera's alone
    <date>/<drive>/label_02/data/*.png                          16-bit instance ids of Cityscapes
    <date>/<drive>/proj_depth/groundtruth/image_02/*.png        256 times the exact depth, 16 bits
    <date>/<drive>/velodyne_points/data/*.bin, oxts/data/*.txt
    data_splits/eigen_{zhou,val,test}_files.txt                 the frames of train, val and test

Frames between a drive's first and last have labels, depth and a scan. As with KITTI's, one test
frame in 16 has no improved depth map (45 of 697 have none). No date is one of KITTI's: nobody shall
take these scenes for it. The camera, on the roof as KITTI's, sees no car below it and stands level.
The laser scanner stands straight above it, so that the distance ahead of the scanner, of which
KITTI makes ground truth, is the camera's depth.
"""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.scenes import render
from mtl_bench.data.scenes.rays import Camera, DoubleArray, FloatArray
from mtl_bench.data.scenes.settings import SPLITS, Settings, write_png

MOUNT_M = 1.65
BASELINE_M = 0.54
LEFT_M = 0.06  # of the left colour camera, from camera 00, whose axes the calibration is in
FRAMES_PER_S = 10.0
DATES = tuple(f"2000_01_0{day}" for day in range(1, 6))
WITHOUT_IMPROVED = 16  # every 16th test scene
LISTS = {"train": "eigen_zhou_files", "val": "eigen_val_files", "test": "eigen_test_files"}
BEAMS = 64
UP_DEG, DOWN_DEG = 2.0, -24.8  # elevation of the outer beams, as the HDL-64E's
STEP_DEG = 0.18  # between two shots of a beam
RANGE_M = 120.0
ABOVE_M = 0.08  # the camera
_CAMERA_STREAM = 2  # of the seed; 1 is the motion's


def camera_of(settings: Settings, date: str) -> Camera:
    """The camera of a date: KITTI's focal length and principal point in proportion to the width."""
    day = DATES.index(date)
    rng = np.random.default_rng([settings.seed, _CAMERA_STREAM, day])
    focal = settings.width * 0.581 * rng.uniform(0.99, 1.01)  # KITTI: 721.5 of 1242 pixels
    return Camera(
        height=settings.height,
        width=settings.width,
        fx=focal,
        fy=focal,
        u0=settings.width * rng.uniform(0.485, 0.495),
        v0=settings.height * rng.uniform(0.455, 0.470),
        mount_m=MOUNT_M,
        level=True,
    )


def place(settings: Settings, split: int, number: int) -> tuple[str, str]:
    """Date and drive of a scene; no drive has frames of two splits."""
    running = sum(settings.counts[:split]) + number
    date = DATES[running % len(DATES)]
    return date, f"{date}_drive_{running + 1:04d}_sync"


def write_scene(root: Path, settings: Settings, split: int, number: int) -> dict[str, Any]:
    """Render and write one drive; returns what its split's list says of it."""
    date, drive = place(settings, split, number)
    camera = camera_of(settings, date)
    scene = render.draw_scene((settings.seed, split, number), *settings.video, camera)
    improved = SPLITS[split] != "test" or number % WITHOUT_IMPROVED != WITHOUT_IMPROVED - 1

    def path(folder: str, frame: int, suffix: str = ".png") -> Path:
        full = root / date / drive / folder / f"{frame:010d}{suffix}"
        full.parent.mkdir(parents=True, exist_ok=True)
        return full

    inner = range(1, settings.frames - 1)
    for frame in range(settings.frames):
        write_png(path("image_02/data", frame), render.image(scene, frame))
        path("oxts/data", frame, ".txt").write_text(_oxts(scene, frame))
        if frame in inner:
            seen = render.truth(scene, frame)
            ids = render.instance_ids(seen, settings.min_instance_area)
            write_png(path("label_02/data", frame), ids)
            if improved:
                stored = encode_depth(seen.depth_HW)
                write_png(path("proj_depth/groundtruth/image_02", frame), stored)
            cloud = scan(seen.depth_HW, scene.camera, _brightness(seen))
            path("velodyne_points/data", frame, ".bin").write_bytes(cloud.astype("<f4").tobytes())
    for folder in ("image_02", "oxts"):
        _timestamps(root / date / drive / folder, settings.frames)
    frames = [f"{date}/{drive}/image_02/data/{frame:010d}.png" for frame in inner]
    return {"split": split, "sort": drive, "frames": frames}


def write_summary(root: Path, settings: Settings, entries: list[dict[str, Any]]) -> None:
    """Calibration of every date and the lists of frames."""
    lists = root / "data_splits"
    lists.mkdir()
    for split, name in enumerate(SPLITS):
        own = sorted((e for e in entries if e["split"] == split), key=lambda e: e["sort"])
        lines = [f"{frame}\n" for entry in own for frame in entry["frames"]]
        (lists / f"{LISTS[name]}.txt").write_text("".join(lines))
    for date in sorted({entry["sort"][: len(DATES[0])] for entry in entries}):
        camera = camera_of(settings, date)
        (root / date / "calib_cam_to_cam.txt").write_text(_cameras(camera))
        rotation, translation = mounting(camera, LEFT_M)
        scanner = {"R": rotation, "T": translation, "delta_f": np.zeros(2), "delta_c": np.zeros(2)}
        (root / date / "calib_velo_to_cam.txt").write_text(_calibration(scanner))


def encode_depth(depth_m_HW: FloatArray) -> np.ndarray:
    """KITTI's uint16 depth: 256 a metre, 0 = none, or farther than 16 bits hold."""
    stored = np.round(depth_m_HW.astype(np.float64) * 256)
    return np.where(stored < 65536, stored, 0).astype(np.uint16)


# --- the laser scanner ----------------------------------------------------------------------------


def scan(depth_m_HW: FloatArray, camera: Camera, reflectance_HW: FloatArray) -> NDArray[np.float32]:
    """64 beams that turn, sampled from the exact depth map at the pixels they come nearest to.

    What the camera does not see is not in the scan: no point shines through from behind an edge.

    Returns:
        Points [N,4]: x ahead, y left, z up, metres; reflectance.
    """
    rows, columns = _pixels(camera)
    z = depth_m_HW[rows, columns].astype(np.float64)
    hit = (z > 0) & (z < RANGE_M)
    rows, columns, z = rows[hit], columns[hit], z[hit]
    x = (columns - camera.u0) / camera.fx * z
    y = (rows - camera.v0) / camera.fy * z
    points = np.stack([z, -x, -y - ABOVE_M, reflectance_HW[rows, columns]], 1)
    return points.astype(np.float32)


def _pixels(camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the pixels that are shot at, each once."""
    half = np.ceil(np.degrees(np.arctan(camera.width / camera.fx)) / STEP_DEG) * STEP_DEG
    azimuth = np.radians(np.arange(-half, half, STEP_DEG))
    elevation = np.radians(np.linspace(UP_DEG, DOWN_DEG, BEAMS))
    columns = camera.u0 + camera.fx * np.tan(azimuth)[None] + 0 * elevation[:, None]
    rows = camera.v0 - camera.fy * np.tan(elevation)[:, None] / np.cos(azimuth)[None]
    pixels = np.stack([np.round(rows), np.round(columns)], -1).reshape(-1, 2).astype(np.int64)
    inside = (pixels >= 0).all(1) & (pixels < (camera.height, camera.width)).all(1)
    row, column = np.unique(pixels[inside], axis=0).T
    return row, column


def mounting(camera: Camera, left_m: float) -> tuple[DoubleArray, DoubleArray]:
    """R [3,3] and T [3] of `calib_velo_to_cam.txt`: from the scanner's axes to camera 00's.

    KITTI's ground truth puts a point that projects to u into pixel round(u) - 1, as its tools count
    from 1. Ours count from 0, so R leans by that one pixel: without it, every truth would be off by
    one, half a degree in images this small.

    Args:
        left_m: where the left camera's axes lie from camera 00's.
    """
    R_33 = np.array([[1 / camera.fx, -1, 0], [1 / camera.fy, 0, -1], [1, 0, 0]])
    return R_33, np.array([-left_m, -ABOVE_M, 0])


def _brightness(seen: render.Truth) -> FloatArray:
    """Reflectance 0..1 [H,W], one a class: sheet metal and signs more than tar and leaves."""
    return (seen.label_HW.astype(np.float32) * 37 % 100) / 100


# --- text files -----------------------------------------------------------------------------------


def _cameras(camera: Camera) -> str:
    """Left and right colour camera, rectified already: no distortion, no rotation."""
    lines: dict[str, DoubleArray] = {"corner_dist": np.array([0.1])}
    K_33 = np.array([[camera.fx, 0, camera.u0], [0, camera.fy, camera.v0], [0, 0, 1]])
    offsets = {"00": 0.0, "01": -BASELINE_M, "02": LEFT_M, "03": LEFT_M - BASELINE_M}
    for name, x_m in offsets.items():
        size = np.array([camera.width, camera.height], np.float64)
        shift_3 = np.array([x_m, 0, 0])
        lines |= {f"S_{name}": size, f"K_{name}": K_33, f"D_{name}": np.zeros(5)}
        lines |= {f"R_{name}": np.eye(3), f"T_{name}": shift_3}
        lines |= {f"S_rect_{name}": size, f"R_rect_{name}": np.eye(3)}
        lines[f"P_rect_{name}"] = np.column_stack([K_33, K_33 @ shift_3])
    return _calibration(lines)


def _calibration(lines: dict[str, DoubleArray]) -> str:
    text = "calib_time: 01-Jan-2000 12:00:00\n"
    for key, values in lines.items():
        text += f"{key}: {' '.join(f'{value:.12e}' for value in values.ravel())}\n"
    return text


def _oxts(scene: render.Scene, frame: int) -> str:
    """30 numbers: latitude, longitude, altitude, roll, pitch, yaw, velocities, ..., as OXTS' units.

    The street leads east; yaw counts from there to the left, the camera's z and x are east and
    south at the start.
    """
    pose, speed = scene.motion.poses[frame], scene.motion.step_m * FRAMES_PER_S
    ahead = pose.rotation_33[:, 2]
    yaw, pitch = -np.arctan2(ahead[0], ahead[2]), np.arcsin(ahead[1])
    east, north = pose.position_3[2], -pose.position_3[0]
    degree_m = 111_320.0
    values = np.zeros(30)
    values[:3] = 49 + north / degree_m, 8.4 + east / (degree_m * np.cos(np.radians(49))), 115
    values[3:6] = 0, pitch, yaw
    values[6:11] = speed * np.sin(yaw), speed * np.cos(yaw), speed, 0, 0
    values[13] = 9.81  # acceleration upwards, as the sensor feels it
    values[19] = values[22] = -scene.motion.yaw_step_rad * FRAMES_PER_S
    values[23:25] = 0.05, 0.01
    values[25:] = 4, 10, 4, 4, 0
    return " ".join(f"{value:.12g}" for value in values) + "\n"


def _timestamps(folder: Path, frames: int) -> None:
    start = datetime(2000, 1, 1, 12, tzinfo=UTC)
    times = (start + timedelta(seconds=i / FRAMES_PER_S) for i in range(frames))
    text = "".join(f"{time:%Y-%m-%d %H:%M:%S.%f}000\n" for time in times)
    (folder / "timestamps.txt").write_text(text)
