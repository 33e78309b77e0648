"""Dynamic weight average: a loss weighs more the less it fell from one window to the next.

Source: Liu, Johns, Davison, End-to-End Multi-Task Learning with Attention, CVPR 2019,
arXiv:1803.10704, equation 7. The paper compares epochs; here a window is a number of steps, so that
its length does not hang on the data set (an epoch of the built-in data at batch 8 is 100 steps).
Every loss counts its own steps. One public variant makes the weights sum to 1 in place of K.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import Term


class DynamicWeightAverage(LossMethod):
    """sum_i w_i L_i with w = K softmax(r / T), r_i = L_i's last window mean over the one before

    Args:
        window: steps per mean; one epoch in the paper. The first two windows have w = 1.
        temperature: T; 2 in the paper. Higher is more even.
    """

    sum_T: Tensor  # of the losses of the open window, and their number
    count_T: Tensor
    mean_T: Tensor  # of the last full window; 0: there is none
    ratio_T: Tensor

    def __init__(
        self, terms: Sequence[Term], seed: int = 0, window: int = 100, temperature: float = 2.0
    ):
        super().__init__(terms, seed)
        if window < 1 or temperature <= 0:
            raise ValueError(f"window {window} and temperature {temperature} must be positive")
        self.window, self.temperature = window, temperature
        for name in ("sum_T", "count_T", "mean_T"):
            self.register_buffer(name, torch.zeros(len(terms)))
        self.register_buffer("ratio_T", torch.ones(len(terms)))

    def total(self, loss_K: Tensor) -> Tensor:
        ratio_K = self.ratio_T[self.present]
        weight_K = len(ratio_K) * torch.softmax(ratio_K / self.temperature, 0)
        self._remember(loss_K.detach())
        return (weight_K * loss_K).sum()

    def _remember(self, loss_K: Tensor) -> None:
        self.sum_T[self.present] += loss_K
        self.count_T[self.present] += 1
        full_T = self.count_T == self.window
        mean_T = self.sum_T / self.window
        compared_T = full_T & (self.mean_T > 0)
        self.ratio_T = torch.where(compared_T, mean_T / self.mean_T, self.ratio_T)
        self.mean_T = torch.where(full_T, mean_T, self.mean_T)
        self.sum_T = self.sum_T.masked_fill(full_T, 0)
        self.count_T = self.count_T.masked_fill(full_T, 0)
