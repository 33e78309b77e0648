"""LDC-MTL: a weighted sum whose weights are learned, and a penalty on losses that drift apart.

Source: Xiao, Dong, Zou, Ji, LDC-MTL: Balancing Multi-Task Learning through Scalable Loss
Discrepancy Control, ArXiv 2025, arXiv:2502.08585, in its single-loop form, which descends both
levels at once. Written from notes about the paper and reviews of it, not from its text, and held
against no published number. Departures: the paper's router computes the weights from features; a
loss-value method sees none, so its logits are learned by themselves. The paper penalises tasks that
are neighbours in some order; here all pairs are, times 2 / K, which is the mean over all orders and
the same for two tasks. A weight may become negative: that is the penalty's work. A loss that starts
at 0 is not divided.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class LossDiscrepancyControl(LossMethod):
    """sum_i s_i l_i + lam (2 / K) sum_(i<j) |tau_i l_i - tau_j l_j| with s = softmax(a), a learned

    and l_i = L_i / L_i(0).

    Args:
        lam: of the penalty; 0.01 to 0.1 in the paper.
        tau: "one" or "weights" (tau = s); the paper takes either, by the data set.
        normalize: "start" (l as above) or "none" (l = L).
    """

    space = {"lam": {"log": [0.01, 0.1]}}

    start_T: Tensor  # L_i(0); 0: not seen yet

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        lam: float = 0.1,
        tau: str = "one",
        normalize: str = "start",
    ):
        super().__init__(terms, seed)
        for name, value, known in (
            ("tau", tau, ("one", "weights")),
            ("normalize", normalize, ("start", "none")),
        ):
            if value not in known:
                raise ValueError(f"{name} '{value}' is not one of {', '.join(known)}")
        self.lam, self.tau, self.normalize = lam, tau, normalize
        self.logit_T = nn.Parameter(torch.zeros(len(terms)))
        self.register_buffer("start_T", torch.zeros(len(terms)))

    def total(self, step: Step) -> Tensor:
        share_K = torch.softmax(self.logit_T[step.present], 0)
        l_K = step.loss_K / self._start(step) if self.normalize == "start" else step.loss_K
        level_K = share_K * l_K if self.tau == "weights" else l_K
        apart = (level_K - level_K[:, None]).abs().sum() / len(l_K)  # every pair stands twice in it
        return (share_K * l_K).sum() + self.lam * apart

    def _start(self, step: Step) -> Tensor:
        start_K, loss_K = self.start_T[step.present], step.loss_K.detach()
        start_K = torch.where(start_K > 0, start_K, loss_K.to(start_K))
        self.start_T[step.present] = start_K
        return torch.where(start_K > 0, start_K, 1.0)
