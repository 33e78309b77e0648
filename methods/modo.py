"""MoDo: least-norm weights by one projected step from two batches, and a third one to train on.

Source: Chen, Fernando, Ying, Chen, Three-Way Trade-Off in Multi-Objective Learning: Optimization,
Generalization and Conflict-Avoidance, NeurIPS 2023, arXiv:2305.20057, algorithm 1. Independent
batches make J_1 J_2^T an unbiased estimate, which a batch's Gramian is not. The paper may train on
the two batches again; here it is always a third. LibMTL adds up the decoders' gradients of the
three batches; here they are averaged.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.losses.terms import Term
from mtl_bench.method import GradientMethod

from ._simplex import descend


class MoDo(GradientMethod):
    """d = J_3^T l with l <- Pi(l - gamma (J_1 J_2^T + rho) l)

    Args:
        gamma: step size of lambda; 0.1 in torchjd, 0.001 in LibMTL.
        rho: pulls lambda towards equal weights; 0.1 in both; 0 is the bare algorithm.
    """

    batches = 3
    lambda_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, gamma: float = 0.1, rho: float = 0.1):
        super().__init__(terms, seed)
        self.gamma, self.rho = gamma, rho
        equal_T = torch.full((len(terms),), 1 / len(terms), dtype=torch.float64)
        self.register_buffer("lambda_T", equal_T)

    def direction(self, J_NKP: Tensor, loss_NK: Tensor) -> tuple[Tensor, Tensor]:
        A_KK = (J_NKP[0] @ J_NKP[1].T).double().cpu()
        lambda_K = self.lambda_T[self.present].cpu()
        lambda_K = descend(lambda_K, self.gamma * (A_KK @ lambda_K + self.rho * lambda_K))
        self.lambda_T[self.present] = lambda_K.to(self.lambda_T)
        weight_K = lambda_K.to(J_NKP)
        return weight_K @ J_NKP[2], weight_K
