"""A point cloud to walk through: one HTML file that needs a browser with WebGL and nothing else.

Points are turned level (y straight down) and stored as 16-bit steps of their bounding box, with
3 bytes of colour and 2 that say which segment they belong to.
"""

import base64
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.labels import LabelSet
from mtl_bench.show import render
from mtl_bench.show.figures.frames import Shown
from mtl_bench.show.predict.files import OVERLAP, denser
from mtl_bench.show.predict.point_cloud import PointCloud, from_prediction
from mtl_bench.tasks.panoptic.targets import DIVISOR

TEMPLATE = "cloud.html.j2"
POINTS = 500_000  # at most: 11 bytes each, 4/3 of that in base64, are 7.3 MB
DRAWN_POINTS = 2**17  # from fewer pixels, points in between are interpolated
FARTHEST = 60.0  # camera heights: what is farther is left out
STEPS = 2**16 - 1


def cloud_page(shown: Shown, run: str) -> str:
    """The page of one frame's prediction.

    Args:
        run: which model this is from, in words.

    Raises:
        ValueError: a prediction without depth.
    """
    predicted = shown.predicted
    rows, columns = predicted.image_HW3.shape[:2]
    times = 1
    if predicted.depth_HW is not None:
        times = min(8, math.ceil((DRAWN_POINTS / (rows * columns)) ** 0.5))
        predicted = denser(predicted, times)
    cloud = from_prediction(predicted, shown.labels)
    notes = [f"{rows} x {columns} pixels"]
    notes += [f"interpolated to {times * rows} x {times * columns}"] * (times > 1)
    if predicted.camera_height is not None:
        near = cloud.points_N3[:, 2] <= FARTHEST * predicted.camera_height
        limit = f"{FARTHEST * predicted.camera_height:.0f} {cloud.unit}"
        notes.append(f"camera {predicted.camera_height:.3g} {cloud.unit} above the road")
        notes += [f"{np.count_nonzero(~near)} points beyond {limit} left out"] * (not near.all())
        cloud = chosen(cloud, near)
    if len(cloud) > POINTS:
        notes.append(f"{POINTS} of {len(cloud)} points")
        cloud = chosen(cloud, thinned(len(cloud), POINTS))
    about = {
        "name": shown.name,
        "run": run,
        "notes": "; ".join([*notes, f"{len(cloud)} points shown"]),
        "height": predicted.camera_height,
        "pitch": shown.camera.pitch_rad,
        "pixel": OVERLAP / float(predicted.K_33[0, 0]),
    }
    return page_of(cloud, shown.labels, about)


def page_of(cloud: PointCloud, labels: LabelSet, about: dict[str, Any]) -> str:
    """The page of any cloud.

    Args:
        about: name, run and notes, shown as they are; height of the camera above the road or None,
            and its pitch; pixel: size of a point at depth 1.
    """
    points_N3 = leveled(cloud.points_N3, about["pitch"])
    lowest = points_N3.min(0) if len(cloud) else np.zeros(3)
    extent = np.maximum((points_N3.max(0) if len(cloud) else np.ones(3)) - lowest, 1e-6)
    steps_N3 = np.rint((points_N3 - lowest) / extent * STEPS).astype("<u2")
    ids, segment_N = np.unique(cloud.ids_N, return_inverse=True)
    near, far = render.depth_range(cloud.points_N3[:, 2], cloud.unit)
    table = render.depth_colors(np.geomspace(near, far, 256)[None], near, far)
    facts = {
        **about,
        "unit": cloud.unit,
        "low": lowest.tolist(),
        "extent": extent.tolist(),
        "near": near,
        "far": far,
        "table": table[0].ravel().tolist(),
        "segments": [_segment(int(number), labels) for number in ids],
    }
    data = {
        "positions": _base64(steps_N3),
        "colors": _base64(cloud.colors_N3),
        "segments": _base64(segment_N.astype("<u2")),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    text = json.dumps(facts, separators=(",", ":")).replace("<", "\\u003c")
    return environment.get_template(TEMPLATE).render(about=about, facts=text, data=data) + "\n"


def leveled(points_N3: NDArray[np.float32], pitch_rad: float) -> NDArray[np.float32]:
    """From the camera's axes to such whose y is straight down; a positive pitch looks down."""
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    turn_33 = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]], np.float32)
    return np.asarray(points_N3 @ turn_33.T, np.float32)


def thinned(points: int, kept: int) -> NDArray[np.int64]:
    """One of each of so many stretches of points, at random: even, and without a pattern."""
    edges = np.linspace(0, points, kept + 1).astype(np.int64)
    return np.asarray(np.random.default_rng(0).integers(edges[:-1], edges[1:]))


def chosen(cloud: PointCloud, which_N: NDArray[Any]) -> PointCloud:
    return replace(
        cloud,
        points_N3=cloud.points_N3[which_N],
        colors_N3=cloud.colors_N3[which_N],
        class_N=cloud.class_N[which_N],
        instance_N=cloud.instance_N[which_N],
    )


def _segment(number: int, labels: LabelSet) -> dict[str, Any]:
    """Name and colour of an id's class, and its number where it is an instance."""
    label_id = number if number < DIVISOR else number // DIVISOR
    found = [label for label in labels.labels if label.label_id == label_id]
    return {
        "name": found[0].name if found else "no class",
        "color": list(found[0].color if found else render.panoptic.VOID),
        "instance": number if number >= DIVISOR else 0,
    }


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
