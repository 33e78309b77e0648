"""Depth errors per image, then their mean over images (Eigen et al., NeurIPS 2014).

The set of pixels is fixed by the ground truth alone: where it has a value inside the range, and the
crop. A prediction is scaled, clamped to the range and compared; what it takes for sky or the ego
vehicle is compared as well (MGNet's public code sets those pixels to 0 first, which couples the
depth error to the segmentation).
"""

import numpy as np
from numpy.typing import NDArray

from mtl_bench import config

NAMES = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta1", "delta2", "delta3")


def evaluation_mask(true_m_HW: NDArray, ev: config.Evaluate) -> NDArray[np.bool_]:
    """Pixels that count. `ev.depth_crop`: none, or garg (Garg et al., ECCV 2016: KITTI's crop).

    Raises:
        ValueError: another crop.
    """
    mask_HW = (true_m_HW > ev.min_depth_m) & (true_m_HW < ev.max_depth_m)
    if ev.depth_crop == "garg":
        height, width = true_m_HW.shape
        inside_HW = np.zeros_like(mask_HW)
        rows = slice(int(0.40810811 * height), int(0.99189189 * height))
        inside_HW[rows, int(0.03594771 * width) : int(0.96405229 * width)] = True
        mask_HW &= inside_HW
    elif ev.depth_crop != "none":
        raise ValueError(f"evaluate.depth_crop must be none or garg, not '{ev.depth_crop}'")
    return mask_HW


def median_scale(predicted_HW: NDArray, true_m_HW: NDArray, mask_HW: NDArray[np.bool_]) -> float:
    """The factor that makes the medians over the mask equal; positive predictions are needed."""
    return float(np.median(true_m_HW[mask_HW]) / np.median(predicted_HW[mask_HW]))


def depth_errors(
    predicted_m: NDArray, true_m: NDArray, mask: NDArray[np.bool_], ev: config.Evaluate
) -> dict[str, float]:
    """Errors of one image over the mask: relative ones and deltas as fractions, rmse in metres.

    The prediction is clamped to `ev`'s range first, after any scaling.
    """
    true = true_m[mask].astype(np.float64)
    predicted = predicted_m[mask].astype(np.float64).clip(ev.min_depth_m, ev.max_depth_m)
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

    def __init__(self, ev: config.Evaluate) -> None:
        self.ev = ev
        self.errors: list[dict[str, float]] = []
        self.without_truth = 0

    def update(self, predicted_m_HW: NDArray, true_m_HW: NDArray) -> None:
        """Add an image; the prediction is in metres already."""
        mask_HW = evaluation_mask(true_m_HW, self.ev)
        if mask_HW.any():
            self.errors.append(depth_errors(predicted_m_HW, true_m_HW, mask_HW, self.ev))
        else:
            self.without_truth += 1

    def compute(self) -> dict[str, float]:
        """Every error's mean, and `images`, over how many; only that where there is none."""
        count = len(self.errors)
        means = {n: sum(e[n] for e in self.errors) / count for n in NAMES} if count else {}
        return {**means, "images": count}
