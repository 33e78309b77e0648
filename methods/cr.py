"""CR-MOGM: another method's weights, averaged over time so that one batch's noise moves them less.

Source: Zhou, Zhang, Jiang, Zhong, Gu, Zhu, On the Convergence of Stochastic Multi-Objective
Gradient Manipulation and Beyond, NeurIPS 2022, https://openreview.net/forum?id=ScwfQ7hdwyP. Put it
before a method that weighs gradients: `cr+nash`; alone it is around `mgda`. Departures: alpha is
constant, where the paper lets it grow to 1 as the learning rate decays, and the first weights are
taken as they are (as in torchjd). A method with decoders' weights of its own keeps those.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import Step, Wrapper
from mtl_bench.core.terms import Term

from .mgda import MGDA


class CorrelationReduced(Wrapper):
    """w <- alpha w + (1 - alpha) v with v the other method's weights

    Args:
        alpha: 0 is the other method, 1 keeps its first weights; 0.9 in torchjd.
    """

    weight_T: Tensor
    seen_T: Tensor  # whether a task has been weighed

    def __init__(self, terms: Sequence[Term], seed: int = 0, alpha: float = 0.9):
        super().__init__(terms, MGDA(terms, seed), seed)
        if not 0 <= alpha <= 1:
            raise ValueError(f"alpha {alpha} must be between 0 and 1")
        self.alpha = alpha
        self.register_buffer("weight_T", torch.zeros(len(terms), dtype=torch.float64))
        self.register_buffer("seen_T", torch.zeros(len(terms), dtype=torch.bool))

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        here, new_K = step.present, self.inner.weights(G_KK, step)
        old_K = torch.where(self.seen_T[here], self.weight_T[here], new_K.to(self.weight_T))
        self.weight_T[here] = self.alpha * old_K + (1 - self.alpha) * new_K.to(old_K)
        self.seen_T[here] = True
        return self.weight_T[here].to(new_K)
