"""The plain sum of the gradients, for what goes around a gradient method and is used alone."""

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step


class Sum(GradientMethod):
    """w_i = 1"""

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        return torch.ones_like(step.loss_K)
