"""Fixed weights times learned uncertainty: the paper's final loss.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 3.2, last equation: the fixed
weights are a good first estimate, the log-variances adjust them during training. At the start
(s = 0) every regression loss counts half of what it counts in `fixed`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import Term


class FixedUncertainty(LossMethod):
    """sum_i tau_i exp(-s_i) w_i L_i + s_i / 2

    Args:
        init: every s_i at the start; 0 in the paper.
    """

    scale_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.0):
        super().__init__(terms, seed)
        self.log_variance_T = nn.Parameter(torch.full((len(terms),), init))
        tau = torch.tensor([1.0 if term.kind == "classification" else 0.5 for term in terms])
        self.register_buffer("scale_T", tau * self.fixed_T, persistent=False)

    def total(self, loss_K: Tensor) -> Tensor:
        log_variance_K = self.log_variance_T[self.present]
        precision_K = torch.exp(-log_variance_K)
        return (self.scale_T[self.present] * precision_K * loss_K + 0.5 * log_variance_K).sum()
