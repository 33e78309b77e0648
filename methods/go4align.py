"""GO4Align: tasks whose risks behave alike share a weight, the centre of their group.

Source: Shen, Wang, Xiao, van Noord, Worring, GO4Align: Group Optimization for Multi-Task Alignment,
NeurIPS 2024, arXiv:2404.06486, equations 3 to 7. The groups are the best ones of k-means, which in
one dimension are runs of the sorted indicators and found exactly; the authors start a random search
at every step. Their code takes the sum of the losses where equation 5 has the mean: all weights K
times as large. Losses below 1e-8 count as 1e-8.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class GO4Align(LossMethod):
    """sum_i w_i L_i with w_i the mean of gamma over i's group, gamma_i = q_i mean_j(L_j) / L_i

    and q <- q exp(-beta L), made to sum to 1; the groups are those of k-means of gamma.

    Args:
        groups: at most as many as there are tasks; 2 on NYUv2 and 5 on QM9 in the paper.
        beta: how fast what has lost much falls back; 1e-4 in the authors' code, 0 forgets it.
    """

    log_q_T: Tensor  # up to a constant: q itself would underflow in a long training

    def __init__(self, terms: Sequence[Term], seed: int = 0, groups: int = 2, beta: float = 1e-4):
        super().__init__(terms, seed)
        if groups < 1 or beta < 0:
            raise ValueError(f"groups {groups} must be at least 1, beta {beta} at least 0")
        self.groups, self.beta = groups, beta
        self.register_buffer("log_q_T", torch.zeros(len(terms), dtype=torch.float64))

    def total(self, step: Step) -> Tensor:
        loss_K = step.loss_K.detach().clamp_min(1e-8).to(self.log_q_T)
        self.log_q_T[step.present] -= self.beta * loss_K
        q_K = torch.softmax(self.log_q_T, 0)[step.present]
        weight_K = centres(q_K * loss_K.mean() / loss_K, self.groups)
        return (weight_K.to(step.loss_K) * step.loss_K).sum()


def centres(value_K: Tensor, groups: int) -> Tensor:
    """Each value's mean over its group, by the grouping with the least sum of squared distances."""
    sorted_K, order_K = value_K.sort()
    spread = _spreads(sorted_K)
    least, cuts = spread[0], []  # least[e]: of the first e values in one group, in two, ...
    for _ in range(groups - 1):
        least, cut = (least[:, None] + spread).min(0)
        cuts.append(cut)
    found_K, end = torch.empty_like(value_K), len(value_K)
    for start in (*reversed(cuts), torch.zeros(end + 1, dtype=torch.int64)):
        here = slice(int(start[end]), end)
        found_K[order_K[here]] = sorted_K[here].mean()  # an empty group changes nothing
        end = here.start
    return found_K


def _spreads(sorted_K: Tensor) -> Tensor:
    """[start, end]: the sum of squared distances of a run to its mean; inf where end < start."""
    count = len(sorted_K)
    spread = torch.full((count + 1, count + 1), torch.inf, dtype=sorted_K.dtype)
    mean, sum_ = (
        torch.zeros_like(sorted_K),
        torch.zeros_like(sorted_K),
    )  # of the run from each start
    for end, value in enumerate(sorted_K, start=1):
        length = torch.arange(end, 0, -1)
        away = value - mean[:end]
        mean[:end] += away / length
        sum_[:end] += away * (value - mean[:end])
        spread[:end, end] = sum_[:end]
    return spread.fill_diagonal_(0.0)
