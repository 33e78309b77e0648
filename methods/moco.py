"""MoCo: least-norm weights of gradients tracked over time, which noise biases less than a batch's.

Source: Fernando, Shen, Liu, Chaudhury, Murugesan, Chen, Mitigating Gradient Bias in Multi-Objective
Learning: A Provably Convergent Approach, ICLR 2023, arXiv:2210.12624, algorithm 1. As in LibMTL,
what is tracked is h_i = L_i g_i / ||g_i|| (with scaled = False the algorithm's g_i), and the
direction takes y and lambda after their steps. There a softmax replaces the projection on the
simplex: it has no weight 0 and another fixed point.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import descend
from ._state import Rows


class MoCo(GradientMethod):
    """d = y^T l with y <- y - beta_k (y - h), l <- Pi(l - gamma_k (y y^T + rho) l)

    Args:
        beta, gamma: step sizes of y and lambda, both divided by k^decay at step k; the defaults are
            LibMTL's.
        decay: 0.5; 0 keeps both constant.
        rho: pulls lambda towards equal weights.
        scaled: track L_i g_i / ||g_i||.
    """

    space = {"beta": {"uniform": [0.5, 0.99]}}

    needs = "jacobian"
    lambda_T: Tensor
    step: Tensor

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        beta: float = 0.5,
        gamma: float = 0.1,
        decay: float = 0.5,
        rho: float = 0.0,
        scaled: bool = True,
    ):
        super().__init__(terms, seed)
        self.beta, self.gamma, self.decay, self.rho = beta, gamma, decay, rho
        self.scaled = scaled
        equal_T = torch.full((len(terms),), 1 / len(terms), dtype=torch.float64)
        self.register_buffer("lambda_T", equal_T)
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        self.tracked = Rows(len(terms))

    def direction(self, J_KP: Tensor, step: Step) -> tuple[Tensor, Tensor]:
        self.step += 1
        shrink = self.step.item() ** -self.decay
        y_KP = self.tracked.of(step.present, J_KP)
        y_KP = y_KP - self.beta * shrink * (y_KP - self._h(J_KP, step.loss_K))
        self.tracked.keep(step.present, y_KP)
        lambda_K = self.lambda_T[step.present].cpu()
        slope_K = (y_KP @ y_KP.T).double().cpu() @ lambda_K + self.rho * lambda_K
        lambda_K = descend(lambda_K, self.gamma * shrink * slope_K)
        self.lambda_T[step.present] = lambda_K.to(self.lambda_T)
        weight_K = lambda_K.to(J_KP)
        return weight_K @ y_KP, weight_K

    def _h(self, J_KP: Tensor, loss_K: Tensor) -> Tensor:
        if not self.scaled:
            return J_KP
        norm_K = torch.linalg.vector_norm(J_KP, dim=1, dtype=torch.float64)
        scale_K = torch.where(norm_K > 0, loss_K / norm_K, 0)
        return scale_K.to(J_KP)[:, None] * J_KP
