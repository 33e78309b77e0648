"""K gradients of one space: as a matrix for methods that ask for one, else as autograd made them.

Most methods only need the Gramian and a weighted sum. Both can be had from the gradients as they
are, without the time and the memory that a second copy of them takes.

Shapes: K gradients, each a list of tensors (None where it is zero), P numbers in all.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

Gradient = Sequence[Tensor | None]  # in the order of the space's tensors
CPU_CHUNK = 2**14  # numbers of a gradient at once: those of K gradients stay in a core's cache


def products(one: Sequence[Gradient], other: Sequence[Gradient]) -> Tensor:
    """Inner products [K,L] of every gradient with every other one, float64 on the CPU."""
    found_KL = torch.zeros(len(one), len(other), dtype=torch.float64)
    parts = []
    for index in range(len(one[0])):
        a_K, b_L = [row[index] for row in one], [row[index] for row in other]
        if any(a is not None for a in a_K) and any(b is not None for b in b_L):
            parts += _products(a_K, a_K if one is other else b_L)
    return found_KL + torch.stack(parts).sum(0).cpu() if parts else found_KL


def _products(a_K: Gradient, b_L: Gradient) -> list[Tensor]:
    """Of one tensor of the space, in chunks: inside one in float32, over them in float64."""
    like = next(x for x in [*a_K, *b_L] if x is not None)
    flat_K, flat_L = ([None if x is None else x.reshape(-1) for x in xs] for xs in (a_K, b_L))
    found = []
    chunk = CPU_CHUNK if like.device.type == "cpu" else like.numel()
    edges = [*range(0, like.numel(), chunk), like.numel()]
    for start, end in pairwise(edges):
        A_Kp = _stack(flat_K, like, start, end)
        B_Lp = A_Kp if b_L is a_K else _stack(flat_L, like, start, end)
        found.append((A_Kp @ B_Lp.T).double())
    return found


def _stack(flat_K: Gradient, like: Tensor, start: int, end: int) -> Tensor:
    zero = like.new_zeros(end - start) if any(x is None for x in flat_K) else None
    return torch.stack([zero if x is None else x[start:end] for x in flat_K]).float()  # type: ignore[misc]


def combine(weight_K: Tensor, rows: Sequence[Gradient]) -> list[Tensor | None]:
    """The gradients' weighted sum, tensor by tensor; None where all are."""
    weights = weight_K.tolist()
    return [_weighted(weights, column) for column in zip(*rows, strict=True)]


def _weighted(weights: Sequence[float], column: Gradient) -> Tensor | None:
    total: Tensor | None = None
    for weight, grad in zip(weights, column, strict=True):
        if grad is not None:
            total = grad * weight if total is None else total.add_(grad, alpha=weight)
    return total


def add(total: Gradient, grads: Gradient) -> list[Tensor | None]:
    return [
        b if a is None else a if b is None else a + b for a, b in zip(total, grads, strict=True)
    ]


def divided(grads: Gradient, by: float) -> list[Tensor | None]:
    return list(grads) if by == 1 else [g if g is None else g / by for g in grads]


# --- as one vector --------------------------------------------------------------------------------


def flatten(grads: Gradient, like: Sequence[Tensor], out: Tensor | None = None) -> Tensor:
    parts = [torch.zeros_like(p) if g is None else g for g, p in zip(grads, like, strict=True)]
    return torch.cat([part.flatten().float() for part in parts], out=out)


def unflatten(vector_P: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    parts = vector_P.split([x.numel() for x in like])
    return [part.view_as(x).to(x) for part, x in zip(parts, like, strict=True)]
