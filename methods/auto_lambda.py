"""Auto-Lambda: weights learn whose gradients lower the losses of another batch one step ahead.

Source: Liu, James, Davison, Johns, Auto-Lambda: Disentangling Dynamic Task Relationships,
TMLR 2022, arXiv:2202.03091, equations 3 to 6, every task primary. The second batch is training
data, too; lambda moves first, then the network with the new one; nothing keeps lambda positive.
Departures: the derivative is exact, because task gradients are at hand, where the paper takes a
finite difference; the look-ahead moves the shared parameters only, by plain gradient descent
without momentum or weight decay. One public variant puts a softmax over lambda.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LookAheadMethod, Step
from mtl_bench.core.terms import Term

from ._adam import Adam


class AutoLambda(LookAheadMethod):
    """d = J^T l; l descends L(theta - lr J^T l), whose derivative is -lr J grad L(theta - lr J^T l)

    with L the sum of the second batch's losses.

    Args:
        init: every lambda at the start; 0.1 in the paper.
        lr: of the Adam that moves lambda; 1e-4 in the paper on NYUv2, 3e-5 on Cityscapes.
    """

    space = {"lr": {"log": [3e-5, 1e-3]}}

    weighted_heads = True
    lambda_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.1, lr: float = 1e-4):
        super().__init__(terms, seed)
        self.register_buffer("lambda_T", torch.full((len(terms),), init, dtype=torch.float64))
        self.adam = Adam(self.lambda_T, lr)

    def direction_ahead(
        self, J_KP: Tensor, step: Step, ahead: Callable[[Tensor], Tensor], lr: float
    ) -> tuple[Tensor, Tensor]:
        here = step.present
        lambda_K = self.lambda_T[here]
        next_P = ahead(lambda_K.to(J_KP) @ J_KP).sum(0)
        grad_K = (-lr * (J_KP @ next_P)).to(lambda_K)
        lambda_K = self.adam.step(lambda_K, grad_K, here)
        self.lambda_T[here] = lambda_K
        weight_K = lambda_K.to(J_KP)
        return weight_K @ J_KP, weight_K
