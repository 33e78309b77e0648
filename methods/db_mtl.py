"""DB-MTL: gradients of log losses, averaged over time and all made as long as the longest.

Source: Lin, Jiang, Ye, Zhang, Chen, Chen, Liu, Tsang, Kwok, Dual-Balancing for Multi-Task Learning,
ArXiv 2023, arXiv:2308.12029, algorithm 1 (accepted by the journal Neural Networks). As there, the
average starts at 0 and has no bias correction: the first update is (1 - beta) times too short. The
decoders are trained on the logarithms. The logged weights are those of the losses' gradients as if
the average were of this step only; public code logs ones.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._state import Rows

EPS = 1e-8  # added to a loss


class DualBalancing(GradientMethod):
    """d = max_j ||m_j|| sum_i m_i / ||m_i|| with m_i <- beta_k m_i + (1 - beta_k) grad log(L_i)

    Args:
        beta: 0.9; 0.1, 0.5 and 0.9 were searched in the paper.
        decay: beta_k = beta / k^decay at step k; 0, or 0.5 in the paper's search.
    """

    space = {"beta": [0.1, 0.5, 0.9], "decay": [0.0, 0.5]}

    needs = "jacobian"
    weighted_heads = True
    step: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0, beta: float = 0.9, decay: float = 0.0):
        super().__init__(terms, seed)
        self.beta, self.decay = beta, decay
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        self.average = Rows(len(terms))

    def direction(self, J_KP: Tensor, step: Step) -> tuple[Tensor, Tensor]:
        self.step += 1
        beta = self.beta / self.step.item() ** self.decay
        log_K = 1 / (step.loss_K.to(J_KP) + EPS)
        m_KP = torch.lerp(log_K[:, None] * J_KP, self.average.of(step.present, J_KP), beta)
        self.average.keep(step.present, m_KP)
        norm_K = torch.linalg.vector_norm(m_KP, dim=1, dtype=torch.float64)
        stretch_K = torch.where(norm_K > 0, norm_K.max() / norm_K, 0).to(J_KP)
        return stretch_K @ m_KP, stretch_K * log_K

    def head_weights(self, weight_K: Tensor, step: Step) -> Tensor:
        return 1 / (step.loss_K + EPS)
