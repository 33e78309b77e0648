"""ConFIG: the direction with the same cosine to every gradient, as long as they project on it.

Source: Liu, Chu, Thuerey, ConFIG: Towards Conflict-free Training of Physics Informed Neural
Networks, ICLR 2025, arXiv:2408.11104, equation 2. The pseudo-inverse of the unit gradients
is taken by their correlations, K x K numbers. The direction is that of `imtl_g`, the length is not.
"""

from torch import Tensor

from mtl_bench.core.method import GradientMethod

from ._solvers import correlation, equal_projections


class ConFIG(GradientMethod):
    """(sum_i g_i u) u with u = U^+ 1 / |U^+ 1|, U the unit gradients"""

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        norm_K, C_KK = correlation(G_KK)
        weight_K = equal_projections(C_KK)  # of unit gradients, adding up to U^+ 1
        projection_K = C_KK @ weight_K
        square = weight_K @ projection_K
        length = (norm_K @ projection_K) / square if square > 0 else 0.0
        return length * weight_K / norm_K
