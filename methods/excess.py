"""ExcessMTL: tasks that are far from their own optimum weigh more, noisy ones do not.

Source: He, Zhou, Zhang, Yun, Xu, Zeng, Chilimbi, Zhao, Robust Multi-Task Learning with Excess
Risks, ICML 2024, arXiv:2402.02009, algorithm 1 and section 3.2 (scale). The distance to the optimum
is a Taylor estimate with AdaGrad's diagonal as Hessian, relative to its mean over a warm-up of
equal weights. Departures: a warm-up counts steps, not epochs, each task its own. LibMTL starts from
weights 1 in place of 1/T; public code takes the first estimate alone as the scale.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._state import Rows


class ExcessMTL(GradientMethod):
    """w_i <- w_i exp(eta e_i / e_i(0)), sum 1; e_i = sum_p g_ip^2 / sqrt(S_ip), S_i += g_i^2

    Args:
        eta: step size of the weights; 0.01 in LibMTL, 1 in torchjd (and soon at one task).
        warm_up: steps over which e_i(0) is averaged, at least 1; 3 epochs in the paper, of which
            the built-in data has 100 steps each.
    """

    space = {"eta": {"log": [0.01, 1.0]}}

    needs = "jacobian"
    weighted_heads = True
    replayable = True
    log_weight_T: Tensor  # logarithms, from which a weight can return after it was 0
    base_T: Tensor  # e(0)
    count_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, eta: float = 0.01, warm_up: int = 300):
        super().__init__(terms, seed)
        if warm_up < 1:
            raise ValueError(f"warm_up {warm_up} must be at least 1")
        self.eta, self.warm_up = eta, warm_up
        zeros_T = torch.zeros(len(terms), dtype=torch.float64)
        self.register_buffer("log_weight_T", zeros_T.log_softmax(0))
        self.register_buffer("base_T", zeros_T.clone())
        self.register_buffer("count_T", zeros_T.clone())
        self.squares = Rows(len(terms))

    def direction(self, J_KP: Tensor, step: Step) -> tuple[Tensor, Tensor]:
        square_KP = J_KP**2
        S_KP = self.squares.of(step.present, J_KP) + square_KP
        self.squares.keep(step.present, S_KP)
        excess_K = square_KP.div_((S_KP + 1e-7).sqrt_()).sum(1).to(self.base_T)
        weight_K = self._reweigh(excess_K, step.present).to(J_KP)
        return weight_K @ J_KP, weight_K

    def _reweigh(self, excess_K: Tensor, here: Tensor) -> Tensor:
        self.count_T[here] += 1
        warming_K = self.count_T[here] <= self.warm_up
        self.base_T[here] += warming_K * excess_K / self.warm_up
        gain_K = self.eta * excess_K / (self.base_T[here] + 1e-7)
        before_K = self.log_weight_T[here]
        after_K = (before_K + gain_K.masked_fill(warming_K, 0)).log_softmax(0)
        after_K = after_K + before_K.logsumexp(0)  # the absent tasks' weights stay
        self.log_weight_T[here] = after_K
        return after_K.exp()
