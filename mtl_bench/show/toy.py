"""The field's toy: two losses of two parameters, whose Pareto set lies behind a bend and a valley.

Source: Liu, Liu, Jin, Stone, Liu, Conflict-Averse Gradient Descent for Multi-task Learning, NeurIPS
2021, arXiv:2110.14048; scaled, started and bounded as in Nash-MTL (ICML 2022) and FAMO (NeurIPS
2023): the first loss counts a tenth, Adam moves the parameters, and both losses are counted from
below their minima, as logarithms need losses above 0. The published learning rate is 1e-3. Elich et
al. (2023) find that the plain sum arrives, too, with a larger one: hence a grid of them.

A method is asked as `train.backward` asks it; the gradients are written out, so that a step takes
microseconds and not milliseconds. The toy is deterministic: a method that wants several batches
gets the same one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core.method import (
    Composed,
    GradientMethod,
    LookAheadMethod,
    LossMethod,
    Method,
    PerturbedMethod,
    Step,
)
from mtl_bench.core.terms import Term

TERMS = (Term("l1", "l1", "regression", 1.0), Term("l2", "l2", "regression", 1.0))
STARTS = ((-8.5, 7.5), (0.0, 0.0), (9.0, 9.0), (-7.5, -0.5), (9.0, -1.0))
SCALES = (0.1, 1.0)
BOUNDS = (-2.1, -21.0)  # FAMO's, of the scaled losses
LEAST = 5e-6  # what the logarithms see at least
PARETO_Y, PARETO_X = -8.3552, (-7.0, 7.0)  # the Pareto set: a segment
SUM_X = -7 * (1 - 0.1) / (1 + 0.1)  # where on it the scaled losses' sum is least
NEAR, STAY = 0.1, 20  # it is reached once so many steps in a row are as near
METHOD_LR = 0.025  # of what a method itself learns
BETAS, EPS = (0.9, 0.999), 1e-8

Loss = tuple[float, float, float]  # its value, and its derivatives by x and y


@dataclass(frozen=True)
class Path:
    points_N2: NDArray[np.float64]  # the start, and where every step led
    reached: int | None  # steps to the Pareto set; None: not within them


def losses(x: float, y: float) -> tuple[Loss, Loss]:
    """Both losses at a point, scaled and counted from their bounds."""
    upper = math.tanh(y / 2)  # > 0: the valleys' share of a loss, < 0: the bowls'
    slope = (1 - upper**2) / 2
    c1, d1 = max(upper, 0.0), slope * ((upper > 0) + 0.5 * (upper == 0))
    c2, d2 = max(-upper, 0.0), -slope * ((upper < 0) + 0.5 * (upper == 0))
    bend = math.tanh(-y)
    down = bend**2 - 1  # its derivative
    found = []
    for inside, along, center, scale, bound in (
        ((-x - 7) / 2 - bend, -down, 7.0, SCALES[0], BOUNDS[0]),
        ((-x + 3) / 2 + bend + 2, down, -7.0, SCALES[1], BOUNDS[1]),
    ):
        seen = abs(inside) > LEAST  # else the logarithm is constant
        f = math.log(max(abs(inside), LEAST)) + 6
        g = ((center - x) ** 2 + (-y - 8) ** 2 / 10) / 10 - 20
        by_x = c1 * (-0.5 / inside if seen else 0.0) - c2 * (center - x) / 5
        by_y = c1 * (along / inside if seen else 0.0) + c2 * (y + 8) / 50 + d1 * f + d2 * g
        found.append((scale * (c1 * f + c2 * g) - bound, scale * by_x, scale * by_y))
    return found[0], found[1]


def distance(x: float, y: float) -> float:
    """To the Pareto set."""
    return math.hypot(x - min(max(x, PARETO_X[0]), PARETO_X[1]), y - PARETO_Y)


def walk(method: Method, start: tuple[float, float], lr: float, steps: int) -> Path:
    """Where a method leads; it stops where the Pareto set is reached.

    Args:
        method: a fresh one over TERMS.
        lr: of the Adam that moves the point.
        steps: at most.

    Raises:
        FloatingPointError: the point is no number any more.
    """
    own = list(method.parameters())
    optimizer = torch.optim.Adam(own, lr=METHOD_LR) if own else None
    here, mean, square = start, [0.0, 0.0], [0.0, 0.0]
    points, near = [here], 0
    for count in range(1, steps + 1):
        step, direction = _asked(method, here, lr)
        if optimizer:
            optimizer.step()
            optimizer.zero_grad()
        moved = list(here)
        for i, slope in enumerate(direction):
            mean[i] = BETAS[0] * mean[i] + (1 - BETAS[0]) * slope
            square[i] = BETAS[1] * square[i] + (1 - BETAS[1]) * slope**2
            spread = math.sqrt(square[i] / (1 - BETAS[1] ** count)) + EPS
            moved[i] -= lr * mean[i] / (1 - BETAS[0] ** count) / spread
        here = (moved[0], moved[1])
        if not math.isfinite(sum(here)):
            raise FloatingPointError(f"the toy's point is {here} after {count} steps at lr {lr}")
        if method.reevaluates:
            method.after_step(step, _values(here))
        points.append(here)
        near = near + 1 if distance(*here) <= NEAR else 0
        if near == STAY:
            return Path(np.array(points), count - STAY + 1)
    return Path(np.array(points), None)


def _values(here: tuple[float, float]) -> Tensor:
    return torch.tensor([loss[0] for loss in losses(*here)])


def _asked(
    method: Method, here: tuple[float, float], lr: float
) -> tuple[Step, tuple[float, float]]:
    """The method's update direction at a point; its own parameters get their gradients."""
    step = Step(_values(here), torch.arange(2))
    if isinstance(method, LossMethod):
        return step, _weighted(here, _derivatives(method, step))
    first_2 = torch.ones(2)
    if isinstance(method, Composed):
        first_2 = _derivatives(method.loss, step)
    seen, method = Step(first_2 * step.loss_K, step.present), getattr(method, "gradient", method)
    assert isinstance(method, GradientMethod)
    J_22 = _jacobian(here)
    if isinstance(method, PerturbedMethod):
        J_22 = _perturbed(method, here, J_22, step)
    J_22 = J_22 * first_2[:, None]
    with torch.no_grad():
        if isinstance(method, LookAheadMethod):
            direction_2, _ = method.direction_ahead(J_22, seen, _ahead(here, first_2, lr), lr)
        elif method.needs == "jacobian":
            direction_2, _ = method.direction(J_22, seen)
        else:
            G_22 = J_22.double()
            exact = Step(seen.loss_K.double(), seen.present)
            weight_2 = method.weights(G_22 @ G_22.T, exact)
            direction_2 = weight_2.to(J_22) @ J_22
    x, y = direction_2.tolist()
    return step, (x, y)


def _perturbed(
    method: PerturbedMethod, here: tuple[float, float], J_22: Tensor, step: Step
) -> Tensor:
    """Each loss's gradient where the method moves the point for it."""

    def moved(shift: Sequence[Tensor]) -> tuple[float, float]:
        x, y = shift[0].tolist()
        return here[0] + x, here[1] + y

    shifts = method.shifts([J_22.sum(0)], lambda shift: _values(moved(shift)), step)
    return torch.stack([_jacobian(moved(shift))[i] for i, shift in enumerate(shifts)])


def _jacobian(here: tuple[float, float]) -> Tensor:
    return torch.tensor([loss[1:] for loss in losses(*here)])


def _weighted(here: tuple[float, float], weight_2: Tensor) -> tuple[float, float]:
    (_, x1, y1), (_, x2, y2) = losses(*here)
    w1, w2 = weight_2.tolist()
    return w1 * x1 + w2 * x2, w1 * y1 + w2 * y2


def _derivatives(method: LossMethod, step: Step) -> Tensor:
    leaf_2 = step.loss_K.clone().requires_grad_()
    method.total(Step(leaf_2, step.present)).backward()
    assert leaf_2.grad is not None
    return leaf_2.grad


def _ahead(here: tuple[float, float], first_2: Tensor, lr: float) -> Callable[[Tensor], Tensor]:
    def ahead(direction_2: Tensor) -> Tensor:
        x, y = (at - lr * move for at, move in zip(here, direction_2.tolist(), strict=True))
        return _jacobian((x, y)) * first_2[:, None]

    return ahead
