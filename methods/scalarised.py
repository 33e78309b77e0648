"""Fixed shares of the tasks, equal by default: scalarisation, whose weights are tuned by trials.

Source: Xin, Ghorbani, Garg, Firat, Gilmer, Do Current Multi-Task Optimization Methods in Deep
Learning Even Help?, NeurIPS 2022, arXiv:2209.11379, who scan the weights of the sum and find that
methods land on the front that this gives. Its trials are draws from the simplex of shares.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class Scalarised(LossMethod):
    """K sum_i s_i L_i with shares s of the K tasks, which add up to 1

    A task's terms share its weight, at their fixed weights.

    Args:
        shares: by task, of all of them and in any unit; none: equal ones.

    Raises:
        ValueError: a task without its share, a share without its task, or one below 0.
    """

    space = {"shares": {"dirichlet": 1.0}}
    weight_T: Tensor

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        shares: Mapping[str, float] = MappingProxyType({}),
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

    def total(self, step: Step) -> Tensor:
        return (self.weight_T[step.present] * step.loss_K).sum()
