"""Panoptic maps: class colours with a shade an instance and outlines, over the gray image."""

from collections.abc import Collection
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.labels import IGNORE, LabelSet
from mtl_bench.show.render import canvas
from mtl_bench.show.render.canvas import Image
from mtl_bench.tasks.panoptic.targets import DIVISOR, class_of_instance_id

STRENGTH = 0.65  # of the colours over the image
SHADES = (0.0, 0.45, -0.35, 0.25, 0.6, -0.15)  # towards white, or below 0 towards black
VOID = (120, 120, 120)  # colour of what has no class, where there is no image beneath


def segment_colors(instance_ids: NDArray[np.integer[Any]], labels: LabelSet) -> Image:
    """RGB [...,3] of Cityscapes' instance ids [...]: the class's, a shade of it an instance."""
    ids = instance_ids.astype(np.int64)
    classes = class_of_instance_id(labels)[ids]
    colors = np.append(labels.colors, [VOID], 0)
    color = colors[np.where(classes == IGNORE, len(labels), classes)].astype(np.float32)
    number = np.where(ids >= DIVISOR, ids % DIVISOR, 0)
    shade = np.array(SHADES, np.float32)[number % len(SHADES), None]
    color += np.where(shade > 0, shade * (255 - color), shade * color)
    return color.round().astype(np.uint8)


def overlay(image_HW3: Image, instance_ids_HW: NDArray[np.integer[Any]], labels: LabelSet) -> Image:
    """Colours over the gray image and white outlines around instances; what is void stays gray.

    Args:
        instance_ids_HW: Cityscapes' ids, of the image's size.
    """
    gray_HW = cv2.cvtColor(image_HW3, cv2.COLOR_RGB2GRAY)
    gray_HW3 = np.repeat(gray_HW[..., None], 3, 2)
    colors_HW3 = segment_colors(instance_ids_HW, labels)
    mixed_HW3 = cv2.addWeighted(colors_HW3, STRENGTH, gray_HW3, 1 - STRENGTH, 0)
    void_HW = class_of_instance_id(labels)[instance_ids_HW] == IGNORE
    mixed_HW3[void_HW] = gray_HW3[void_HW]
    mixed_HW3[outlines(instance_ids_HW, 1 + image_HW3.shape[1] // 960)] = 255
    return np.asarray(mixed_HW3, np.uint8)


def outlines(instance_ids_HW: NDArray[np.integer[Any]], thickness: int) -> NDArray[np.bool_]:
    """Where an instance ends and another segment begins."""
    ids = np.where(instance_ids_HW >= DIVISOR, instance_ids_HW, 0).astype(np.float32)
    square = np.ones((thickness + 1, thickness + 1), np.uint8)
    return np.asarray(cv2.dilate(ids, square) != cv2.erode(ids, square))


def legend(labels: LabelSet, width: int, shown: Collection[int] | None = None) -> Image:
    """Swatches and names of classes in columns on white; None: of all."""
    classes = [i for i in range(len(labels)) if shown is None or i in shown]
    size = canvas.text_height(width)
    row = round(size * 1.7)
    names = [labels.labels[i].name for i in classes]
    column = max((canvas.text_width(name, size) for name in names), default=0) + 3 * size
    columns = max(1, (width - size) // column)
    rows = -(-len(classes) // columns)
    picture = np.full((rows * row + size // 2, width, 3), canvas.WHITE, np.uint8)
    for place, index in enumerate(classes):
        left = size // 2 + place % columns * column
        base = (place // columns + 1) * row - size // 4
        color = labels.labels[index].color
        cv2.rectangle(picture, (left, base - size), (left + size, base), color, cv2.FILLED)
        canvas.write(picture, names[place], left + 1.5 * size, base, size)
    return picture


def panoptic_picture(
    image_HW3: Image,
    instance_ids_HW: NDArray[np.integer[Any]],
    labels: LabelSet,
    whole_legend: bool = False,
) -> Image:
    """The overlay, enlarged where it is tiny, above the legend.

    Args:
        whole_legend: with every class, so that all frames of a video have one; else with those in
            the image.
    """
    times = canvas.factor(image_HW3.shape[1])
    image = canvas.enlarge(image_HW3, times, smooth=True)
    ids = canvas.enlarge(instance_ids_HW.astype(np.int32), times)
    shown = None
    if not whole_legend:
        shown = set(np.unique(class_of_instance_id(labels)[instance_ids_HW]).tolist())
    return canvas.stack([overlay(image, ids, labels), legend(labels, image.shape[1], shown)])
