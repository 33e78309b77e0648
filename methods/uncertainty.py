"""Homoscedastic uncertainty: one learned log-variance per loss, no fixed weights.

Source: Kendall, Gal, Cipolla, Multi-Task Learning Using Uncertainty to Weigh Losses for Scene
Geometry and Semantics, CVPR 2018, arXiv:1705.07115, equations 7 and 10. With s = log sigma^2, a
classification loss weighs exp(-s) and a regression loss exp(-s)/2; both add s/2. Public code
mostly takes the regression form for all, and lets the model's weight decay pull s to 0.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class Uncertainty(LossMethod):
    """sum_i tau_i exp(-s_i) L_i + s_i / 2

    Args:
        init: every s_i at the start; 0 in the paper.
    """

    space = {"init": [0.0, -0.5, -0.7]}

    tau_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.0):
        super().__init__(terms, seed)
        self.log_variance_T = nn.Parameter(torch.full((len(terms),), init))
        tau = torch.tensor([1.0 if term.kind == "classification" else 0.5 for term in terms])
        self.register_buffer("tau_T", tau, persistent=False)

    def total(self, step: Step) -> Tensor:
        log_variance_K = self.log_variance_T[step.present]
        weight_K = self.tau_T[step.present] * torch.exp(-log_variance_K)
        return (weight_K * step.loss_K + 0.5 * log_variance_K).sum()
