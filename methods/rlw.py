"""Random weights, drawn anew at every step: what a method must beat to have learned something.

Source: Lin, Ye, Zhang, Tsang, Reasonable Effectiveness of Random Weighting: A Litmus Test for
Multi-Task Learning, TMLR 2022, arXiv:2111.10603: softmax of standard normal draws. The weights sum
to 1, those of equal weighting to K: at the same learning rate its steps are K times smaller.
"""

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod


class RandomLossWeighting(LossMethod):
    """sum_i w_i L_i with w = softmax(n), n ~ N(0, I)"""

    def total(self, loss_K: Tensor) -> Tensor:
        draw_T = torch.randn(len(self.terms), generator=self.generator)  # absent losses draw too
        weight_K = torch.softmax(draw_T[self.present].to(loss_K), 0)
        return (weight_K * loss_K).sum()
