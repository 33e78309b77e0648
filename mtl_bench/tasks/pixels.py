"""Passes over maps of the image's size, for which torch's own loops are slow on the CPU.

There numpy and OpenCV take a third of the time or less: their comparisons, counts and look-ups are
vectorised (2M floats compared on one core: 0.6 ms, torch on two 1.7). On CUDA and in an exported
graph torch does the same; `tests/tasks/test_pixels.py` holds the two against each other.
Shapes: B images, H x W pixels, N of them.
"""

import functools
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

BYTES = 256  # values of a uint8
STRIP = 64  # rows


def where(mask: Tensor) -> Tensor:
    """Flat indices [N] of what is true, int64, in order."""
    if _by_torch(mask):
        return mask.flatten().nonzero()[:, 0]
    return torch.from_numpy(np.flatnonzero(_array(mask)))


def filled(value_HW: NDArray[Any], known_HW: NDArray[np.bool_]) -> NDArray[Any]:
    """Each pixel that is not known has the nearest known one's value."""
    at = ndimage.distance_transform_edt(~known_HW, return_distances=False, return_indices=True)
    found: NDArray[Any] = value_HW[tuple(at)]
    return found


def equal(map_: Tensor, value: int) -> Tensor:
    """Where a map has this value."""
    return map_ == value if _by_torch(map_) else torch.from_numpy(_array(map_) == value)


def member(class_BHW: Tensor, classes: tuple[int, ...]) -> Tensor:
    """Where the class is one of these: a comparison or two for each run of neighbours."""
    runs: list[list[int]] = []
    for c in sorted(classes):
        if runs and runs[-1][1] == c - 1:
            runs[-1][1] = c
        else:
            runs.append([c, c])
    parts = []
    for first, last in runs:
        if first == last:
            parts.append(equal(class_BHW, first))
        elif class_BHW.dtype == torch.uint8:  # one comparison: what is below wraps around
            parts.append(class_BHW - first <= last - first)
        else:
            parts.append((class_BHW >= first) & (class_BHW <= last))
    return functools.reduce(torch.bitwise_or, parts)


def areas(value_BHW: Tensor) -> Tensor:
    """Pixels of each value of a uint8 map, [B,256] int64; exact below 2 ** 24 pixels."""
    if not _by_torch(value_BHW):
        counts = [cv2.calcHist([v], [0], None, [BYTES], [0, BYTES]) for v in _array(value_BHW)]
        return torch.from_numpy(np.stack(counts)).flatten(1).long()
    index = value_BHW.flatten(1).int() + _first(value_BHW)
    return torch.bincount(index.flatten(), minlength=len(value_BHW) * BYTES).view(-1, BYTES)


def look_up(table_BV: Tensor, value_BHW: Tensor) -> Tensor:
    """[B,H,W] of each image's own table [B,256] int32, at the values of a uint8 map."""
    if not _by_torch(value_BHW):
        found = np.empty(value_BHW.shape, np.int32)
        for value, table, place in zip(_array(value_BHW), _array(table_BV), found, strict=True):
            cv2.LUT(value, table, dst=place)
        return torch.from_numpy(found)
    index = value_BHW.flatten(1).int() + _first(value_BHW)
    return table_BV.flatten().index_select(0, index.flatten()).view(value_BHW.shape)


def peaks(heat_B1HW: Tensor, kernel: int, threshold: float) -> Tensor:
    """Where a pixel is above the threshold and nothing in the window around it is above it.

    Args:
        kernel: side of the window, odd.
    """
    if _by_torch(heat_B1HW):
        half = kernel // 2  # one axis after the other: a quarter of the comparisons
        highest_B1HW = F.max_pool2d(heat_B1HW, (kernel, 1), stride=1, padding=(half, 0))
        highest_B1HW = F.max_pool2d(highest_B1HW, (1, kernel), stride=1, padding=(0, half))
        return (heat_B1HW == highest_B1HW) & (heat_B1HW > threshold)
    mask_B1HW = np.empty(heat_B1HW.shape, np.bool_)
    for (heat_HW,), (mask_HW,) in zip(_array(heat_B1HW), mask_B1HW, strict=True):
        _peaks(heat_HW, kernel, np.float32(threshold), mask_HW)
    return torch.from_numpy(mask_B1HW)


def _peaks(
    heat_HW: NDArray[np.float32], kernel: int, threshold: np.float32, mask_HW: NDArray[np.bool_]
) -> None:
    """In strips that the cache holds."""
    window, half = np.ones((kernel, kernel), np.uint8), kernel // 2
    for first in range(0, len(heat_HW), STRIP):
        top, own_SW = max(first - half, 0), heat_HW[first : first + STRIP]
        highest_SW = cv2.dilate(heat_HW[top : first + STRIP + half], window)[first - top :]
        mask_SW = np.equal(own_SW, highest_SW[: len(own_SW)], out=mask_HW[first : first + STRIP])
        mask_SW &= own_SW > threshold


def _by_torch(map_: Tensor) -> bool:
    return map_.device.type != "cpu" or torch.compiler.is_exporting()


def _array(map_: Tensor) -> NDArray[Any]:
    """The map's own memory; OpenCV gets as many threads as torch has, which the user sets."""
    cv2.setNumThreads(torch.get_num_threads())
    return map_.detach().numpy()


def _first(value_BHW: Tensor) -> Tensor:
    """Of each image's part in a table of all [B,1]."""
    images = torch.arange(len(value_BHW), device=value_BHW.device, dtype=torch.int32)
    return images[:, None] * BYTES


def sampled(array_HW: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """A map at another size: of each pixel the one that its middle falls on."""
    if array_HW.shape == size:
        return array_HW
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int)
        for new, old in zip(size, array_HW.shape, strict=True)
    )
    return array_HW[np.ix_(rows, columns)]
