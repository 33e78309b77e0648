"""Weighted bootstrapped cross-entropy of the semantic logits."""

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.data.labels import IGNORE


def semantic_loss(
    logits_BCHW: Tensor, target_BHW: Tensor, weight_BHW: Tensor, top_fraction: float
) -> Tensor:
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
    loss_BHW = F.cross_entropy(logits_BCHW, target_BHW, ignore_index=IGNORE, reduction="none")
    valid_BHW = (target_BHW != IGNORE) & (weight_BHW > 0)
    loss_N, weight_N = loss_BHW[valid_BHW], weight_BHW[valid_BHW]
    if not len(loss_N):
        return (logits_BCHW * 0.0).sum()
    k = max(1, round(top_fraction * len(loss_N)))
    with torch.no_grad():
        kept_N = loss_N >= loss_N.topk(k, sorted=False).values.min()
    return (loss_N * weight_N * kept_N).sum() / kept_N.sum()
