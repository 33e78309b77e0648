"""MoDo: least-norm weights by one projected step from two batches, and a third one to train on.

Source: Chen, Fernando, Ying, Chen, Three-Way Trade-Off in Multi-Objective Learning: Optimization,
Generalization and Conflict-Avoidance, NeurIPS 2023, arXiv:2305.20057, algorithm 1. Independent
batches make J_1 J_2^T an unbiased estimate, which a batch's Gramian is not. The paper may train on
the two batches again; here it is always a third. LibMTL trains the decoders on all three batches,
here on the third.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import CrossMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import descend


class MoDo(CrossMethod):
    """d = J_3^T l with l <- Pi(l - gamma (J_1 J_2^T + rho) l)

    Args:
        gamma: step size of lambda; 0.1 in torchjd, 0.001 in LibMTL.
        rho: pulls lambda towards equal weights; 0.1 in both; 0 is the bare algorithm.
    """

    space = {"gamma": {"log": [0.001, 0.1]}}

    lambda_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, gamma: float = 0.1, rho: float = 0.1):
        super().__init__(terms, seed)
        self.gamma, self.rho = gamma, rho
        equal_T = torch.full((len(terms),), 1 / len(terms), dtype=torch.float64)
        self.register_buffer("lambda_T", equal_T)

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        lambda_K = self.lambda_T[step.present].to(G_KK)
        lambda_K = descend(lambda_K, self.gamma * (G_KK @ lambda_K + self.rho * lambda_K))
        self.lambda_T[step.present] = lambda_K.to(self.lambda_T)
        return lambda_K
