"""Photometric loss: how well the neighbouring frames, warped by depth and pose, rebuild a frame.

Shapes: S scales, B samples, N context frames, H x W pixels. Images are RGB in [0, 1], without
colour jitter.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.core import geometry
from mtl_bench.tasks.depth.ssim import PhotometricError


def photometric_loss(
    target_B3HW: Tensor,
    context_BN3HW: Tensor,
    inverse_SB1HW: Sequence[Tensor],
    K_B33: Tensor,
    mask_BHW: Tensor,
    transforms_BN44: Tensor,
    *,
    ssim_weight: float = 0.85,
    automask: bool = True,
) -> Tensor:
    """Smallest error per pixel among the warped context frames, averaged over pixels and scales.

    Godard et al., "Digging into self-supervised monocular depth estimation" (ICCV 2019), as in
    MGNet's paper. Choices where paper and public code differ, or where both are silent:

    - A warped frame whose projection leaves the view (the paper's M_v, absent from its code) is no
      candidate for the minimum; a pixel that no warped frame shows is left out of the mean.
    - `automask` puts the unwarped frames among the candidates. A tie goes to them: such a pixel
      pulls on nothing. No noise breaks ties, so that the loss is a function of its inputs.
    - A pixel counts where the mask has its whole SSIM window: a window that reaches onto the ego
      vehicle or the sky, which do not move, would say that the pixel does not either.
    - Out of view, the border's pixels stand in: black ones would reach into the view through SSIM's
      window and push the depth of the image's edge away.
    - The mean over scales, where the paper writes a sum (its public code: the mean).

    Args:
        inverse_SB1HW: one inverse depth a scale, all at full resolution.
        transforms_BN44: take points from the target's camera to each context frame's.
        mask_BHW: bool, False on sky, ego vehicle and padding.
    """
    inside_BHW = _erode(mask_BHW)
    error_of = PhotometricError(target_B3HW, ssim_weight)
    contexts = [frame_B3HW.contiguous() for frame_B3HW in context_BN3HW.unbind(1)]
    unwarped_BHW = None
    if automask:
        with torch.no_grad():
            unwarped_BHW = torch.stack([error_of(frame_B3HW) for frame_B3HW in contexts]).amin(0)
    total = target_B3HW.new_zeros(())
    for inverse_B1HW in inverse_SB1HW:
        depth_B1HW = geometry.depth_from_inverse(inverse_B1HW)
        errors, valids = [], []
        # one image at a time: on a CPU this is faster than one big call, as the cache holds it
        for frame_B3HW, transform_B44 in zip(contexts, transforms_BN44.unbind(1), strict=True):
            warped_B3HW, valid_B1HW = geometry.warp(
                frame_B3HW, depth_B1HW, transform_B44, K_B33, padding="border"
            )
            valids.append(valid_B1HW.squeeze(1))
            errors.append(error_of(warped_B3HW).masked_fill(~valids[-1], torch.inf))
        error_BHW = torch.stack(errors).amin(0)
        if unwarped_BHW is not None:
            error_BHW = torch.where(error_BHW < unwarped_BHW, error_BHW, unwarped_BHW)
        counts_BHW = torch.stack(valids).any(0) & inside_BHW
        total = total + error_BHW.masked_fill(~counts_BHW, 0).sum() / counts_BHW.sum().clamp(min=1)
    return total / len(inverse_SB1HW)


def _erode(mask_BHW: Tensor) -> Tensor:
    """True where the whole 3 x 3 neighbourhood inside the image is."""
    outside = F.max_pool2d((~mask_BHW).float().unsqueeze(1), 3, stride=1, padding=1)
    return outside.squeeze(1) == 0
