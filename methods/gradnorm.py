"""GradNorm: weights move until each task's weighted gradient norm suits its pace of training.

Source: Chen, Badrinarayanan, Lee, Rabinovich, GradNorm: Gradient Normalization for Adaptive Loss
Balancing in Deep Multitask Networks, ICML 2018, arXiv:1711.02257, algorithm 1. In its order: the
network takes its step with the weights as they are, which then take theirs. Departures: norms are
of all shared parameters, not of their last layer; L_i(0) is the first loss seen of a task; a weight
that Adam would take below 0.001 stays there, and the paper says nothing of it. Public variants
learn a softmax or leave the decoders unweighted.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._adam import Adam

LEAST = 1e-3  # of a weight
TINY = torch.finfo(torch.float64).tiny


class GradNorm(GradientMethod):
    """Descends sum_i |w_i n_i - mean_j(w_j n_j) r_i^alpha| in w, then makes w sum to T

    with n_i = ||g_i|| and r_i = L_i / L_i(0) over its mean; the target is a constant.

    Args:
        alpha: how strongly slow tasks are favoured; 1.5 in the paper on NYUv2, 0.12 on toys.
        lr: of the Adam that moves w; 0.025 in the paper.
    """

    space = {"alpha": {"uniform": [0.12, 1.5]}}

    weighted_heads = True
    weight_T: Tensor
    start_T: Tensor  # L_i(0); 0: not seen yet

    def __init__(self, terms: Sequence[Term], seed: int = 0, alpha: float = 1.5, lr: float = 0.025):
        super().__init__(terms, seed)
        self.alpha = alpha
        self.register_buffer("weight_T", torch.ones(len(terms), dtype=torch.float64))
        self.register_buffer("start_T", torch.zeros(len(terms), dtype=torch.float64))
        self.adam = Adam(self.weight_T, lr)

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        weight_K = self.weight_T[step.present]
        norm_K = G_KK.diagonal().sqrt().to(weight_K)
        target_K = (weight_K * norm_K).mean() * self._pace(step) ** self.alpha
        grad_K = torch.sign(weight_K * norm_K - target_K) * norm_K
        moved_K = self.adam.step(weight_K, grad_K, step.present).clamp_min(LEAST)
        self.weight_T[step.present] = moved_K * weight_K.sum() / moved_K.sum()  # absent: as before
        return weight_K

    def _pace(self, step: Step) -> Tensor:
        """r [K]: above 1 where a loss has fallen less than the others."""
        loss_K, start_K = step.loss_K.to(self.start_T), self.start_T[step.present]
        start_K = torch.where(start_K > 0, start_K, loss_K)
        self.start_T[step.present] = start_K
        left_K = loss_K / start_K.clamp_min(TINY)
        return left_K / left_K.mean().clamp_min(TINY)
