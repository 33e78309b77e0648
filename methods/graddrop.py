"""GradDrop: where tasks disagree on a coordinate's sign, one sign is drawn and the other drops.

Source: Chen, Ngiam, Huang, Luong, Kretzschmar, Chai, Anguelov, Just Pick a Sign: Optimizing Deep
Multitask Models with Gradient Sign Dropout, NeurIPS 2020, arXiv:2010.06808, algorithm 1. Departure:
the paper drops in the gradient of the representation z, multiplied by sign(z) and summed over the
batch; here it is the gradient of the shared parameters, which needs neither. The logged weight is
the part of a gradient's absolute sum that is kept.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod
from mtl_bench.core.terms import Term


class GradDrop(GradientMethod):
    """sum_i (leak + (1 - leak) M_i) g_i; M_i keeps the sign + with probability P, else the sign -

    P = (1 + sum_i g_i / sum_i |g_i|) / 2, one draw per coordinate for all tasks.

    Args:
        leak: part of what is dropped that passes nevertheless; 0 in the paper's main results.
    """

    def __init__(self, terms: Sequence[Term], seed: int = 0, leak: float = 0.0):
        super().__init__(terms, seed)
        self.leak = leak

    def direction(self, J_KP: Tensor, loss_K: Tensor) -> tuple[Tensor, Tensor]:
        tiny, size_KP = torch.finfo(J_KP.dtype).tiny, J_KP.abs()
        purity_P = (1 + J_KP.sum(0) / size_KP.sum(0).clamp_min(tiny)) / 2
        drawn_P = torch.rand(len(purity_P), dtype=J_KP.dtype, generator=self.generator)
        positive_P = purity_P > drawn_P.to(J_KP.device)
        part_KP = ((J_KP > 0) == positive_P).to(J_KP).clamp_min(self.leak)
        absolute_K = size_KP.sum(1).clamp_min(tiny)
        return (J_KP * part_KP).sum(0), size_KP.mul_(part_KP).sum(1) / absolute_K
