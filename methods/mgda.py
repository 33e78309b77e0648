"""MGDA: the shortest convex combination of the gradients, a direction that raises no loss.

Source: Sener, Koltun, Multi-Task Learning as Multi-Objective Optimization, NeurIPS 2018,
arXiv:1810.04650, equation 3, after Desideri's multiple-gradient descent of 2012. Public code
approximates the minimum by Frank-Wolfe steps and stops far from it where norms differ; here it is
exact. Small gradients get most of the weight, and one that is zero stops the shared parameters,
which is what the definition says; `normalize` is the authors' remedy.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import finite, min_norm


class MGDA(GradientMethod):
    """argmin |sum_i w_i g_i / n_i| over w >= 0 with sum 1

    Args:
        normalize: n_i: "none" (1, the paper's text), "l2" (the gradient's norm), "loss" (its loss)
            or "loss+" (both), as in the authors' code.
    """

    space = {"normalize": ["none", "l2", "loss", "loss+"]}

    def __init__(self, terms: Sequence[Term], seed: int = 0, normalize: str = "none"):
        super().__init__(terms, seed)
        if normalize not in ("none", "l2", "loss", "loss+"):
            raise ValueError(f"normalize '{normalize}' is not one of none, l2, loss, loss+")
        self.normalize = normalize

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        scale_K = torch.ones_like(step.loss_K)
        if self.normalize in ("l2", "loss+"):
            scale_K = scale_K * G_KK.diagonal().sqrt()
        if self.normalize in ("loss", "loss+"):
            scale_K = scale_K * step.loss_K
        scale_K = torch.where(scale_K > 0, scale_K, 1.0)
        return min_norm(finite(G_KK) / scale_K / scale_K[:, None]) / scale_K
