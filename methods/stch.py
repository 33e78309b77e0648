"""Smooth Tchebycheff scalarisation: minimises a soft maximum of the losses' relative progress.

Source: Lin, Zhang, Yang, Liu, Wang, Zhang, Smooth Tchebycheff Scalarization for Multi-Objective
Optimization, ICML 2024, arXiv:2402.19078, in its recipe for multi-task learning: f = log(L / n), n
the mean loss of a warm-up on the sum of logarithms, ideal point 0, times K. Public code divides by
zero when it is resumed after the warm-up; here n is saved, and a loss that comes later has its own
warm-up. Losses below 1e-8 count as 1e-8, and then weigh nothing.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import Term


class SmoothTchebycheff(LossMethod):
    """K mu log sum_i exp(f_i / mu); in the warm-up sum_i log L_i

    Args:
        mu: smoothness; 1 in the recipe. Towards 0 it is the maximum, towards infinity the mean.
        warmup: steps; epochs in the recipe (one is 100 steps of the built-in data at batch 8).
    """

    sum_T: Tensor  # of the losses of the warm-up
    count_T: Tensor  # steps that had the loss

    def __init__(self, terms: Sequence[Term], seed: int = 0, mu: float = 1.0, warmup: int = 100):
        super().__init__(terms, seed)
        if mu <= 0 or warmup < 1:
            raise ValueError(f"mu {mu} and warmup {warmup} must be positive")
        self.mu, self.warmup = mu, warmup
        self.register_buffer("sum_T", torch.zeros(len(terms)))
        self.register_buffer("count_T", torch.zeros(len(terms)))

    def total(self, loss_K: Tensor) -> Tensor:
        loss_K = loss_K.clamp_min(1e-8)
        warm_K = self.count_T[self.present] < self.warmup
        mean_K = self.sum_T[self.present] / self.warmup
        f_K = (loss_K / torch.where(warm_K, 1.0, mean_K)).log()
        self.sum_T[self.present] += warm_K * loss_K.detach()
        self.count_T[self.present] += 1
        total, known_K = f_K[warm_K].sum(), f_K[~warm_K]
        if len(known_K) > 0:
            total = total + len(known_K) * self.mu * torch.logsumexp(known_K / self.mu, 0)
        return total
