"""The sum of the losses' logarithms: every loss counts by its relative, not its absolute, change.

Source: Navon et al., Multi-Task Learning as a Bargaining Game, ICML 2022, arXiv:2202.01017, where
it is the baseline SI. Losses below 1e-8 count as 1e-8, and then weigh nothing. The scalar has no
lower bound and turns negative: a schedule must watch a metric instead.
"""

from torch import Tensor

from mtl_bench.core.method import LossMethod


class ScaleInvariant(LossMethod):
    """sum_i log L_i, so that w_i = 1 / L_i"""

    def total(self, loss_K: Tensor) -> Tensor:
        return loss_K.clamp_min(1e-8).log().sum()
