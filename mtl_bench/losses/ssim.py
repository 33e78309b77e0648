"""SSIM + L1 between images and one target, with its gradient written out: the training's hot spot.

Autograd would keep a dozen full-size intermediates and refill one for every slice of the mean
filter; the closed form keeps four and is several times faster on a CPU.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

C1, C2 = 0.01**2, 0.03**2  # for images in [0, 1]


class PhotometricError:
    """Compares images with one target, whose local statistics are computed once.

    Wang et al., "Image quality assessment: from error visibility to structural similarity" (2004),
    with the 3 x 3 mean window and reflected border of Monodepth2 and MGNet (kornia's SSIM has a
    Gaussian window only).
    """

    def __init__(self, target_B3HW: Tensor, ssim_weight: float = 0.85):
        self.target = target_B3HW
        self.ssim_weight = ssim_weight
        self.mean = local_mean(target_B3HW)
        self.mean2_C1 = self.mean.square() + C1
        self.variance_C2 = local_mean(target_B3HW.square()) - self.mean.square() + C2

    def __call__(self, image_MB3HW: Tensor) -> Tensor:
        """ssim_weight * (1 - SSIM) / 2 + (1 - ssim_weight) * |difference|, mean over RGB: [M,B,H,W].

        Differentiable once, with respect to the image.
        """
        error: Tensor = _Error.apply(image_MB3HW, self)
        return error


class _Error(torch.autograd.Function):
    """With m, s, p the local means of x, x*x, x*y: SSIM = a1 a2 / (b1 b2) as below."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, to: PhotometricError) -> Tensor:
        m = local_mean(x)
        a1 = m * to.mean
        a2 = local_mean(x * to.target).sub_(a1).mul_(2).add_(C2)  # 2 (p - m m_y) + C2
        a1.mul_(2).add_(C1)  # 2 m m_y + C1
        b1 = m.square()
        b2 = local_mean(x.square()).sub_(b1).add_(to.variance_C2)  # s - m^2 + v_y + C2
        b1.add_(to.mean2_C1)  # m^2 + m_y^2 + C1
        ssim = (a1 * a2).div_(b1).div_(b2)
        difference = x - to.target
        if ctx.needs_input_grad[0]:
            scale = -0.5 * to.ssim_weight / x.shape[-3]
            by_s = (ssim / b2).mul_(-scale)
            inverse = (b1 * b2).reciprocal_().mul_(2 * scale)
            by_p = a1 * inverse
            # 2 m_y (a2 - a1) / (b1 b2) + 2 m ssim (1 / b2 - 1 / b1)
            by_m = a2.sub_(a1).mul_(to.mean).addcmul_(b1.sub_(b2).mul_(m), ssim).mul_(inverse)
            ctx.save_for_backward(x, difference.sign(), by_m, by_s, by_p)
            ctx.to = to
        # SSIM lies in [-1, 1]: the clamp removes rounding alone, so the gradient need not know it
        error = ssim.mul_(-0.5).add_(0.5).clamp_(0, 1)
        return error.lerp_(difference.abs_(), 1 - to.ssim_weight).mean(-3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, sign, by_m, by_s, by_p = ctx.saved_tensors
        grad = grad.unsqueeze(-3)
        out = local_mean_adjoint(grad * by_s).mul_(x).mul_(2)
        out.add_(local_mean_adjoint(grad * by_p).mul_(ctx.to.target))
        out.add_(local_mean_adjoint(grad * by_m))
        return out.add_(grad * sign, alpha=(1 - ctx.to.ssim_weight) / x.shape[-3]), None


def local_mean(image: Tensor) -> Tensor:
    """Mean over the 3 x 3 neighbourhood in the last two axes, reflected at the border."""
    padded = F.pad(image.flatten(0, -4), (1, 1, 1, 1), mode="reflect")
    column = (padded[..., :-2, :] + padded[..., 2:, :]).add_(padded[..., 1:-1, :])
    return (column[..., :-2] + column[..., 2:]).add_(column[..., 1:-1]).div_(9).view_as(image)


def local_mean_adjoint(grad: Tensor) -> Tensor:
    """The transpose of `local_mean`: what flows back through it."""
    for axis in (-1, -2):
        last = grad.shape[axis] - 1
        out = grad.clone()
        out.narrow(axis, 1, last).add_(grad.narrow(axis, 0, last))
        out.narrow(axis, 0, last).add_(grad.narrow(axis, 1, last))
        out.select(axis, 1).add_(grad.select(axis, 0))
        out.select(axis, last - 1).add_(grad.select(axis, last))
        grad = out
    return grad.div_(9)
