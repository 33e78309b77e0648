"""What every picture needs: a canvas that is large enough, text on it, pictures side by side.

Images are uint8 [H,W,3] RGB. Whatever has text on it is drawn at `MIN_WIDTH` pixels or more, so
that it can be read over inputs of any size.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Color = tuple[int, int, int]  # RGB
Image = NDArray[np.uint8]
MIN_WIDTH = 640  # pixels of a picture with text
WHITE, INK = (255, 255, 255), (30, 30, 30)
VOID = (120, 120, 120)  # of what has no class
UNKNOWN = (110, 110, 110)  # of a pixel without a value
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def factor(width: int) -> int:
    """How many times a picture of this width is enlarged to have room for text."""
    return max(1, math.ceil(MIN_WIDTH / width))


def enlarge(values_HW: NDArray[Any], times: int, smooth: bool = False) -> NDArray[Any]:
    """A map or image at a multiple of its size; without `smooth` no value is invented."""
    if times == 1:
        return values_HW
    how = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(values_HW, None, fx=times, fy=times, interpolation=how))


def nearest(values_HW: NDArray[Any], image_HW3: Image) -> NDArray[Any]:
    """A map at an image's size; no value is invented."""
    size = image_HW3.shape[1::-1]  # OpenCV's order
    return np.asarray(cv2.resize(values_HW, size, interpolation=cv2.INTER_NEAREST_EXACT))


def text_height(width: int) -> int:
    """Of a line on a picture of this width, pixels."""
    return max(13, round(width / 72))


def text_width(text: str, height: int) -> int:
    return int(cv2.getTextSize(text, _FONT, _scale(height), _weight(height))[0][0])


def write(
    image_HW3: Image,
    text: str,
    left: float,
    base: float,
    height: int,
    color: tuple[int, int, int] = INK,
) -> None:
    """Draw one line of text into an image; `base` is the row that its letters stand on."""
    place = (round(left), round(base))
    cv2.putText(image_HW3, text, place, _FONT, _scale(height), color, _weight(height), cv2.LINE_AA)


def stack(pictures: Sequence[Image], gap: int = 0) -> Image:
    """Below each other, on white, as wide as the widest."""
    width = max(picture.shape[1] for picture in pictures)
    rows = sum(picture.shape[0] for picture in pictures) + gap * (len(pictures) - 1)
    canvas = np.full((rows, width, 3), WHITE, np.uint8)
    top = 0
    for picture in pictures:
        canvas[top : top + picture.shape[0], : picture.shape[1]] = picture
        top += picture.shape[0] + gap
    return canvas


def beside(pictures: Sequence[Image], gap: int = 0) -> Image:
    """In a line from left to right, on white, as high as the highest."""
    turned = [picture.transpose(1, 0, 2) for picture in pictures]
    return np.ascontiguousarray(stack(turned, gap).transpose(1, 0, 2))


@dataclass(frozen=True)
class LogScale:
    """Colours of a positive quantity, logarithmic between two ends."""

    low: float
    high: float
    unit: str
    table_N3: Image  # 256 colours, the low end's first

    def place(self, value: float) -> float:
        """0 at the low end, 1 at the high one."""
        return math.log(value / self.low) / math.log(self.high / self.low)

    def colors(self, values_HW: NDArray[np.floating[Any]]) -> Image:
        """RGB [H,W,3] of a map; UNKNOWN where it is not finite or not positive."""
        values = np.asarray(values_HW, np.float32)
        known = np.isfinite(values) & (values > 0)
        share = np.log(np.where(known, values, self.low) / self.low)
        share = share / math.log(self.high / self.low)
        colors = self.table_N3[np.clip(np.rint(share * 255), 0, 255).astype(np.uint8)]
        return np.where(known[..., None], colors, np.array(UNKNOWN, np.uint8))

    def ramp(self, pixels: int) -> Image:
        """So many colours [1,pixels,3] from end to end."""
        return self.colors(np.geomspace(self.low, self.high, pixels)[None])

    def ticks(self) -> list[float]:
        """1, 2 and 5 times powers of ten, from end to end."""
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        values = [
            float(f"{digit}e{power}") for power in range(first, last + 1) for digit in (1, 2, 5)
        ]
        return [value for value in values if self.low * 0.999 <= value <= self.high * 1.001]

    def bar(self, width: int) -> Image:
        """The colours from end to end, on white, with ticks, numbers and the unit."""
        size = text_height(width)
        picture = np.full((4 * size, width, 3), WHITE, np.uint8)
        left, right = size, width - 2 * size - text_width(self.unit, size)
        top, bottom = size // 2, round(1.7 * size)
        positions = np.linspace(0, 255, right - left).round().astype(int)
        picture[top:bottom, left:right] = self.table_N3[positions]
        free = 0.0  # numbers do not overlap
        for value in self.ticks():
            x = left + (right - 1 - left) * self.place(value)
            at = (round(x), bottom)
            cv2.line(picture, at, (at[0], bottom + size // 3), INK, 1 + size // 20)
            text = f"{value:g}"
            begin = x - text_width(text, size) / 2
            if begin >= free:
                write(picture, text, begin, bottom + 1.6 * size, size)
                free = begin + text_width(text, size) + size / 2
        write(picture, self.unit, right + size, bottom, size)
        return picture


def _scale(height: int) -> float:
    return float(cv2.getFontScaleFromHeight(_FONT, height, 1))


def _weight(height: int) -> int:
    return max(1, round(height / 20))
