"""Fast adaptive multitask optimization: all losses fall at the same relative rate.

Source: Liu, Feng, Stone, Liu, FAMO: Fast Adaptive Multitask Optimization, NeurIPS 2023,
arXiv:2306.03792, with lower bounds of 0. Costs a second forward pass: the batch is evaluated again
after the step, and the shares move towards what fell least. With losses below 1 the scalar is
negative: a schedule must watch a metric instead. Losses below 1e-8 count as 1e-8, and then weigh
nothing.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term

from ._adam import Adam


class Famo(LossMethod):
    """c sum_i z_i log L_i with z = softmax(xi), 1/c = sum_i z_i / L_i: the weights sum to 1

    Args:
        lr: of the Adam that moves xi; 0.025 in the paper.
        decay: its weight decay gamma; 0.001 in the paper, which takes 0.01 on Cityscapes.
    """

    space = {"decay": [0.001, 0.01]}

    reevaluates = True
    xi_T: Tensor

    def __init__(
        self, terms: Sequence[Term], seed: int = 0, lr: float = 0.025, decay: float = 0.001
    ):
        super().__init__(terms, seed)
        self.register_buffer("xi_T", torch.zeros(len(terms)))
        self.adam = Adam(self.xi_T, lr, weight_decay=decay)

    def total(self, step: Step) -> Tensor:
        loss_K = step.loss_K.clamp_min(1e-8)
        share_K = torch.softmax(self.xi_T[step.present], 0)
        constant = 1 / (share_K / loss_K.detach()).sum()
        return constant * (share_K * loss_K.log()).sum()

    def after_step(self, step: Step, after_K: Tensor) -> None:
        xi_K = self.xi_T[step.present]
        share_K = torch.softmax(xi_K, 0)
        fall_K = step.loss_K.clamp_min(1e-8).log() - after_K.clamp_min(1e-8).log()
        grad_K = share_K * (fall_K - (share_K * fall_K).sum())  # softmax' Jacobian times the fall
        self.xi_T[step.present] = self.adam.step(xi_K, grad_K, step.present)
