"""The loss terms: bootstrapped cross-entropy, the heat map of centers, and the offsets to them."""

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.core.labels import IGNORE


def semantic_loss(
    logits_BCHW: Tensor, target_BHW: Tensor, weight_BHW: Tensor, top_fraction: float
) -> Tensor | None:
    """Weighted cross-entropy of the K hardest valid pixels of the batch, divided by K.

    Yang et al., "DeeperLab" (2019), as in MGNet's paper: `-1/K sum_i w_i [p_i < t_K] log p_i`.
    Hard means a low probability of the true class: the weight does not enter the ranking. K is a
    fraction of the valid pixels (labelled, weight above 0), so that crop and batch size do not
    change its meaning; pixels that tie with the K-th are kept and counted. MGNet's public code
    ranks weighted losses, keeps all above -log 0.7, and counts absolute pixels, void ones included.

    Args:
        target_BHW: class indices, 255 = no label.
        top_fraction: in (0, 1]; 1 keeps every valid pixel.
    """
    logits_NC = logits_BCHW.movedim(1, -1).flatten(0, 2)  # as they lie in memory, channels last
    target_N, weight_N = target_BHW.flatten(), weight_BHW.flatten()
    loss_N = F.cross_entropy(logits_NC, target_N, ignore_index=IGNORE, reduction="none")
    valid_N = (target_N != IGNORE) & (weight_N > 0)
    loss_N, weight_N = loss_N[valid_N], weight_N[valid_N]
    if not len(loss_N):
        return None
    k = max(1, round(top_fraction * len(loss_N)))
    with torch.no_grad():
        kept_N = loss_N >= loss_N.topk(k, sorted=False).values.min()
    return (loss_N * weight_N * kept_N).sum() / kept_N.sum()


def center_loss(center_B1HW: Tensor, target_B1HW: Tensor, weight_B1HW: Tensor) -> Tensor | None:
    """Squared error of the heat map, averaged with these weights."""
    return _mean((center_B1HW - target_B1HW).square(), weight_B1HW)


def offset_loss(offset_B2HW: Tensor, target_B2HW: Tensor, weight_B1HW: Tensor) -> Tensor | None:
    """|dy| + |dx| in pixels, averaged over pixels with these weights.

    MGNet's normaliser: twice the value of Panoptic-DeepLab, which averages over both coordinates.
    """
    return _mean((offset_B2HW - target_B2HW).abs().sum(1, keepdim=True), weight_B1HW)


def _mean(error_B1HW: Tensor, weight_B1HW: Tensor) -> Tensor | None:
    """Weighted mean; None where no pixel counts."""
    weight = weight_B1HW.sum()
    return (error_B1HW * weight_B1HW).sum() / weight if weight > 0 else None
