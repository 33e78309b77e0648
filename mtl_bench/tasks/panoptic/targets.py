"""What the panoptic task learns, made from Cityscapes' instance ids: classes, centers, offsets.

Rules of Panoptic-DeepLab (Cheng et al., CVPR 2020) as MGNet uses them. A *crowd* is a group of
things labelled as one region: it has a class, but no center, offset or extra weight. Void and crowd
pixels do not count in the center loss.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core import config
from mtl_bench.data.labels import IGNORE, LabelSet

DIVISOR = 1000  # instance id = label id * 1000 + number; below it: a plain label id
OUTSIDE = -1  # instance id of padding
LARGEST_ID = 2**16 - 1  # the files are 16-bit
_BYTE = 256  # values of one


@dataclass(frozen=True)
class Targets:
    """Arrays [H,W], except the offset [2,H,W]; meanings as in `Batch`."""

    semantic: NDArray[np.int64]
    semantic_weight: NDArray[np.float32]
    center: NDArray[np.float32]
    center_weight: NDArray[np.float32]
    offset: NDArray[np.float32]
    offset_weight: NDArray[np.float32]


def panoptic_targets(
    instance_ids_HW: NDArray[np.int32], labels: LabelSet, loss: config.Loss
) -> Targets:
    """Targets of one (augmented) frame.

    The center is the mean position of the instance's visible pixels: the heat map peaks at the
    nearest pixel (half to even), offsets point to the center itself.

    Args:
        instance_ids_HW: Cityscapes' instance ids, OUTSIDE on padding.
        labels: the classes.
        loss: `center_sigma`, `small_area` and `small_weight` are used.
    """
    height, width = instance_ids_HW.shape
    flat = np.maximum(instance_ids_HW, 0).ravel().astype(np.intp)
    areas = np.bincount(flat, minlength=LARGEST_ID + 1)
    ids = np.flatnonzero(areas)  # the segments; everything below is per segment, then looked up
    areas = areas[ids]
    position = np.zeros(LARGEST_ID + 1, np.uint8 if len(ids) <= _BYTE else np.intp)
    position[ids] = np.arange(len(ids))
    segment_HW = position[flat].reshape(height, width)

    classes = class_of_instance_id(labels)[ids]
    is_thing = np.isin(classes, labels.things)
    is_instance = is_thing & (ids >= DIVISOR)
    is_crowd = is_thing & ~is_instance
    small = is_instance & (areas < loss.small_area)

    y, x = np.nonzero(_draw(is_instance, segment_HW))
    inside = segment_HW[y, x]
    center_y = np.bincount(inside, weights=y, minlength=len(ids)) / areas  # 0 on others
    center_x = np.bincount(inside, weights=x, minlength=len(ids)) / areas

    offset_weight = _draw(is_instance, segment_HW)
    offset = np.empty((2, height, width), np.float32)
    rows, columns = np.arange(height, dtype=np.float32), np.arange(width, dtype=np.float32)
    np.subtract(_draw(center_y, segment_HW), rows[:, None], out=offset[0])
    np.subtract(_draw(center_x, segment_HW), columns, out=offset[1])
    offset *= offset_weight
    semantic_weight = _draw(np.where(small, loss.small_weight, 1.0), segment_HW)
    semantic_weight[instance_ids_HW == OUTSIDE] = 0
    return Targets(
        semantic=_draw(classes, segment_HW, np.uint8).astype(np.int64),
        semantic_weight=semantic_weight,
        center=_heat_map(
            np.rint(np.stack([center_y, center_x], 1)[is_instance]).astype(int),
            (height, width),
            loss.center_sigma,
        ),
        center_weight=_draw((classes != IGNORE) & ~is_crowd, segment_HW),
        offset=offset,
        offset_weight=offset_weight,
    )


def _draw(values: NDArray, segment_HW: NDArray, kind: type = np.float32) -> NDArray:
    """A picture of the segments' values; OpenCV's look-up is faster, but knows bytes alone."""
    if segment_HW.dtype != np.uint8:
        return values.astype(kind)[segment_HW]
    table: NDArray = np.zeros(_BYTE, kind)
    table[: len(values)] = values
    return cv2.LUT(segment_HW, table)


def _heat_map(
    centers_N2: NDArray[np.int_], size: tuple[int, int], sigma: float
) -> NDArray[np.float32]:
    """Maximum of Gaussians of height 1, each cut to a window of 6 sigma + 3 pixels."""
    reach = int(3 * sigma) + 1
    patch = _gaussian(reach, sigma)
    heat = np.zeros(size, np.float32)
    for y, x in centers_N2.tolist():
        top, left = max(y - reach, 0), max(x - reach, 0)
        window = heat[top : y + reach + 1, left : x + reach + 1]
        rows, columns = window.shape
        part = patch[top - y + reach :, left - x + reach :][:rows, :columns]
        np.maximum(window, part, out=window)
    return heat


@functools.cache
def _gaussian(reach: int, sigma: float) -> NDArray[np.float32]:
    square = np.arange(-reach, reach + 1) ** 2
    return np.exp(-(square[:, None] + square) / (2 * sigma**2)).astype(np.float32)


@functools.cache
def class_of_instance_id(labels: LabelSet) -> NDArray[np.uint8]:
    """[65536] look-up table from a file's instance id to a class index or IGNORE."""
    ids = np.arange(LARGEST_ID + 1)
    return labels.class_of_label_id()[np.where(ids < DIVISOR, np.minimum(ids, 255), ids // DIVISOR)]
