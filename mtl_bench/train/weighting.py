"""What a method decided about a step, and the small parts that both kinds of method need for it.

Shapes: K losses of this batch, P numbers in the method's space.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Method
from mtl_bench.train.gramian import Gradient, products


@dataclass(frozen=True)
class Weighting:
    """What the method saw and decided, for the log."""

    total: float  # the scalar minimised; for gradient methods the weighted sum of the losses
    loss_K: Tensor
    losses: dict[str, float]  # the loss terms
    weights: dict[str, float]  # derivative of the update with respect to each loss of the method
    cosines: dict[str, float] = field(default_factory=dict)  # of pairs of task gradients: "a.b"


def weighting(
    method: Method,
    losses: Mapping[str, Tensor],
    loss_K: Tensor,
    weight_K: Tensor,
    cosines: dict[str, float],
    total: float | None = None,
) -> Weighting:
    """Tensors as the log has them; the total is the weighted sum where it is not said."""
    total = float(weight_K @ loss_K) if total is None else total
    floats = {name: loss.item() for name, loss in losses.items()}
    weights = dict(zip(names_of(method), weight_K.tolist(), strict=True))
    return Weighting(total, loss_K, floats, weights, cosines)


def differentiate(method: LossMethod, loss_K: Tensor, scale: float) -> tuple[float, Tensor]:
    """The method's scalar and `scale` times its derivatives; its own parameters get theirs, too."""
    leaf_K = loss_K.clone().requires_grad_()
    total = method.total(leaf_K)
    (total * scale).backward()
    assert leaf_K.grad is not None
    return total.item(), leaf_K.grad


def cosines_of(names: Sequence[str], rows: Sequence[Gradient]) -> dict[str, float]:
    """Of every pair of gradients; 0 with one that is zero."""
    G_KK = products(rows, rows)
    norm_K = G_KK.diagonal().clamp_min(0).sqrt()
    cosine_KK = G_KK / (norm_K * norm_K[:, None]).clamp_min(torch.finfo(torch.float64).tiny)
    pairs = itertools.combinations(range(len(names)), 2)
    return {f"{names[i]}.{names[j]}": float(cosine_KK[i, j]) for i, j in pairs}


def names_of(method: Method) -> list[str]:
    return [method.terms[index].name for index in method.present.tolist()]
