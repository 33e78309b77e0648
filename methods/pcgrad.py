"""PCGrad: each gradient loses what points against the others, one after the other at random.

Source: Yu, Kumar, Gupta, Levine, Hausman, Finn, Gradient Surgery for Multi-Task Learning,
NeurIPS 2020, arXiv:2001.06782, algorithm 1. LibMTL and Nash-MTL's code project a gradient on
its own normal plane too, which the algorithm excludes and which fires once others have turned it.
"""

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod

from ._solvers import finite


class PCGrad(GradientMethod):
    """sum_i g_i', where g_i' = g_i, and for all j != i: if g_i' g_j < 0, g_i' -= proj(g_i', g_j)"""

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        square_K = finite(G_KK).diagonal().tolist()
        weight_KK = torch.eye(len(G_KK), dtype=G_KK.dtype)  # row i: g_i' as a sum of gradients
        for i, weight_K in enumerate(weight_KK):
            for j in torch.randperm(len(G_KK), generator=self.generator).tolist():
                product = float(G_KK[j] @ weight_K)
                if j != i and product < 0 < square_K[j]:
                    weight_K[j] -= product / square_K[j]
        return weight_KK.sum(0)
