"""Ask a method for its answer to given losses or gradients, as training would.

Shapes: T losses of the method, K of them given, N batches, P parameters.
"""

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, LookAheadMethod, LossMethod, Step


def step_of(loss_K: Tensor, present: Tensor | None = None) -> Step:
    """A step with these losses: the method's first K, unless told which."""
    return Step(loss_K, torch.arange(len(loss_K)) if present is None else present)


def weights(method: LossMethod, loss_K: Tensor, present: Tensor | None = None) -> Tensor:
    """The derivatives of a loss-value method's scalar."""
    leaf_K = loss_K.clone().requires_grad_()
    (weight_K,) = torch.autograd.grad(method.total(step_of(leaf_K, present)), leaf_K)
    return weight_K


def update(
    method: GradientMethod, J_NKP: Tensor, loss_NK: Tensor, present: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """A gradient method's direction and weights, given as many of the batches as it takes.

    A method that looks ahead finds the second batch's gradients wherever it looks.
    """
    if isinstance(method, LookAheadMethod):
        step = step_of(loss_NK[0], present)
        return method.direction_ahead(J_NKP[0], step, lambda direction_P: J_NKP[1], 0.1)
    if method.needs == "jacobian":
        return method.direction(J_NKP[0], step_of(loss_NK[0], present))
    if method.batches == 1:
        one_KP, other_KP, last_KP, loss_K = *[J_NKP[0]] * 3, loss_NK[0]
    else:
        (one_KP, other_KP, last_KP), loss_K = J_NKP, loss_NK[:2].mean(0)
    G_KK = (one_KP @ other_KP.T).double()
    weight_K = method.weights(G_KK, step_of(loss_K.double(), present)).to(J_NKP)
    return weight_K @ last_KP, weight_K


def one_update(method: GradientMethod, J_KP: Tensor, loss_K: Tensor) -> tuple[Tensor, Tensor]:
    """The same of a method that takes one batch."""
    return update(method, J_KP[None], loss_K[None])


def head_weights(method: GradientMethod, weight_K: Tensor, loss_K: Tensor) -> Tensor:
    """Weights of the losses for what is not shared, ones where the method does not care."""
    if not method.weighted_heads:
        return torch.ones_like(weight_K)
    return method.head_weights(weight_K, step_of(loss_K))
