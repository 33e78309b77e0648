"""GradVac: each gradient turns towards the others until their cosine is what it usually is.

Source: Wang, Tsvetkov, Firat, Cao, Gradient Vaccine: Investigating and Improving Multi-task
Optimization in Massively Multilingual Models, ICLR 2021, arXiv:2010.05874, algorithm 1. The cosines
are of all shared parameters at once, where the paper also tries a set for each layer. A zero
gradient has no cosine: it neither turns others nor is remembered. LibMTL and torchjd remember with
beta = 0.5.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import finite


class GradVac(GradientMethod):
    """sum_i g_i', where g_i' = g_i is turned towards all g_j to which its cosine is unusually small

    For all j != i in random order, with phi = cos(g_i', g_j): if phi < phi_ij, then
    g_i' += g_j |g_i'| / |g_j| (phi_ij sqrt(1 - phi^2) / sqrt(1 - phi_ij^2) - phi), which makes the
    cosine phi_ij; always phi_ij <- (1 - beta) phi_ij + beta phi, from 0.

    Args:
        beta: how fast the usual cosine follows; 0.01 in the paper.
    """

    space = {"beta": {"log": [0.01, 0.5]}}

    phi_TT: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, beta: float = 0.01):
        super().__init__(terms, seed)
        self.beta = beta
        phi_TT = torch.zeros(len(terms), len(terms), dtype=torch.float64)
        self.register_buffer("phi_TT", phi_TT)

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        here = (step.present[:, None], step.present)
        G_KK, phi_KK = finite(G_KK), self.phi_TT[here].cpu()
        weight_KK = torch.eye(len(G_KK), dtype=G_KK.dtype)  # row i: g_i' as a sum of gradients
        for i, weight_K in enumerate(weight_KK):
            others = [j for j in range(len(G_KK)) if j != i]
            for index in torch.randperm(len(others), generator=self.generator).tolist():
                self._turn(G_KK, weight_K, others[index], phi_KK[i])
        self.phi_TT[here] = phi_KK.to(self.phi_TT)
        return weight_KK.sum(0)

    def _turn(self, G_KK: Tensor, weight_K: Tensor, j: int, phi_K: Tensor) -> None:
        """Turn a gradient towards g_j; changes its weights and usual cosines in place."""
        product_K = G_KK @ weight_K
        norm = math.sqrt(max(0.0, float(weight_K @ product_K)))
        norm_j = math.sqrt(float(G_KK[j, j]))
        if norm == 0 or norm_j == 0:
            return
        phi, usual = max(-1.0, min(1.0, float(product_K[j]) / norm / norm_j)), float(phi_K[j])
        if phi < usual:
            sine = max(1e-8, math.sqrt(1 - usual**2))  # 0 would ask for an infinite turn
            weight_K[j] += norm / norm_j * (usual * math.sqrt(1 - phi**2) / sine - phi)
        phi_K[j] = (1 - self.beta) * usual + self.beta * phi
