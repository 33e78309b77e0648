"""What a report says and draws of single tasks: their words, pictures, classes and scalings.

The other modules of this folder name no task, metric or data set.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.columns import FPS, Column
from mtl_bench.data.labels import CITYSCAPES20

Image = NDArray[np.uint8]

# --- classes and pictures -------------------------------------------------------------------------

CLASSES = [label.name for label in CITYSCAPES20.labels]  # in their order; others come behind


@dataclass(frozen=True)
class Picture:
    """How a result that a run keeps is drawn beside its truth."""

    key: str  # in samples.npz; the truth is true_<key>
    words: str  # in a figure's caption
    draw: Callable[[Image, NDArray[np.generic]], Image]  # input and map, of one size


def _ids(image: Image, ids_HW: NDArray[np.generic]) -> Image:
    from mtl_bench.show import render

    return render.overlay(image, np.asarray(ids_HW, np.int32), CITYSCAPES20)


def _depth(_: Image, depth_m_HW: NDArray[np.generic]) -> Image:
    from mtl_bench.show import render

    return render.depth_colors(np.asarray(depth_m_HW, np.float32), *NEAR_FAR_M)


NEAR_FAR_M = (2.0, 80.0)  # ends of the depth colours, logarithmic between them
PICTURES = (
    Picture("instance_ids", "panoptic maps", _ids),
    Picture(
        "depth_m",
        "depth (median-scaled, {:g} m bright to {:g} m dark, gray without value)".format(
            *NEAR_FAR_M
        ),
        _depth,
    ),
)

# --- a grid's report ------------------------------------------------------------------------------

TRIVIAL = (
    "Trivial predictor: the training split's mean depth image and most frequent class per "
    "pixel. It looks at no image; a network has to beat it. Its depth is in metres "
    "already, so nothing scales it under dgc."
)
COUNTED = "Images whose depth was not scaled from the road (all seeds together)"
COUNTS = {"dgc.failed": "no scale found", "dgc.fallback": "scale from surface normals"}

# --- latency --------------------------------------------------------------------------------------

AGREEMENT = (
    Column(
        *("panoptic_equal", "agreement.panoptic_equal", "panoptic", +1, 3, "% equal"),
        scale=100,
        short=True,
    ),
    Column(
        *("depth_rel", "agreement.depth_median_rel", "depth", -1, 0, "median diff."),
        scientific=True,
    ),
    Column("logits_max", "agreement.logits_max", "logits", -1, 0, "max diff.", scientific=True),
)
RESULT = "panoptic map and metric depth"  # at the end of what is timed
COMPARED = "panoptic pixels that are equal, depth relative, logits absolute"
RANDOM = (
    "Random weights: a convolution takes as long as with trained ones, but the number of "
    "instances that post-processing finds, and its time, may be another, and nearly tied "
    "logits make equal panoptic pixels say less."
)

# --- the paper's comparisons ----------------------------------------------------------------------

LITERATURE = (  # columns of numbers; {scaled} is where a protocol has the metrics of a scaling
    Column("pq", "panoptic.pq", "PQ", +1, 1, "%"),
    Column("abs_rel", "{scaled}.abs_rel", "AbsRel", -1, 3),
    Column("rmse", "{scaled}.rmse", "RMSE", -1, 3, "m"),
    Column("delta1", "{scaled}.delta1", "delta1", +1, 3, "< 1.25", tex=r"$\delta_1$"),
    Column("delta2", "{scaled}.delta2", "delta2", +1, 3, "< 1.25^2", tex=r"$\delta_2$"),
    Column("delta3", "{scaled}.delta3", "delta3", +1, 3, "< 1.25^3", tex=r"$\delta_3$"),
    Column("runtime_ms", "latency.mean_ms", "Runtime", -1, 1, "ms", part="cost"),
    FPS,
)


@dataclass(frozen=True)
class Scaling:
    """One way to scale a result before it is compared with the truth."""

    name: str
    place: str  # of its metrics, behind a protocol's prefix
    failed: str = ""  # where the frames are counted that it found no scale for


SCALINGS = (Scaling("median", "depth_median"), Scaling("dgc", "depth_dgc", "dgc.failed"))
