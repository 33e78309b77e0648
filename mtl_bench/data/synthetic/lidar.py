"""A laser scanner beside the camera: 64 beams that turn, sampled from the exact depth map.

Scanner axes: x ahead, y left, z up; metres. It stands straight above the left camera, so that the
distance ahead of it, of which KITTI makes ground truth, is the camera's depth. What the camera does
not see is not in the scan: no point shines through from behind an edge.
"""

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic.camera import Camera, DoubleArray, FloatArray

BEAMS = 64
UP_DEG, DOWN_DEG = 2.0, -24.8  # elevation of the outer beams, as the HDL-64E's
STEP_DEG = 0.18  # between two shots of a beam
RANGE_M = 120.0
ABOVE_M = 0.08  # the camera


def scan(depth_m_HW: FloatArray, camera: Camera, reflectance_HW: FloatArray) -> NDArray[np.float32]:
    """Points [N,4]: x, y, z and reflectance, at the pixel centres that beams come nearest to."""
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
