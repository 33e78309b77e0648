"""One prediction as files: pictures, maps and a point cloud; and as a frame of a video.

NAME_<ending>.png        what the cell's tasks write (`View.files`)
NAME_points.{ply,npz}    the point cloud, and NAME_points.png, what it looks like
"""

import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core import canvas
from mtl_bench.core.canvas import Image
from mtl_bench.core.labels import LabelSet
from mtl_bench.data import png
from mtl_bench.show.points import View, points_view
from mtl_bench.show.predict import Predicted
from mtl_bench.show.predict.point_cloud import POINTS, from_prediction, write_npz, write_ply

DRAWN_POINTS = 2**19  # about as many make up a picture of a cloud
OVERLAP = 4.0  # times a pixel's size: slanted surfaces are seen from above, too
BEND = 0.1  # of inverse depth at a pixel, as a share of it: more is an edge
PANEL = 1280  # pixels: a video's panels are no wider


def write_files(base: Path, predicted: Predicted, kinds: Collection[str], labels: LabelSet) -> None:
    """What was asked for of one frame, as `<base>_...`."""
    for view in predicted.views:
        for kind in kinds:
            for ending, pixels in view.files(kind, predicted.image_HW3).items():
                _png(base, ending, pixels)
    if POINTS in kinds and predicted.surface is not None:
        cloud = from_prediction(predicted, labels)
        write_ply(_named(base, "points.ply"), cloud, labels)
        write_npz(_named(base, "points.npz"), cloud)
        _png(base, "points", cloud_picture(predicted, labels))


def cloud_picture(predicted: Predicted, labels: LabelSet) -> Image:
    """The cloud from above and behind the camera, in the colours of the segments.

    Drawn from more pixels than there are, so that the ground has no gaps: `denser`.
    """
    rows, columns = predicted.image_HW3.shape[:2]
    times = math.ceil((DRAWN_POINTS / (rows * columns)) ** 0.5)
    predicted = denser(predicted, min(times, 8))
    surface, segments = predicted.surface, predicted.segments
    if segments is not None:
        predicted = replace(predicted, image_HW3=segments.picture(predicted.image_HW3))
    cloud = from_prediction(predicted, labels)
    height = surface.camera_height if surface else None
    if height is None:  # no scale: the nearest ground is some three heights away
        height = float(np.percentile(cloud.points_N3[:, 2], 2)) / 3 if len(cloud) else 1.0
    view, pixel_rad = View.raised(height), OVERLAP / predicted.K_33[0, 0]
    return points_view(cloud.points_N3, cloud.colors_N3, (480, 960), view, pixel_rad)


def denser(predicted: Predicted, times: int) -> Predicted:
    """The same at a multiple of its size, inverse depth linear in between: exact on planes.

    At edges the nearest pixel's stands: no points in the air between two things.
    """
    surface = predicted.surface
    assert surface is not None
    depth_HW = surface.depth_HW
    inverse_HW = np.divide(1, depth_HW, out=np.zeros_like(depth_HW), where=depth_HW > 0)
    nearest_HW = canvas.enlarge(inverse_HW, times)
    linear_HW = cv2.resize(inverse_HW, nearest_HW.shape[::-1], interpolation=cv2.INTER_LINEAR)
    second = np.array([[0.5, -1.0, 0.5]])
    bends = (cv2.filter2D(inverse_HW, -1, kernel) for kernel in (second, second.T))
    smooth_HW = np.maximum(*map(np.abs, bends)) < BEND * inverse_HW
    smooth_HW = canvas.enlarge(smooth_HW.astype(np.uint8), times) > 0
    inverse_HW = np.where(smooth_HW, linear_HW, nearest_HW)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    depth_HW = np.divide(1, inverse_HW, out=np.zeros_like(inverse_HW), where=inverse_HW > 0)
    return Predicted(
        canvas.enlarge(predicted.image_HW3, times, smooth=True),
        np.diag([times, times, 1.0]) @ (predicted.K_33 + half) - half,
        tuple(
            replace(surface, depth_HW=depth_HW)
            if view is surface
            else view.map(lambda map_HW: canvas.enlarge(map_HW, times))
            for view in predicted.views
        ),
    )


def video_frame(predicted: Predicted) -> Image:
    """The tasks' pictures side by side; the same size for all frames of a video."""
    rows, columns = predicted.image_HW3.shape[:2]
    size = (min(columns, PANEL), round(rows * min(1, PANEL / columns)))  # OpenCV's order

    def fit(values: NDArray[Any], how: int = cv2.INTER_NEAREST) -> NDArray[Any]:
        return np.asarray(cv2.resize(values, size, interpolation=how))

    image = fit(predicted.image_HW3, cv2.INTER_AREA)
    panels = [view.map(fit).explained(image, whole=True) for view in predicted.views]
    picture = canvas.beside(panels, gap=8)
    padding = ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0))
    return np.pad(picture, padding, constant_values=255)  # codecs want even sizes


def _png(base: Path, what: str, image: NDArray[Any]) -> None:
    _named(base, f"{what}.png").write_bytes(png.encode(image))


def _named(base: Path, ending: str) -> Path:
    return base.with_name(f"{base.name}_{ending}")
