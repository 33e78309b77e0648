"""Laser scans as sparse depth maps: what KITTI's frames have where the improved maps are absent."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_POINT_BYTES = 16  # four float32: x ahead, y left, z up (metres), reflectance


def read_scan(path: Path) -> NDArray[np.float32]:
    """[N,3] points in the scanner's axes, metres.

    Raises:
        ValueError: the file is missing, empty or cut off inside a point.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    check_length(path, len(data))
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3]


def check_length(path: Path, length: int) -> None:
    """Raises: ValueError where a file of that many bytes is no scan."""
    if not length or length % _POINT_BYTES:
        raise ValueError(
            f"{path}: {length} bytes are no whole number of points of {_POINT_BYTES} bytes; "
            f"copy or unpack the file again"
        )


def depth_map(
    points_N3: NDArray[np.float32], project_34: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.float32]:
    """[H,W] depth in metres of the nearest point of each pixel, 0 = no point.

    Depth is the distance ahead of the scanner, not of the camera 0.27 m behind it, and a pixel is
    round(u) - 1: so the ground truth of the published numbers on raw scans was made (Eigen et al.,
    NeurIPS 2014, and everyone after). Points beside or behind the scanner are left out.

    Args:
        points_N3: metres, in the scanner's axes.
        project_34: from there to pixels.
        size: height and width.
    """
    points = points_N3[points_N3[:, 0] >= 0].astype(np.float64)
    u, v, w = project_34[:, :3] @ points.T + project_34[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.round(u / w) - 1, np.round(v / w) - 1
    height, width = size
    seen = (w > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row, depth = column[seen].astype(int), row[seen].astype(int), points[seen, 0]
    order = np.argsort(-depth, kind="stable")  # the last one written stays: the nearest
    depth_m = np.zeros(size, np.float32)
    depth_m[row[order], column[order]] = depth[order]
    return depth_m
