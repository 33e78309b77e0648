"""Fixed shares of the tasks, equal by default: scalarisation, whose weights are tuned by trials.

Source: Xin, Ghorbani, Garg, Firat, Gilmer, Do Current Multi-Task Optimization Methods in Deep
Learning Even Help?, NeurIPS 2022, arXiv:2209.11379, who scan the weights of the sum and find that
methods land on the front that this gives. Its trials are draws from the simplex of shares, denser
in its middle: of ten uniform shares the smallest is a hundredth of the largest. Few draws come near
the best where losses differ ten-thousandfold: half of the trials therefore share out the losses in
units of their first values, by weights as constant as the others.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class Scalarised(LossMethod):
    """K sum_i s_i L_i with shares s of the K tasks, which add up to 1; relative: L_i / L_i(0)

    A task's terms share its weight, at their fixed weights.

    Args:
        shares: by task, of all of them and in any unit; none: equal ones.
        relative: to the task's loss when it was first there.

    Raises:
        ValueError: a task without its share, a share without its task, or one below 0.
    """

    space = {"shares": {"dirichlet": 2.0}, "relative": [False, True]}
    weight_T: Tensor
    task_T: Tensor  # number of each term's task
    start_Q: Tensor  # L(0) of each task, 0 before there is one

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        shares: Mapping[str, float] = MappingProxyType({}),
        relative: bool = False,
    ):
        super().__init__(terms, seed)
        tasks = list(dict.fromkeys(term.task for term in terms))
        shares = shares or dict.fromkeys(tasks, 1.0)
        for task in tasks:
            if task not in shares:
                raise ValueError(f"shares has none for the task '{task}': give one for each")
        for task, share in shares.items():
            if not 0 <= share < math.inf:
                raise ValueError(f"the share of '{task}' must be >= 0 and finite, not {share}")
        total = sum(shares[task] for task in tasks) or 1.0
        weight = [t.fixed_weight * len(tasks) * shares[t.task] / total for t in terms]
        self.register_buffer("weight_T", torch.tensor(weight), persistent=False)
        numbers = torch.tensor([tasks.index(term.task) for term in terms])
        self.register_buffer("task_T", numbers, persistent=False)
        self.register_buffer("start_Q", torch.zeros(len(tasks)))
        self.relative = relative

    def total(self, step: Step) -> Tensor:
        weight_K = self.weight_T[step.present]
        if self.relative:
            weight_K = weight_K / self._first(step)
        return (weight_K * step.loss_K).sum()

    def _first(self, step: Step) -> Tensor:
        """L(0) of each present term's task, 1 of a task without a loss above 0."""
        task_K = self.task_T[step.present]
        loss_K = self.fixed_T[step.present] * step.loss_K.detach()
        now_Q = torch.zeros_like(self.start_Q).index_add_(0, task_K, loss_K.to(self.start_Q))
        self.start_Q.copy_(torch.where(self.start_Q > 0, self.start_Q, now_Q))
        return torch.where(self.start_Q > 0, self.start_Q, 1.0)[task_K]
