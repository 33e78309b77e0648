"""Geometric loss strategy: the geometric mean of the losses.

Source: Chennupati, Sistu, Yogamani, Rawashdeh, MultiNet++: Multi-Stream Feature Aggregation and
Geometric Loss Strategy for Multi-Task Learning, CVPRW 2019, arXiv:1904.08492. The exponential of
the mean logarithm, because the product itself under- or overflows with many losses. Losses below
1e-8 count as 1e-8, and then weigh nothing.
"""

from torch import Tensor

from mtl_bench.core.method import LossMethod


class GeometricMean(LossMethod):
    """(L_1 L_2 ... L_K)^(1/K), so that w_i is this over K L_i"""

    def total(self, loss_K: Tensor) -> Tensor:
        return loss_K.clamp_min(1e-8).log().mean().exp()
