"""The loss terms: how well warped neighbours rebuild a frame, and the smoothness of depth.

Shapes: S scales, B samples, N neighbouring frames, H x W pixels. Images are RGB in [0, 1], without
colour jitter.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from mtl_bench.core import geometry


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
    hints: float = 0.0,
) -> Tensor | None:
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
    - The mean over scales, where the paper writes a sum (its public code: the mean). A scale at
      which no pixel counts is in no mean; where none is left, there is no loss.

    Args:
        inverse_SB1HW: one inverse depth a scale, all at full resolution.
        transforms_BN44: take points from the target's camera to each context frame's.
        mask_BHW: bool, False on sky, ego vehicle and padding.
        hints: weight of `hint_error`.
    """
    inside_BHW = _erode(mask_BHW)
    error_of = PhotometricError(target_B3HW, ssim_weight)
    contexts = [frame_B3HW.contiguous() for frame_B3HW in context_BN3HW.unbind(1)]
    unwarped_BHW = None
    if automask:
        with torch.no_grad():
            unwarped_BHW = torch.stack([error_of(frame_B3HW) for frame_B3HW in contexts]).amin(0)

    def rebuilt(depth_B1HW: Tensor) -> tuple[Tensor, Tensor]:
        """Error [B,H,W] of the warped frames, infinite where none is in view; and where one is."""
        errors, valids = [], []
        # one image at a time: on a CPU this is faster than one big call, as the cache holds it
        for frame_B3HW, transform_B44 in zip(contexts, transforms_BN44.unbind(1), strict=True):
            warped_B3HW, valid_B1HW = geometry.warp(
                frame_B3HW, depth_B1HW, transform_B44, K_B33, padding="border"
            )
            valids.append(valid_B1HW.squeeze(1))
            errors.append(error_of(warped_B3HW).masked_fill(~valids[-1], torch.inf))
        return torch.stack(errors).amin(0), torch.stack(valids).any(0)

    total, scales = target_B3HW.new_zeros(()), target_B3HW.new_zeros((), dtype=torch.int64)
    for inverse_B1HW in inverse_SB1HW:
        depth_B1HW = geometry.depth_from_inverse(inverse_B1HW)
        error_BHW, seen_BHW = rebuilt(depth_B1HW)
        if unwarped_BHW is not None:
            error_BHW = torch.where(error_BHW < unwarped_BHW, error_BHW, unwarped_BHW)
        if hints:
            error_BHW = error_BHW + hints * hint_error(depth_B1HW, error_BHW, rebuilt)
        counts_BHW = seen_BHW & inside_BHW
        number = counts_BHW.sum()
        total = total + error_BHW.masked_fill(~counts_BHW, 0).sum() / number.clamp(min=1)
        scales += number > 0
    return total / int(scales) if scales > 0 else None


REACH = 0.4  # of the logarithm of depth, of the farthest hint
RANGE = (0.25, 5.0)  # of a pixel's weight: the sky's depth can be anything


def hint_error(
    depth_B1HW: Tensor, error_BHW: Tensor, rebuilt: Callable[[Tensor], tuple[Tensor, Tensor]]
) -> Tensor:
    """How far depth is from a better one, where one is found, over the image's depth: [B,H,W].

    The photometric error hardly tells far from very far: the flow of a far pixel is small, and so
    is its gradient. Which of two depths rebuilds a pixel better is as clear there as it is near. So
    the depth of each sample is tried once farther and once nearer by one factor, from small ones at
    the batch's first sample to exp(REACH) at its last. Where one of them is better it is a label:
    the error is the difference of logarithms, weighed by depth. After Watson et al.,
    "Self-supervised monocular depth hints" (ICCV 2019), whose hints are found by stereo matching.

    Args:
        error_BHW: of the depth.
        rebuilt: error [B,H,W] of another depth, infinite out of view; and where it is in view.
    """
    log_BHW = depth_B1HW.log().squeeze(1)
    with torch.no_grad():
        count = len(depth_B1HW)
        places_B = torch.arange(1, count + 1, device=depth_B1HW.device, dtype=depth_B1HW.dtype)
        step_B11 = (REACH / count * places_B)[:, None, None]
        factor_B111 = step_B11.exp().unsqueeze(1)
        farther_BHW, _ = rebuilt(depth_B1HW * factor_B111)
        nearer_BHW, _ = rebuilt(depth_B1HW / factor_B111)
        hint_BHW = log_BHW + torch.where(farther_BHW < nearer_BHW, step_B11, -step_B11)
        better_BHW = torch.minimum(farther_BHW, nearer_BHW) < error_BHW
        median_B11 = depth_B1HW.flatten(1).median(1).values[:, None, None]
        weight_BHW = (depth_B1HW.squeeze(1) / median_B11).clamp(*RANGE)
        weight_BHW *= better_BHW / weight_BHW.mean((1, 2), keepdim=True)
    return (log_BHW - hint_BHW).abs() * weight_BHW


def _erode(mask_BHW: Tensor) -> Tensor:
    """True where the whole 3 x 3 neighbourhood inside the image is."""
    outside = F.max_pool2d((~mask_BHW).float().unsqueeze(1), 3, stride=1, padding=1)
    return outside.squeeze(1) == 0


# --- SSIM -----------------------------------------------------------------------------------------


C1, C2 = 0.01**2, 0.03**2  # for images in [0, 1]


class PhotometricError:
    """Compares images with one target, whose local statistics are computed once.

    Wang et al., "Image quality assessment: from error visibility to structural similarity" (2004),
    with the 3 x 3 mean window and reflected border of Monodepth2 and MGNet (kornia's SSIM has a
    Gaussian window only).
    """

    def __init__(self, target_B3HW: Tensor, ssim_weight: float = 0.85):
        self.ssim_weight = ssim_weight
        self.target = target_B3HW
        self.padded = _reflect(target_B3HW)
        self.mean = _local_mean(self.padded)
        # constants of b1 and of b1 + b2 below
        self.b1 = self.mean.square() + C1
        self.b = _local_mean(self.padded.square()) + (C1 + C2)

    def __call__(self, image_B3HW: Tensor) -> Tensor:
        """ssim_weight * (1 - SSIM) / 2 + (1 - ssim_weight) * |difference|, mean over RGB: [B,H,W].

        Differentiable once, with respect to the image.
        """
        error: Tensor = _Error.apply(_reflect(image_B3HW), self)
        return error


class _Error(torch.autograd.Function):
    """The error of an image x, padded by one pixel, to a target y.

    With m, s, p the local means of x, x^2, x y, and n, t those of y, y^2: SSIM = 4 a1 a2 / (b1 b2),
    where a1 = m n + C1/2, a2 = p - m n + C2/2, b1 = m^2 + n^2 + C1, b2 = s - m^2 + t - n^2 + C2.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: PhotometricError) -> Tensor:
        m = _local_mean(x)
        a1 = (m * y.mean).add_(C1 / 2)
        a2 = _local_mean(x * y.padded).sub_(a1).add_((C1 + C2) / 2)
        b1 = torch.addcmul(y.b1, m, m)
        b2 = _local_mean(x.square()).sub_(b1).add_(y.b)
        scale = (b1 * b2).reciprocal_().mul_(4)
        ssim = (a1 * a2).mul_(scale)
        difference = x[..., 1:-1, 1:-1] - y.target
        if ctx.needs_input_grad[0]:
            ctx.y = y
            by_s = (ssim / b2).neg_()
            by_p = a1 * scale
            # n (a2 - a1) scale + 2 m ssim (1 / b2 - 1 / b1), the latter with 4 / (b1 b2) taken out
            by_m = a2.sub_(a1).mul_(y.mean).addcmul_(b1.sub_(b2).mul_(m), ssim, value=0.5)
            ctx.save_for_backward(x, difference.sign(), by_m.mul_(scale), by_s, by_p)
        half = y.ssim_weight / 2
        error = difference.abs_().mul_(1 - y.ssim_weight).sub_(ssim, alpha=half).mean(-3)
        # SSIM is at most 1, but for rounding: the gradient need not know the bound
        return error.add_(half).clamp_(min=0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, sign, by_m, by_s, by_p = ctx.saved_tensors
        weight = ctx.y.ssim_weight
        grad = grad.unsqueeze(-3) / x.shape[-3]
        grad_ssim = grad * (-weight / 2)
        out = _transposed_mean(grad_ssim * by_s).mul_(x).mul_(2)
        out.add_(_transposed_mean(grad_ssim * by_p).mul_(ctx.y.padded))
        out.add_(_transposed_mean(grad_ssim * by_m))
        out[..., 1:-1, 1:-1].add_(grad * sign, alpha=1 - weight)
        return out, None


def _reflect(image: Tensor) -> Tensor:
    return F.pad(image, (1, 1, 1, 1), mode="reflect")


def _local_mean(padded: Tensor) -> Tensor:
    """Mean of every whole 3 x 3 window; two pixels less in both directions."""
    rows = (padded[..., :-2, :] + padded[..., 2:, :]).add_(padded[..., 1:-1, :])
    return (rows[..., :-2] + rows[..., 2:]).add_(rows[..., 1:-1]).mul_(1 / 9)


def _transposed_mean(grad: Tensor) -> Tensor:
    """What flows back through `_local_mean`; two pixels more in both directions."""
    return _local_mean(F.pad(grad, (2, 2, 2, 2)))


# --- smoothness -----------------------------------------------------------------------------------


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
