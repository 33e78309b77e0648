"""Descent on the simplex of weights."""

from torch import Tensor

from ._solvers import project_on_simplex


def descend(weight_K: Tensor, step_K: Tensor) -> Tensor:
    """The nearest weights >= 0 to `weight - step` that have the same sum as before.

    The sum is 1, less what tasks without labels in this batch have and keep.
    """
    sum_ = weight_K.sum().clamp_min(1e-12)  # 0 if absent tasks have everything
    moved_K = (weight_K - step_K) / sum_
    return sum_ * project_on_simplex(moved_K - moved_K.max())  # the same point, exact when far away
