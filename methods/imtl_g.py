"""Impartial multi-task learning, its gradient half: the same projection on every gradient.

Source: Liu, Li, Kuang, Xue, Chen, Yang, Liao, Zhang, Towards Impartial Multi-Task Learning,
ICLR 2021, openreview.net/forum?id=IMPnRXEWpvr, its gradient balance, by the pseudo-inverse of the
Gramian, which also serves linearly dependent gradients. Departure: from three tasks on weights can
be negative, and then the paper's sum of weights, to which it scales, comes near zero (a huge step)
or below (every loss rises); here their absolute values sum to 1, the same where none is negative.
"""

from collections.abc import Sequence

from torch import Tensor

from mtl_bench.core.method import GradientMethod
from mtl_bench.core.terms import Term

from ._solvers import correlation, equal_projections


class ImpartialGradient(GradientMethod):
    """d g_i / |g_i| the same for all i: w ~ G^+ sqrt(diag G), scaled to sum_i |w_i| = 1

    Args:
        paper_sum: scale to sum_i w_i = 1, as the paper does.
    """

    def __init__(self, terms: Sequence[Term], seed: int = 0, paper_sum: bool = False):
        super().__init__(terms, seed)
        self.paper_sum = paper_sum

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        norm_K, C_KK = correlation(G_KK)
        weight_K = equal_projections(C_KK) / norm_K
        sum_ = weight_K.sum() if self.paper_sum else weight_K.abs().sum()
        return weight_K / sum_ if sum_ != 0 else weight_K  # 0: no direction
