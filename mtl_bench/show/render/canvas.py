"""What every picture needs: a canvas that is large enough, text on it, pictures side by side."""

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
MIN_WIDTH = 640  # pixels of a picture with text
WHITE, INK = (255, 255, 255), (30, 30, 30)
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


def text_height(width: int) -> int:
    """Of a line on a picture of this width, pixels."""
    return max(13, round(width / 72))


def text_width(text: str, height: int) -> int:
    return int(cv2.getTextSize(text, _FONT, _scale(height), _weight(height))[0][0])


def write(
    image_HW3: Image, text: str, left: float, base: float, height: int, color: tuple = INK
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


def _scale(height: int) -> float:
    return float(cv2.getFontScaleFromHeight(_FONT, height, 1))


def _weight(height: int) -> int:
    return max(1, round(height / 20))
