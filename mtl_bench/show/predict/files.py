"""One prediction as files: pictures, maps and a point cloud; and as a frame of a video.

NAME_overlay.png         panoptic map over the image, with a legend
NAME_depth_colors.png    depth as colours, with a scale bar
NAME_depth.png           16 bits, in 1/256 of the unit; 0 = no value
NAME_instanceIds.png     16 bits, Cityscapes' instance ids
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

from mtl_bench.data.labels import LabelSet
from mtl_bench.show import render
from mtl_bench.show.predict import Image, Predicted
from mtl_bench.show.predict.point_cloud import from_prediction, write_npz, write_ply

KINDS = ("overlay", "depth", "ids", "points")
NEEDS = {"overlay": "panoptic", "depth": "depth", "ids": "panoptic", "points": "depth"}  # task
DRAWN_POINTS = 2**19  # about as many make up a picture of a cloud
OVERLAP = 4.0  # times a pixel's size: slanted surfaces are seen from above, too
BEND = 0.1  # of inverse depth at a pixel, as a share of it: more is an edge
PANEL = 1280  # pixels: a video's panels are no wider


def write_files(base: Path, predicted: Predicted, kinds: Collection[str], labels: LabelSet) -> None:
    """What was asked for of one frame, as `<base>_...`."""
    if "overlay" in kinds and predicted.instance_ids_HW is not None:
        ids_HW = predicted.instance_ids_HW
        _png(base, "overlay", render.panoptic_picture(predicted.image_HW3, ids_HW, labels))
    if "ids" in kinds and predicted.instance_ids_HW is not None:
        _png(base, "instanceIds", predicted.instance_ids_HW.astype(np.uint16))
    if "depth" in kinds and predicted.depth_HW is not None and predicted.unit is not None:
        _png(base, "depth_colors", render.depth_picture(predicted.depth_HW, predicted.unit))
        steps_HW = np.rint(predicted.depth_HW * 256).clip(0, 2**16 - 1)
        _png(base, "depth", steps_HW.astype(np.uint16))
    if "points" in kinds and predicted.depth_HW is not None:
        cloud = from_prediction(predicted, labels)
        write_ply(_named(base, "points.ply"), cloud, labels)
        write_npz(_named(base, "points.npz"), cloud)
        _png(base, "points", cloud_picture(predicted, labels))


def cloud_picture(predicted: Predicted, labels: LabelSet) -> Image:
    """The cloud from above and behind the camera, in the colours of the overlay.

    Drawn from more pixels than there are, so that roads have no gaps: `denser`.
    """
    rows, columns = predicted.image_HW3.shape[:2]
    times = math.ceil((DRAWN_POINTS / (rows * columns)) ** 0.5)
    predicted = denser(predicted, min(times, 8))
    if predicted.instance_ids_HW is not None:
        colored = render.overlay(predicted.image_HW3, predicted.instance_ids_HW, labels)
        predicted = replace(predicted, image_HW3=colored)
    cloud = from_prediction(predicted, labels)
    height = predicted.camera_height
    if height is None:  # no scale: the nearest ground is some three heights away
        height = float(np.percentile(cloud.points_N3[:, 2], 2)) / 3 if len(cloud) else 1.0
    view, pixel_rad = render.View.raised(height), OVERLAP / predicted.K_33[0, 0]
    return render.points_view(cloud.points_N3, cloud.colors_N3, (480, 960), view, pixel_rad)


def denser(predicted: Predicted, times: int) -> Predicted:
    """The same at a multiple of its size, inverse depth linear in between: exact on planes.

    At edges the nearest pixel's stands: no points in the air between two things.
    """
    assert predicted.depth_HW is not None
    depth_HW = predicted.depth_HW
    inverse_HW = np.divide(1, depth_HW, out=np.zeros_like(depth_HW), where=depth_HW > 0)
    nearest_HW = render.enlarge(inverse_HW, times)
    linear_HW = cv2.resize(inverse_HW, nearest_HW.shape[::-1], interpolation=cv2.INTER_LINEAR)
    second = np.array([[0.5, -1.0, 0.5]])
    bends = (cv2.filter2D(inverse_HW, -1, kernel) for kernel in (second, second.T))
    smooth_HW = np.maximum(*map(np.abs, bends)) < BEND * inverse_HW
    smooth_HW = render.enlarge(smooth_HW.astype(np.uint8), times) > 0
    inverse_HW = np.where(smooth_HW, linear_HW, nearest_HW)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    ids_HW = predicted.instance_ids_HW
    return replace(
        predicted,
        image_HW3=render.enlarge(predicted.image_HW3, times, smooth=True),
        K_33=np.diag([times, times, 1.0]) @ (predicted.K_33 + half) - half,
        instance_ids_HW=None if ids_HW is None else render.enlarge(ids_HW, times),
        depth_HW=np.divide(1, inverse_HW, out=np.zeros_like(inverse_HW), where=inverse_HW > 0),
    )


def video_frame(predicted: Predicted, labels: LabelSet) -> Image:
    """The overlay and depth side by side; the same size for all frames of a video."""
    rows, columns = predicted.image_HW3.shape[:2]
    size = (min(columns, PANEL), round(rows * min(1, PANEL / columns)))  # OpenCV's order

    def fit(values: NDArray[Any], how: int = cv2.INTER_NEAREST) -> NDArray[Any]:
        return np.asarray(cv2.resize(values, size, interpolation=how))

    image = fit(predicted.image_HW3, cv2.INTER_AREA)
    panels = []
    if predicted.instance_ids_HW is not None:
        ids_HW = fit(predicted.instance_ids_HW)
        panels.append(render.panoptic_picture(image, ids_HW, labels, whole_legend=True))
    if predicted.depth_HW is not None and predicted.unit is not None:
        panels.append(render.depth_picture(fit(predicted.depth_HW), predicted.unit))
    picture = render.beside(panels, gap=8)
    padding = ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0))
    return np.pad(picture, padding, constant_values=255)  # codecs want even sizes


def _png(base: Path, what: str, image: NDArray[Any]) -> None:
    path = _named(base, f"{what}.png")
    encoded = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)[1]
    path.write_bytes(encoded.tobytes())


def _named(base: Path, ending: str) -> Path:
    return base.with_name(f"{base.name}_{ending}")
