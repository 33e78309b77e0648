"""Homoscedastic uncertainty whose regulariser never rewards a variance below one.

Source: Liebel, Koerner, Auxiliary Tasks in Multi-task Learning, ArXiv 2018, arXiv:1805.06334:
Kendall's log sigma becomes log(1 + sigma^2), so that the scalar stays positive. What is learned
is s = log sigma^2 and not sigma, which needs no bound to keep the variance positive.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import Term


class UncertaintyRevised(LossMethod):
    """sum_i tau_i exp(-s_i) L_i + log(1 + exp(s_i)), tau = 1 for classification, else 1/2

    Args:
        init: every s_i at the start; 0 is a variance of one.
    """

    tau_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.0):
        super().__init__(terms, seed)
        self.log_variance_T = nn.Parameter(torch.full((len(terms),), init))
        tau = torch.tensor([1.0 if term.kind == "classification" else 0.5 for term in terms])
        self.register_buffer("tau_T", tau, persistent=False)

    def total(self, loss_K: Tensor) -> Tensor:
        log_variance_K = self.log_variance_T[self.present]
        precision_K = torch.exp(-log_variance_K)
        return (self.tau_T[self.present] * precision_K * loss_K + softplus(log_variance_K)).sum()
