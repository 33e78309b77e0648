"""Edge-aware smoothness of the inverse depth."""

from collections.abc import Sequence

import torch
from torch import Tensor


def smoothness_loss(
    inverse_SB1HW: Sequence[Tensor],
    scales: Sequence[int],
    image_B3HW: Tensor,
    mask_BHW: Tensor,
) -> Tensor:
    """Gradients of the mean-normalised inverse depth, forgiven where the image has edges.

    Godard et al., "Unsupervised monocular depth estimation with left-right consistency" (CVPR
    2017), normalised as in Wang et al. (CVPR 2018). Scale i counts 2^-i. The mean over scales,
    where the paper writes a sum (its public code: the mean). A difference belongs to its left or
    top pixel, and counts where the mask has that pixel.

    Args:
        inverse_SB1HW: one inverse depth a scale, all at full resolution.
        scales: which scale each is, 0 = finest.
        image_B3HW: without colour jitter, [0, 1].
        mask_BHW: bool, pixels that count.
    """
    edges = [_edge_weights(image_B3HW, mask_BHW, axis) for axis in (-1, -2)]
    total = image_B3HW.new_zeros(())
    for scale, inverse_B1HW in zip(scales, inverse_SB1HW, strict=True):
        mean_B111 = inverse_B1HW.mean((-2, -1), keepdim=True).clamp(min=1e-7)
        normal_BHW = (inverse_B1HW / mean_B111).squeeze(1)
        for axis, edge_BHW in zip((-1, -2), edges, strict=True):
            total = total + (normal_BHW.diff(dim=axis).abs() * edge_BHW).sum() / 2**scale
    return total / len(scales)


@torch.no_grad()
def _edge_weights(image_B3HW: Tensor, mask_BHW: Tensor, axis: int) -> Tensor:
    """exp(-|image gradient|) over the number of pixels that count, 0 where one does not."""
    mask = mask_BHW.narrow(axis, 0, mask_BHW.shape[axis] - 1)
    return torch.exp(-image_B3HW.diff(dim=axis).abs().mean(1)) * mask / mask.sum().clamp(min=1)
