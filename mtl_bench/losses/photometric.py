"""Photometric loss: how well the neighbouring frames, warped by depth and pose, rebuild a frame.

Shapes: S scales, B samples, N context frames, M images compared with one target, H x W pixels.
Images are RGB in [0, 1], without colour jitter.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench import geometry
from mtl_bench.losses.ssim import PhotometricError


def photometric_loss(
    target_B3HW: Tensor,
    context_BN3HW: Tensor,
    inverse_SB1HW: Sequence[Tensor],
    transforms_BN44: Tensor,
    K_B33: Tensor,
    mask_BHW: Tensor,
    *,
    ssim_weight: float = 0.85,
    automask: bool = True,
) -> Tensor:
    """Smallest error per pixel among the warped context frames, averaged over pixels and scales.

    Godard et al., "Digging into self-supervised monocular depth estimation" (ICCV 2019), as in
    MGNet's paper. Choices where paper and public code differ, or where both are silent:

    - A warped frame whose projection leaves the view (the paper's M_v, absent from its code) is no
      candidate for the minimum; a pixel that no warped frame shows is left out of the mean.
    - `automask` puts the unwarped frames among the candidates. A tie goes to them: such a pixel pulls
      on nothing. No noise breaks ties, so that the loss is a function of its inputs.
    - The mean over scales, where the paper writes a sum (its public code: the mean).

    Args:
        inverse_SB1HW: one inverse depth a scale, all at full resolution.
        transforms_BN44: take points from the target's camera to each context frame's.
        mask_BHW: bool, False on sky, ego vehicle and padding.
    """
    error_of = PhotometricError(target_B3HW, ssim_weight)
    context_NB3HW = context_BN3HW.transpose(0, 1)
    transforms_NB44 = transforms_BN44.transpose(0, 1)
    with torch.no_grad():
        unwarped_BHW = error_of(context_NB3HW).amin(0) if automask else None
    total = target_B3HW.new_zeros(())
    for inverse_B1HW in inverse_SB1HW:  # one scale at a time: its tensors stay in the cache
        depth_B1HW = geometry.depth_from_inverse(inverse_B1HW)
        warped_NB3HW, valid_NBHW = _warp_all(context_NB3HW, depth_B1HW, transforms_NB44, K_B33)
        error_NBHW = error_of(warped_NB3HW).masked_fill(~valid_NBHW, torch.inf)
        error_BHW = error_NBHW.amin(0)
        if unwarped_BHW is not None:
            error_BHW = torch.where(error_BHW < unwarped_BHW, error_BHW, unwarped_BHW)
        counts_BHW = valid_NBHW.any(0) & mask_BHW
        total = total + error_BHW.masked_fill(~counts_BHW, 0).sum() / counts_BHW.sum().clamp(min=1)
    return total / len(inverse_SB1HW)


def _warp_all(
    context_NB3HW: Tensor, depth_B1HW: Tensor, transforms_NB44: Tensor, K_B33: Tensor
) -> tuple[Tensor, Tensor]:
    """Every context frame warped into the target [N,B,3,H,W], and its mask [N,B,H,W]: one call."""
    lead = context_NB3HW.shape[:2]
    warped, valid = geometry.warp(
        context_NB3HW.flatten(0, 1),
        depth_B1HW.expand(*lead, *depth_B1HW.shape[1:]).flatten(0, 1),
        transforms_NB44.flatten(0, 1),
        K_B33.expand(*lead, 3, 3).flatten(0, 1),
    )
    return warped.unflatten(0, lead), valid.squeeze(1).unflatten(0, lead)
