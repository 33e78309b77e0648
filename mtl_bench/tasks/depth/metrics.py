"""Depth errors per image, then their mean over images (Eigen et al., NeurIPS 2014).

The set of pixels is fixed by the ground truth alone: where it has a value inside the range, and the
crop. A prediction is scaled, clamped to the range and compared; what it takes for sky or the ego
vehicle is compared as well (MGNet's public code sets those pixels to 0 first, which couples the
depth error to the segmentation).
"""

import typing
from typing import Any

import numpy as np
from numpy.typing import NDArray

NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta1", "delta2", "delta3")
CROPS = {  # first and one-past-last row, then column: shares of the truth's size, rounded down
    "none": (0.0, 1.0, 0.0, 1.0),
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),  # Garg et al., ECCV 2016: KITTI
    # ManyDepth's code (Watson et al., CVPR 2021), Cityscapes: without the lowest quarter, rows 256+
    # and columns 192:1856 of 1024 x 2048
    "manydepth": (256 / 1024, 768 / 1024, 192 / 2048, 1856 / 2048),
}


class Limits(typing.Protocol):
    """Which pixels count, and the range that predictions are clamped to."""

    @property
    def min_depth_m(self) -> float: ...
    @property
    def max_depth_m(self) -> float: ...
    @property
    def depth_crop(self) -> str: ...


def evaluation_mask(true_m_HW: NDArray[Any], limits: Limits) -> NDArray[np.bool_]:
    """Pixels that count: strictly inside the range and, by `depth_crop`, one of CROPS."""
    top, bottom, left, right = CROPS[limits.depth_crop]
    height, width = true_m_HW.shape
    inside_HW = np.zeros(true_m_HW.shape, np.bool_)
    rows = slice(int(top * height), int(bottom * height))
    inside_HW[rows, int(left * width) : int(right * width)] = True
    return inside_HW & (true_m_HW > limits.min_depth_m) & (true_m_HW < limits.max_depth_m)


def median_scale(
    predicted_HW: NDArray[Any], true_m_HW: NDArray[Any], mask_HW: NDArray[np.bool_]
) -> float:
    """The factor that makes the medians over the mask equal; positive predictions are needed."""
    return float(np.median(true_m_HW[mask_HW]) / np.median(predicted_HW[mask_HW]))


def depth_errors(
    predicted_m: NDArray[Any], true_m: NDArray[Any], mask: NDArray[np.bool_], limits: Limits
) -> dict[str, float]:
    """Errors of one image over the mask: relative ones and deltas as fractions, rmse in metres.

    The prediction is clamped to the range first, after any scaling.
    """
    true = true_m[mask].astype(np.float64)
    predicted = predicted_m[mask].astype(np.float64).clip(limits.min_depth_m, limits.max_depth_m)
    difference = predicted - true
    ratio = np.maximum(predicted / true, true / predicted)
    values = (
        np.mean(np.abs(difference) / true),
        np.mean(difference**2 / true),
        np.sqrt(np.mean(difference**2)),
        np.sqrt(np.mean((np.log(predicted) - np.log(true)) ** 2)),
        *(np.mean(ratio < 1.25**power) for power in (1, 2, 3)),
    )
    return dict(zip(NAMES, map(float, values), strict=True))


class DepthErrors:
    """Mean over images of per-image errors. An image without a valid pixel is only counted."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.sums = np.zeros(len(NAMES))
        self.images = self.without_truth = 0

    def update(self, predicted_m_HW: NDArray[Any], true_m_HW: NDArray[Any]) -> None:
        """Add an image; the prediction is in metres already."""
        mask_HW = evaluation_mask(true_m_HW, self.limits)
        if mask_HW.any():
            errors = depth_errors(predicted_m_HW, true_m_HW, mask_HW, self.limits)
            self.sums += [errors[name] for name in NAMES]
            self.images += 1
        else:
            self.without_truth += 1

    def state(self) -> NDArray[np.float64]:
        """Sums of the errors, then both counts of images."""
        return np.array([*self.sums, self.images, self.without_truth])

    def add(self, state: NDArray[np.float64]) -> None:
        self.sums += state[: len(NAMES)]
        self.images += int(state[-2])
        self.without_truth += int(state[-1])

    def compute(self) -> dict[str, float]:
        """Every error's mean, and `images`, over how many; only that where there is none."""
        means = self.sums / max(self.images, 1)
        found = dict(zip(NAMES, means.tolist(), strict=True)) if self.images else {}
        return {**found, "images": self.images}
