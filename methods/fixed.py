"""Constant weights, the paper's by default: the baseline that every method has to beat.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 3.2: semantic 1, center 200,
offset 0.01, photometric 1, smoothness 0.001, after Panoptic-DeepLab and Monodepth2. With prior =
"equal" it is equal weighting: the plain sum, which some public code divides by the number of terms.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.plain import did_you_mean
from mtl_bench.core.task import loss_names
from mtl_bench.core.terms import Term

PRIORS = ("paper", "equal")


class Fixed(LossMethod):
    """sum_i w_i L_i

    Args:
        prior: "paper" (the weights above) or "equal" (all 1).
        weights: replace single ones, by the name of a loss term or task.

    Raises:
        ValueError: an unknown prior or name, or a weight below 0.
    """

    weight_T: Tensor

    def __init__(
        self,
        terms: Sequence[Term],
        seed: int = 0,
        prior: str = "paper",
        weights: Mapping[str, float] = MappingProxyType({}),
    ):
        super().__init__(terms, seed)
        if prior not in PRIORS:
            raise ValueError(f"no prior called '{prior}'{did_you_mean(prior, PRIORS)}")
        for name in weights.keys() - {term.name for term in terms}:
            known = loss_names()  # of another task: a cell's weights are those of its parts, too
            if name not in known:
                raise ValueError(f"no loss called '{name}' to weigh{did_you_mean(name, known)}")
        for name, value in weights.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"the weight of '{name}' must be >= 0 and finite, not {value}")
        start = {term.name: term.fixed_weight if prior == "paper" else 1.0 for term in terms}
        weight = [float(weights.get(name, start[name])) for name in start]
        self.register_buffer("weight_T", torch.tensor(weight), persistent=False)

    def total(self, step: Step) -> Tensor:
        return (self.weight_T[step.present] * step.loss_K).sum()
