"""Depth, and one metric more: the scale-invariant logarithmic error.

Source: Eigen et al., NeurIPS 2014, as KITTI's benchmark writes it: 100 times the standard deviation
of the logarithmic difference, averaged over images.
"""

import numpy as np

from mtl_bench.core.columns import Column
from mtl_bench.tasks.depth import Depth, DepthMetric
from mtl_bench.tasks.depth.metrics import evaluation_mask


class DepthSilog(Depth):
    columns = (Column("silog", "depth.silog", "SILog", -1, 2),)

    def metrics(self, split=None):
        main, *others = super().metrics(split)
        return [Silog(main.protocol), *others]


class Silog(DepthMetric):
    def __init__(self, protocol):
        super().__init__(protocol)
        self.sum = np.zeros(2)  # of the errors, and their number

    def update(self, truth, result):
        mask_HW = evaluation_mask(truth["depth_m"], self.protocol)
        if mask_HW.any():
            difference = np.log(result["depth"][0][mask_HW] / truth["depth_m"][mask_HW])
            self.sum += [100 * difference.std(), 1]
        return super().update(truth, result)

    def state(self):
        return super().state() | {"silog": self.sum}

    def add(self, state):
        super().add(state)
        self.sum += state["silog"]

    def compute(self):
        return super().compute() | {"depth.silog": float(self.sum[0] / max(self.sum[1], 1))}
