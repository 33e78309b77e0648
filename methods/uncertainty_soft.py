"""Uncertainty weighting solved in closed form, 1 / L, and softened by a softmax.

Source: Kirchdorfer, Elich, Kutsche, Stuckenschmidt, Schott, Koehler, Analytical Uncertainty-Based
Loss Weighting in Multi-Task Learning, GCPR 2024, arXiv:2408.07985 (UW-SO). The paper tunes T for
each data set and network, and so must you: 1 / L has a scale, and far below it the smallest loss
takes all the weight. Losses below 1e-8 count as 1e-8 there.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


class UncertaintySoft(LossMethod):
    """sum_i w_i L_i with w = softmax(1 / (L T)), no gradient through w; the weights sum to 1

    Args:
        temperature: T. 1 / L of the built-in data's loss terms goes from 0.1 to 200, hence 100.
    """

    space = {"temperature": {"log": [1.0, 1000.0]}}

    def __init__(self, terms: Sequence[Term], seed: int = 0, temperature: float = 100.0):
        super().__init__(terms, seed)
        if temperature <= 0:
            raise ValueError(f"temperature {temperature} must be positive")
        self.temperature = temperature

    def total(self, step: Step) -> Tensor:
        precision_K = 1 / step.loss_K.detach().clamp_min(1e-8)
        return (torch.softmax(precision_K / self.temperature, 0) * step.loss_K).sum()
