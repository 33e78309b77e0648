"""DualProj: the average gradient moves to the nearest direction that no gradient opposes.

Source: Lopez-Paz, Ranzato, Gradient Episodic Memory for Continual Learning, NeurIPS 2017,
arXiv:1706.08840, equation 11, with the tasks in the place of the memories. The Gramian is divided
by its trace and regularised as in `upgrad`, with the same consequence for small gradients.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod
from mtl_bench.core.terms import Term

from ._solvers import project_on_dual_cone, regularized


class DualProj(GradientMethod):
    """argmin_v v^T G v over v >= 1 / K

    Args:
        regularization: added to the diagonal of G / tr G; 1e-4 in the code of `upgrad`'s authors.
    """

    def __init__(self, terms: Sequence[Term], seed: int = 0, regularization: float = 1e-4):
        super().__init__(terms, seed)
        self.regularization = regularization

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        G_KK = regularized(G_KK, self.regularization)
        mean_1K = torch.full_like(loss_K, 1 / len(loss_K))[None]
        return project_on_dual_cone(G_KK, mean_1K)[0]
