"""CAGrad: near the average gradient, the direction in which the slowest task improves fastest.

Source: Liu, Liu, Jin, Stone, Liu, Conflict-Averse Gradient Descent for Multi-task Learning,
NeurIPS 2021, arXiv:2110.14048, algorithm 1, divided by 1 + c^2 as in the authors' code. Their dual
divides by |g_w|, which is 0 where the gradients cancel; the primal, which is solved here, has an
answer there too. Scales differ: torchjd does not divide, Nash-MTL's code multiplies by K.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import correlation, finite, root, shortest_above


class CAGrad(GradientMethod):
    """argmax_d min_i g_i d with |d - g_0| <= c |g_0|, g_0 the average; divided by 1 + c^2

    Args:
        c: radius of the ball, relative; 0.4 in Nash-MTL's and Auto-Lambda's comparisons, 0.5 in
            LibMTL.
    """

    space = {"c": {"uniform": [0.1, 0.9]}}

    def __init__(self, terms: Sequence[Term], seed: int = 0, c: float = 0.4):
        super().__init__(terms, seed)
        self.c = c

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        weight_K = torch.full_like(step.loss_K, 1 / len(step.loss_K))
        square = weight_K @ finite(G_KK) @ weight_K
        present_K = G_KK.diagonal() > 0  # a zero gradient asks nothing of d
        if square > 0:
            slope_K = (G_KK @ weight_K)[present_K] / square
            weight_K[present_K] += self._move(G_KK[present_K][:, present_K] / square, slope_K)
        return weight_K / (1 + self.c**2)

    def _move(self, G_KK: Tensor, slope_K: Tensor) -> Tensor:
        """Weights of d - g_0, in units of |g_0|; slope_K is g_i g_0.

        The length of the shortest move that gives every task the slope v is a convex function of
        v; Newton steps, or bisection, for the v where it is c. Where gradients cancel no move gives
        a v > 0, and the longest that there is may be shorter than c.
        """
        norm_K, C_KK = correlation(G_KK)
        R_KK, weight_K = root(C_KK), torch.zeros_like(slope_K)
        low, high = float(slope_K.min()), float((slope_K + self.c * norm_K).min())
        v = (low + high) / 2
        for _ in range(60):
            tried_K = shortest_above(R_KK, (v - slope_K) / norm_K)
            length = math.inf if tried_K is None else float((R_KK @ tried_K).norm())
            if tried_K is not None and length <= self.c * (1 + 1e-12):
                low, weight_K = v, tried_K
                if length >= self.c * (1 - 1e-12):
                    break
            else:
                high = v
            if tried_K is not None and length > 0:
                v += (self.c - length) * length / float(tried_K @ (1 / norm_K))
            if not low < v < high:
                v = (low + high) / 2
        return weight_K / norm_K
