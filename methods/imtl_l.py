"""Impartial multi-task learning, its loss half: learned scales bring all losses to 1.

Source: Liu, Li, Kuang, Xue, Chen, Yang, Liao, Zhang, Towards Impartial Multi-Task Learning,
ICLR 2021, openreview.net/forum?id=IMPnRXEWpvr, its loss balance. The model's optimiser learns the
scales, at the method's own rate and without weight decay. With s = -log sigma^2 this is twice
uncertainty weighting in its regression form.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import Term


class ImpartialLoss(LossMethod):
    """sum_i exp(s_i) L_i - s_i; its minimum over s is at exp(s_i) L_i = 1

    Args:
        init: every s_i at the start; 0 in the paper.
    """

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.0):
        super().__init__(terms, seed)
        self.log_scale_T = nn.Parameter(torch.full((len(terms),), init))

    def total(self, loss_K: Tensor) -> Tensor:
        log_scale_K = self.log_scale_T[self.present]
        return (log_scale_K.exp() * loss_K - log_scale_K).sum()
