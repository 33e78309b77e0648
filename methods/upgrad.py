"""UPGrad: each gradient moves to the nearest that none opposes, and then they are averaged.

Source: Quinton, Rey, Jacobian Descent for Multi-Objective Optimization, ArXiv 2024,
arXiv:2406.16232, proposition 1. The Gramian is divided by its trace and regularised as in the
authors' code, so that a conflict with a gradient 100 times smaller than the largest is not
resolved. torchjd resolves none, either, where all are small (squares that sum to less than 1e-4).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod
from mtl_bench.core.terms import Term

from ._solvers import project_on_dual_cone, regularized


class UPGrad(GradientMethod):
    """sum_i argmin_v v^T G v over v >= e_i / K

    Args:
        regularization: added to the diagonal of G / tr G; 1e-4 in the authors' code.
    """

    def __init__(self, terms: Sequence[Term], seed: int = 0, regularization: float = 1e-4):
        super().__init__(terms, seed)
        self.regularization = regularization

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        G_KK = regularized(G_KK, self.regularization)
        own_KK = torch.eye(len(G_KK), dtype=G_KK.dtype) / len(G_KK)
        return project_on_dual_cone(G_KK, own_KK).sum(0)
