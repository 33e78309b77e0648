"""SAMO: each gradient is taken where its own loss and the mean loss rise, for flat minima.

Source: Ban, Subramani, Ji, SAMO: A Lightweight Sharpness-Aware Approach for Multi-Task Optimization
with Joint Global-Local Perturbation, ICCV 2025, arXiv:2507.07883. Written from notes about the
paper and reviews of it, not from its text, and held against no published number. Put it before a
method that weighs gradients: `samo+mgda`; alone it is around the plain sum. A loss's own slope is
estimated by two forward passes along a random direction and scaled to the mean gradient's length,
tensor by tensor, so that of its size only the sign counts. Departures: what the notes
leave open, such as a draw for each loss, is this file's reading.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import PerturbedMethod, Step
from mtl_bench.core.terms import Term

from ._sum import Sum

TINY = 1e-30


class SAMO(PerturbedMethod):
    """g_i at theta + rho v / |v|, v = alpha g_0 + (1 - alpha) h_i, g_0 the mean loss's gradient

    and h_i = (L_i(theta + mu z) - L_i(theta - mu z)) / (2 mu) z with z ~ N(0, I).

    Args:
        rho: how far; 0.01 to 0.5 in the paper.
        alpha: share of the mean gradient; 0.3 to 0.7 in the paper.
        mu: step of the estimate; 0.01 in the paper.
    """

    space = {"rho": {"log": [0.01, 0.5]}, "alpha": {"uniform": [0.3, 0.7]}}

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        rho: float = 0.05,
        alpha: float = 0.5,
        mu: float = 0.01,
    ):
        super().__init__(terms, Sum(terms, seed), seed)
        if rho < 0 or not 0 <= alpha <= 1 or mu <= 0:
            raise ValueError(f"rho {rho}, alpha {alpha}, mu {mu}: >= 0, in 0 to 1, above 0")
        self.rho, self.alpha, self.mu = rho, alpha, mu

    def shifts(
        self,
        mean: Sequence[Tensor | None],
        losses_at: Callable[[Sequence[Tensor]], Tensor],
        step: Step,
    ) -> list[list[Tensor]]:
        known = [g for g in mean if g is not None]
        found = []
        for i in range(len(step.present)):
            z = [self._drawn(g) for g in known]
            full = _like(mean, [self.mu * part for part in z])
            rise = losses_at(full)[i] - losses_at([-part for part in full])[i]
            signs = [torch.sign(rise) / _length(part).clamp_min(TINY) for part in z]
            local = [s * _length(g) * part for s, g, part in zip(signs, known, z, strict=True)]
            v = [self.alpha * g + (1 - self.alpha) * h for g, h in zip(known, local, strict=True)]
            length = torch.stack([_length(part) for part in v]).norm().clamp_min(TINY)
            found.append(_like(mean, [self.rho * part / length for part in v]))
        return found

    def _drawn(self, like: Tensor) -> Tensor:
        seed = int(torch.randint(2**62, (), generator=self.generator))
        draw = torch.Generator(like.device).manual_seed(seed)
        return torch.randn(like.shape, generator=draw, device=like.device, dtype=like.dtype)


def _length(part: Tensor) -> Tensor:
    found: Tensor = torch.linalg.vector_norm(part)
    return found


def _like(mean: Sequence[Tensor | None], parts: list[Tensor]) -> list[Tensor]:
    """In the places of the tensors that have a gradient; zeros elsewhere."""
    left = iter(parts)
    return [torch.zeros(()) if g is None else next(left) for g in mean]
