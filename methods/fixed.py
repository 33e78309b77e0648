"""Constant weights, the paper's by default: the baseline that every method has to beat.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 3.2: semantic 1, center 200,
offset 0.01, photometric 1, smoothness 0.001, after Panoptic-DeepLab and Monodepth2.
"""

from torch import Tensor

from mtl_bench.method import LossMethod


class Fixed(LossMethod):
    """sum_i w_i L_i"""

    def total(self, loss_T: Tensor) -> Tensor:
        return (self.fixed_T * loss_T).sum()
