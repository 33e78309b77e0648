"""SDMGrad: a common descent direction that stays near the average gradient, from three batches.

Source: Xiao, Ban, Ji, Direction-oriented Multi-objective Learning: Simple and Provable Stochastic
Algorithms, NeurIPS 2023, arXiv:2305.18409, algorithm 1 with the average as target. Two independent
batches estimate the inner objective without bias, the third trains. As in public code, the matrix
is divided by the squared mean gradient norm, so that `lr` means the same at every scale, and the
direction by 1 + lambda. LibMTL trains the decoders on all three batches, here on the third.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import CrossMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import descend, project_on_simplex


class SDMGrad(CrossMethod):
    """d = J_3^T (w + lam / K) / (1 + lam) with w <- Pi(w - lr v), v the momentum of A (w + lam / K)

    A = J_1 J_2^T, scaled; w starts from the last step's.

    Args:
        lam: lambda, how strongly the average gradient pulls; 0.3 in public code.
        lr, momentum, iterations: of the inner descent; 10 (LibMTL: 5), 0.5 and 20.
    """

    space = {"lr": [5.0, 10.0]}

    w_T: Tensor

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        lam: float = 0.3,
        lr: float = 10.0,
        momentum: float = 0.5,
        iterations: int = 20,
    ):
        super().__init__(terms, seed)
        self.lam, self.lr, self.momentum, self.iterations = lam, lr, momentum, iterations
        self.register_buffer("w_T", torch.full((len(terms),), 1 / len(terms), dtype=torch.float64))

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        scale = G_KK.diagonal().clamp_min(0).sqrt().mean()  # norms; noise can make them negative
        A_KK = G_KK / scale**2 if scale > 0 else G_KK
        w_K = project_on_simplex(self.w_T[step.present].to(A_KK))  # a start: absent tasks drop out
        velocity_K = torch.zeros_like(w_K)
        for _ in range(self.iterations):
            velocity_K = self.momentum * velocity_K + A_KK @ (w_K + self.lam / len(A_KK))
            w_K = descend(w_K, self.lr * velocity_K)
        self.w_T[step.present] = w_K.to(self.w_T)
        return (w_K + self.lam / len(w_K)) / (1 + self.lam)
