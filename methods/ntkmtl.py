"""NTKMTL: weights that give every task's kernel the same largest eigenvalue, hence the same pace.

Source: Qin, Wang, Liao, Yan, NTKMTL: Mitigating Task Imbalance in Multi-Task Learning from Neural
Tangent Kernel Perspective, NeurIPS 2025, equation 15 with one mini-batch as in the paper's results,
so that a kernel is one number. The paper's kernel is that of a task's predictions; here it is its
loss's, which has one gradient. The objective is the weighted sum, so that decoders are weighted,
too. A task whose gradient is zero has weight 1 and counts for nothing in the mean.
"""

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step


class NTKMTL(GradientMethod):
    """w_i = sqrt(mean_j(l_j) / l_i) with l_i = |g_i|^2, the largest eigenvalue of J_i J_i^T"""

    weighted_heads = True

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        square_K = G_KK.diagonal()
        there_K = square_K > 0
        mean = square_K[there_K].mean()
        return torch.where(there_K, (mean / square_K).sqrt(), 1.0)
