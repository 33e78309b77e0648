"""Instance terms: the heat map of centers and the offsets that lead to them."""

import torch
from torch import Tensor


def center_loss(center_B1HW: Tensor, target_B1HW: Tensor, weight_B1HW: Tensor) -> Tensor:
    """Squared error of the heat map, averaged with these weights."""
    return _mean((center_B1HW - target_B1HW).square(), weight_B1HW)


def offset_loss(offset_B2HW: Tensor, target_B2HW: Tensor, weight_B1HW: Tensor) -> Tensor:
    """|dy| + |dx| in pixels, averaged over pixels with these weights.

    MGNet's normaliser: twice the value of Panoptic-DeepLab, which averages over both coordinates.
    """
    return _mean((offset_B2HW - target_B2HW).abs().sum(1, keepdim=True), weight_B1HW)


def _mean(error_B1HW: Tensor, weight_B1HW: Tensor) -> Tensor:
    """Weighted mean, an exact zero in the graph where no pixel counts."""
    weight = weight_B1HW.sum()
    return (error_B1HW * weight_B1HW).sum() / torch.where(weight > 0, weight, 1.0)
