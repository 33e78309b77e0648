"""Aligned-MTL: the principal components of the gradients, all made as long as the shortest.

Source: Senushkin, Patakin, Kuznetsov, Konushin, Independent Component Alignment for Multi-Task
Learning, CVPR 2023, arXiv:2305.19000, algorithm 1. Orthonormal gradients are summed, as in LibMTL;
torchjd averages them, K times shorter. Components count as zero where the
correlations are within the rounding of float32, or a repeated task would shorten all to nothing.
"""

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod

from ._solvers import ROUNDING, correlation, root


class Aligned(GradientMethod):
    """w = sqrt(l_min) V l^(-1/2) V^T 1 with G = V l V^T, over the components that are not zero"""

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        _, C_KK = correlation(G_KK)
        rank = int((torch.linalg.eigvalsh(C_KK) > ROUNDING).sum())  # that of G
        _, sigma_K, V_KK = torch.linalg.svd(root(G_KK))  # finer than eigenvalues, the squares
        sigma_R, V_RK = sigma_K[:rank].clamp_min(torch.finfo(G_KK.dtype).tiny), V_KK[:rank]
        return (sigma_R[-1:] / sigma_R * V_RK.sum(1)) @ V_RK
