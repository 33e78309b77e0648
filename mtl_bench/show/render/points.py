"""A point cloud seen from a raised place: squares as large as what they were sampled from.

Axes of the cloud and of the viewer: x right, y down, z forward. N points, H x W pixels.
"""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.show.render.canvas import Image

OVERSAMPLING = 2  # per axis: smooth edges
LARGEST = 15  # pixels of a point's square, before the picture is shrunk
_EMPTY = np.iinfo(np.uint64).max


@dataclass(frozen=True)
class View:
    """Where the viewer stands, what point is in the middle of the picture, and what is left out."""

    eye_3: tuple[float, float, float]
    target_3: tuple[float, float, float]
    fov_deg: float = 58.0  # across the picture's width
    farthest: float = math.inf  # z of the last points drawn

    @staticmethod
    def raised(camera_height: float) -> "View":
        """Above and behind the camera, looking down the road; the cloud's unit is the height's."""
        h = camera_height
        return View((1.5 * h, -4.5 * h, -5.0 * h), (0.0, 0.0, 10.0 * h), farthest=50.0 * h)

    @property
    def axes_33(self) -> NDArray[np.float64]:
        """The viewer's right, down and forward, as rows."""
        forward = np.subtract(self.target_3, self.eye_3)
        forward = forward / np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])


def points_view(
    points_N3: NDArray[np.floating[Any]],
    colors_N3: Image,
    size: tuple[int, int],
    view: View,
    pixel_rad: float,
    background: tuple[int, int, int] = (255, 255, 255),
) -> Image:
    """Draw a cloud with hidden points hidden.

    Args:
        points_N3: in the axes of the camera that saw them, at the origin.
        colors_N3: RGB.
        size: height and width of the picture.
        view: from where.
        pixel_rad: angle of that camera's pixel, 1 / fx: a point at depth z stands for a square of
            `pixel_rad * z`, and is drawn as large as the viewer sees that.
    """
    height, width = (OVERSAMPLING * pixels for pixels in size)
    focal = width / 2 / math.tan(math.radians(view.fov_deg) / 2)
    seen_N3 = ((points_N3 - np.array(view.eye_3)) @ view.axes_33.T).astype(np.float32)
    spread_N = pixel_rad * points_N3[:, 2]
    kept_N = (seen_N3[:, 2] > spread_N) & (points_N3[:, 2] <= view.farthest)
    side = np.ceil(focal * spread_N[kept_N] / seen_N3[kept_N, 2]).clip(1, LARGEST).astype(int)
    order = np.argsort(-side, kind="stable")  # largest first, so that a loop takes the first ones
    side, number = side[order], np.flatnonzero(kept_N)[order]
    x, y, z = seen_N3[number].T
    left = np.floor(focal * x / z + (width - side) / 2 + 0.5).astype(int)
    top = np.floor(focal * y / z + (height - side) / 2 + 0.5).astype(int)
    # Depth above, number below: the smallest of a pixel's keys is its nearest point's
    key = z.view(np.uint32).astype(np.uint64) << np.uint64(32) | number.astype(np.uint64)
    nearest = np.full(height * width, _EMPTY)
    for down, right in np.ndindex((side[0], side[0]) if len(side) else (0, 0)):
        large = np.count_nonzero(side > max(down, right))
        row, column = top[:large] + down, left[:large] + right
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        np.minimum.at(nearest, row[inside] * width + column[inside], key[:large][inside])
    picture = np.full((height * width, 3), background, np.uint8)
    drawn = nearest != _EMPTY
    picture[drawn] = colors_N3[(nearest[drawn] & np.uint64(0xFFFFFFFF)).astype(int)]
    large_HW3 = picture.reshape(height, width, 3)
    return np.asarray(cv2.resize(large_HW3, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)
