"""Nash-MTL: the update on which the tasks, bargaining for their share of it, would agree.

Source: Navon, Shamsian, Achituve, Maron, Kawaguchi, Chechik, Fetaya, Multi-Task Learning as a
Bargaining Game, ICML 2022, arXiv:2202.01017, algorithm 1, solved as the convex problem that it is.
The authors' code linearises, is off by degrees where norms differ a hundredfold, and without its
solver returns weights of 1 silently. Gradients that cancel have no solution; see `fair` in
_solvers.py for what is done there.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod
from mtl_bench.core.terms import Term

from ._solvers import fair


class Nash(GradientMethod):
    """w > 0 with (G w)_i = 1 / w_i; the shared direction is clipped, the decoders' weights are not

    Args:
        every: steps between two solves, with the same weights in between; 1 in the paper's main
            results. A task that was absent from the last solves keeps its weight, 1 at the start.
        max_norm: of the shared direction, 1 in the authors' code; inf clips nothing.
    """

    weight_T: Tensor
    step: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, every: int = 1, max_norm: float = 1.0):
        super().__init__(terms, seed)
        if every < 1 or not max_norm > 0:
            raise ValueError(f"every {every} and max_norm {max_norm}: at least 1, and above 0")
        self.every, self.max_norm = every, max_norm
        self.register_buffer("weight_T", torch.ones(len(terms), dtype=torch.float64))
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        if self.step % self.every == 0:
            self.weight_T[self.present] = fair(G_KK, power=1.0).to(self.weight_T)
        self.step += 1
        weight_K = self.weight_T[self.present].to(G_KK)
        norm = (weight_K @ G_KK @ weight_K).clamp_min(0).sqrt()  # of the shared direction
        return weight_K * (self.max_norm / norm).clamp(max=1.0)

    def head_weights(self, weight_K: Tensor, loss_K: Tensor) -> Tensor:
        return self.weight_T[self.present].to(weight_K)
