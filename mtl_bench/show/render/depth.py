"""Depth as colours, near bright and far dark, logarithmic, with a bar that says which is which."""

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.show.render import canvas
from mtl_bench.show.render.canvas import Image

NO_DEPTH = (110, 110, 110)  # of a pixel without a value
RANGES = {"m": (2.0, 80.0), "camera heights": (1.5, 60.0)}  # ends of the colours, by unit
_TABLE = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[::-1, None], cv2.COLORMAP_INFERNO)
_TABLE = _TABLE[:, 0, ::-1]  # RGB, near first


def depth_range(depth_HW: NDArray[np.floating[Any]], unit: str) -> tuple[float, float]:
    """Nearest and farthest depth of the colours: fixed for a known unit, else this map's own."""
    if unit in RANGES:
        return RANGES[unit]
    known = depth_HW[depth_HW > 0]
    if not known.size:
        return 1.0, 10.0
    near, far = np.percentile(known, (2, 98)).tolist()
    return near, max(far, 1.5 * near)


def depth_colors(depth_HW: NDArray[np.floating[Any]], near: float, far: float) -> Image:
    """RGB [H,W,3] of a depth map; NO_DEPTH where it is 0 or not finite."""
    depth = np.asarray(depth_HW, np.float32)
    known = np.isfinite(depth) & (depth > 0)
    share = np.log(np.where(known, depth, near) / near) / math.log(far / near)
    colors = _TABLE[np.clip(np.rint(share * 255), 0, 255).astype(np.uint8)]
    return np.where(known[..., None], colors, np.array(NO_DEPTH, np.uint8))


def ticks(near: float, far: float) -> list[float]:
    """1, 2 and 5 times powers of ten, from `near` to `far`."""
    powers = range(math.floor(math.log10(near)), math.ceil(math.log10(far)) + 1)
    values = [float(f"{digit}e{power}") for power in powers for digit in (1, 2, 5)]
    return [value for value in values if near * 0.999 <= value <= far * 1.001]


def scale_bar(width: int, near: float, far: float, unit: str) -> Image:
    """The colours from near to far, on white, with ticks, numbers and the unit."""
    size = canvas.text_height(width)
    picture = np.full((4 * size, width, 3), canvas.WHITE, np.uint8)
    left, right = size, width - 2 * size - canvas.text_width(unit, size)
    top, bottom = size // 2, round(1.7 * size)
    positions = np.linspace(0, 255, right - left).round().astype(int)
    picture[top:bottom, left:right] = _TABLE[positions]
    free = 0.0  # numbers do not overlap
    for value in ticks(near, far):
        x = left + (right - 1 - left) * math.log(value / near) / math.log(far / near)
        at = (round(x), bottom)
        cv2.line(picture, at, (at[0], bottom + size // 3), canvas.INK, 1 + size // 20)
        text = f"{value:g}"
        begin = x - canvas.text_width(text, size) / 2
        if begin >= free:
            canvas.write(picture, text, begin, bottom + 1.6 * size, size)
            free = begin + canvas.text_width(text, size) + size / 2
    canvas.write(picture, unit, right + size, bottom, size)
    return picture


def depth_picture(
    depth_HW: NDArray[np.floating[Any]], unit: str, span: tuple[float, float] | None = None
) -> Image:
    """The colours, enlarged where the map is tiny, above the bar.

    Args:
        span: nearest and farthest depth of the colours; None: `depth_range`.
    """
    near, far = span or depth_range(depth_HW, unit)
    colors = canvas.enlarge(depth_colors(depth_HW, near, far), canvas.factor(depth_HW.shape[1]))
    return canvas.stack([colors, scale_bar(colors.shape[1], near, far, unit)])
