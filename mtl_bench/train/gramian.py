"""K gradients of one space: as a matrix for methods that ask for one, else as autograd made them.

Most methods only need the Gramian and a weighted sum. Both can be had from the gradients as they
are, without the time and the memory that a second copy of them takes.

Shapes: T losses of a method, K of them with a gradient, each a list of tensors (None where it is
zero), P numbers in all.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise

import torch
from torch import Tensor, nn

from mtl_bench.train.together import Gradient, Together

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
    flat_K, flat_L = ([None if x is None else _flat(x) for x in xs] for xs in (a_K, b_L))
    found = []
    chunk = CPU_CHUNK if like.device.type == "cpu" else like.numel()
    edges = [*range(0, like.numel(), chunk), like.numel()]
    for start, end in pairwise(edges):
        A_Kp = _stack(flat_K, like, start, end)
        B_Lp = A_Kp if b_L is a_K else _stack(flat_L, like, start, end)
        found.append((A_Kp @ B_Lp.T).double())
    return found


def _flat(x: Tensor) -> Tensor:
    """Its numbers as channels-last memory has them: of what lies so, no copy."""
    return (x.movedim(1, -1) if x.dim() == 4 else x).reshape(-1)


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


def add(total: Gradient | None, grads: Gradient) -> list[Tensor | None]:
    if total is None:
        return list(grads)
    return [
        b if a is None else a if b is None else a + b for a, b in zip(total, grads, strict=True)
    ]


def divided(grads: Gradient, by: float) -> list[Tensor | None]:
    return list(grads) if by == 1 else [g if g is None else g / by for g in grads]


def cosines_of(names: Sequence[str], G_KK: Tensor) -> dict[str, float]:
    """Of every pair of gradients, from their products; 0 with one that is zero."""
    norm_K = G_KK.diagonal().clamp_min(0).sqrt()
    cosine_KK = G_KK / (norm_K * norm_K[:, None]).clamp_min(torch.finfo(torch.float64).tiny)
    pairs = combinations(range(len(names)), 2)
    return {f"{names[i]}.{names[j]}": float(cosine_KK[i, j]) for i, j in pairs}


# --- as one vector --------------------------------------------------------------------------------


def flatten(grads: Gradient, like: Sequence[Tensor], out: Tensor | None = None) -> Tensor:
    parts = [torch.zeros_like(p) if g is None else g for g, p in zip(grads, like, strict=True)]
    return torch.cat([part.flatten().float() for part in parts], out=out)


def unflatten(vector_P: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    parts = vector_P.split([x.numel() for x in like])
    return [part.view_as(x).to(x) for part, x in zip(parts, like, strict=True)]


# --- collected over the parts of a batch ----------------------------------------------------------


class Gradients:
    """Gradients of the shared parameters, added up over a batch's parts, those of all ranks."""

    def __init__(self, shared: Sequence[nn.Parameter], terms: Sequence[str], together: Together):
        self.shared, self.terms, self.together = shared, terms, together
        self.rows: dict[str, list[Tensor | None]] = {}

    def add(self, z: Sequence[Tensor], z_grads: dict[str, Gradient]) -> None:
        """A part's, from those of what the decoders read, which are used up."""
        for name in list(z_grads):
            grads = z_grads.pop(name)
            self.put(name, onward(z, grads, self.shared, keep=len(z_grads) > 0))

    def put(self, name: str, grads: Gradient) -> None:
        self.rows[name] = add(self.rows.get(name), grads)

    def mean(self, divisor_of: Mapping[str, float]) -> list[list[Tensor | None]]:
        self.rows = self.together.rows([*divisor_of], self.rows, self.shared)
        return [divided(self.rows[name], by) for name, by in divisor_of.items()]

    def products(self, rows: Sequence[Gradient]) -> Tensor:
        """Inner products [K,K] of all ranks' gradients."""
        return products(rows, rows)

    def back(self, direction: Gradient) -> None:
        """A direction, as a row has it, into `.grad`."""
        for parameter, grad in zip(self.shared, direction, strict=True):
            parameter.grad = grad


class Matrix(Gradients):
    """The same as one matrix, made row by row: a second copy may cost as much as the network."""

    def put(self, name: str, grads: Gradient) -> None:
        if not self.rows:  # not before: the decoders need memory, too
            self.J_TP = self._nothing()
        row_P = self.J_TP[self.terms.index(name)]
        if name in self.rows:
            row_P += flatten(grads, self.shared)
        else:
            self.rows[name] = [flatten(grads, self.shared, out=row_P)]

    def _nothing(self) -> Tensor:
        P = sum(parameter.numel() for parameter in self.shared)
        return torch.zeros(len(self.terms), P, device=self.shared[0].device)

    def mean(self, divisor_of: Mapping[str, float]) -> list[list[Tensor | None]]:
        if not self.rows:  # all of these losses are other ranks'
            self.J_TP = self._nothing()
        here = [self.terms.index(name) for name in divisor_of]
        for index in here:
            self.together.ranks.sum_(self.J_TP[index])
        self.J_KP = self.J_TP if len(here) == len(self.J_TP) else self.J_TP[here]
        for row_P, divisor in zip(self.J_KP, divisor_of.values(), strict=True):
            if divisor != 1:
                row_P /= divisor
        return [[row_P] for row_P in self.J_KP]


class AtRepresentation(Gradients):
    """Gradients of what the decoders read: the parts' tensors stand side by side."""

    def __init__(self, shared: Sequence[nn.Parameter], terms: Sequence[str], together: Together):
        super().__init__(shared, terms, together)
        self.rows = {name: [] for name in terms}
        self.read: list[Tensor] = []

    def add(self, z: Sequence[Tensor], z_grads: dict[str, Gradient]) -> None:
        self.read += z
        for name, row in self.rows.items():
            row += z_grads.get(name, [None] * len(z))

    def mean(self, divisor_of: Mapping[str, float]) -> list[list[Tensor | None]]:
        return [divided(self.rows[name], by) for name, by in divisor_of.items()]

    def products(self, rows: Sequence[Gradient]) -> Tensor:
        return self.together.ranks.sum_(super().products(rows))

    def back(self, direction: Gradient) -> None:
        super().back(onward(self.read, direction, self.shared, keep=False))
        self.together.grads(self.shared)


# What ranks add to each other's: what one reads is its own, so that only products and the update
# of the representation have a sum.
KINDS = {"gramian": Gradients, "jacobian": Matrix, "representation": AtRepresentation}


def onward(
    z: Sequence[Tensor], z_grads: Gradient, shared: Sequence[nn.Parameter], keep: bool
) -> Gradient:
    """Gradients of the shared parameters from those of what the decoders read."""
    reached = [(x, g) for x, g in zip(z, z_grads, strict=True) if g is not None]
    if not reached:
        return [None] * len(shared)
    outputs, grads = zip(*reached, strict=True)
    return torch.autograd.grad(outputs, shared, grads, retain_graph=keep, allow_unused=True)
