"""What every weighting method has to hold, tried on a toy and on hard inputs.

Shapes: T losses, P shared parameters.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from mtl_bench.bench.check.side_by_side import side_by_side
from mtl_bench.bench.space import of_method
from mtl_bench.core import plugins
from mtl_bench.core.method import (
    GradientMethod,
    LookAheadMethod,
    LossMethod,
    Method,
    PerturbedMethod,
    Step,
)
from mtl_bench.core.terms import Term
from mtl_bench.train.backward import ALONE, Pass, Weighting, backward, reevaluate
from mtl_bench.train.together import Together

LOSSES = (  # of two tasks, with weights as far apart as real ones
    Term("a", "first", "classification", 1.0),
    Term("b", "first", "regression", 200.0),
    Term("c", "first", "regression", 0.01),
    Term("d", "second", "regression", 1.0),
    Term("e", "second", "regression", 0.001),
)
LR = 0.02


class Quadratics(nn.Module):
    """A toy with shared and own parameters: each loss pulls the shared point to its own target.

    `terms` are those that the next batch has.
    """

    def __init__(self, terms: Sequence[Term] = LOSSES, size: int = 6):
        super().__init__()
        draw = torch.Generator().manual_seed(1)
        self.terms = tuple(terms)
        self.shared = nn.Parameter(torch.randn(size, generator=draw))
        self.own = nn.ParameterDict({term.name: nn.Parameter(torch.ones(())) for term in terms})
        targets_TS = torch.randn(len(terms), size, generator=draw)
        self.target = {t.name: target for t, target in zip(terms, targets_TS, strict=True)}

    def shared_parameters(self) -> Iterator[nn.Parameter]:
        yield self.shared

    def task_parameters(self) -> Iterator[nn.Parameter]:
        yield from self.own.values()

    def forward(self, number: int = 0) -> Pass:
        """Of a batch's part: in each the bowls are a little further, and it lacks as many losses as
        there were parts before it."""
        read = self.shared.view_as(self.shared)
        losses = {
            term.name: (read - self.target[term.name] - 0.1 * number).square().mean()
            + self.own[term.name].square()
            + 0.1
            for term in self.terms[: len(self.terms) - number]
        }
        return Pass(losses, [read])

    def distances(self) -> list[float]:
        """What the shared point alone adds to each loss; own parameters may hide its way up."""
        return [float((self.shared - x).detach().square().mean()) for x in self.target.values()]


def step_toy(
    method: Method,
    toy: Quadratics,
    scale: float = 1.0,
    numbers: Sequence[int] = (0,),
    together: Together = ALONE,
) -> Weighting:
    """One step of gradient descent, of a length that no method can make explode.

    Args:
        numbers: of the batch's parts.
    """
    parameters = [*toy.parameters(), *method.parameters()]
    for parameter in parameters:
        parameter.grad = None
    parts = [[partial(toy.forward, number) for number in numbers]] * method.batches
    weighting = backward(method, parts, toy, scale=scale, lr=LR, together=together)
    with torch.no_grad():
        for parameter in parameters:
            if parameter.grad is not None:
                grad = parameter.grad / scale
                parameter.sub_(LR * grad / grad.norm().clamp_min(1.0))
    if method.reevaluates:
        reevaluate(method, weighting.step, parts[0], toy, together)
    return weighting


def _steps(method: Method, toy: Quadratics, steps: int, scale: float = 1.0) -> Tensor:
    """Where the shared point is after some steps."""
    for _ in range(steps):
        step_toy(method, toy, scale)
    return toy.shared.detach().clone()


def _trace(method: Method, toy: Quadratics, steps: int) -> list[list[float]]:
    """The point and the weights of every step: a step's length alone may hide how they differ."""
    weights = [list(step_toy(method, toy).weights.values()) for _ in range(steps)]
    return [*weights, toy.shared.tolist()]


# --- on the toy -----------------------------------------------------------------------------------


def _learns(kind: type[Method]) -> None:
    toy = Quadratics()
    before = toy.distances()
    _steps(kind(LOSSES, seed=3), toy, 60)
    after = toy.distances()
    if not any(new < old for new, old in zip(after, before, strict=True)):
        raise ValueError(f"60 steps lead down in none of {len(LOSSES)} bowls: {before} to {after}")


def _same_seed_same_update(kind: type[Method]) -> None:
    first, second = (_trace(kind(LOSSES, seed=3), Quadratics(), 3) for _ in range(2))
    if first != second:
        raise ValueError("two runs with one seed differ: draw from self.generator only")


def _state_round_trip(kind: type[Method]) -> None:
    straight = _trace(kind(LOSSES, seed=3), Quadratics(), 6)
    toy, first = Quadratics(), kind(LOSSES, seed=3)
    _steps(first, toy, 3)
    second = kind(LOSSES, seed=99)
    second.load_state_dict(first.state_dict())
    if _trace(second, toy, 3) != straight[3:]:
        raise ValueError("3 steps, save, load, 3 steps is not 6 steps: some state is not saved")


def _one_term(kind: type[Method]) -> None:
    """With a single loss, the shared update is that loss's gradient up to a positive factor.

    A method that takes gradients elsewhere is exempt.
    """
    if issubclass(kind, PerturbedMethod):
        return
    toy = Quadratics()
    toy.terms = LOSSES[:1]
    (loss,) = toy.forward().losses.values()
    (plain,) = torch.autograd.grad(loss, toy.shared)
    method = kind(toy.terms, seed=0)
    backward(method, [[toy.forward]] * method.batches, toy, lr=LR)
    assert toy.shared.grad is not None
    cosine = torch.cosine_similarity(plain, toy.shared.grad, dim=0)
    if cosine < 1 - 1e-5:
        raise ValueError(
            f"one loss, but the update is not along its gradient (cosine {cosine:.4f})"
        )


def _permutation(kind: type[Method]) -> None:
    """The order of the losses changes nothing; a method that draws at random is exempt."""
    method = kind(LOSSES, seed=3)
    untouched = method.generator.get_state()
    point = _steps(method, Quadratics(), 3)
    if not torch.equal(method.generator.get_state(), untouched):
        return
    turned = (*LOSSES[2:], *LOSSES[:2])
    toy = Quadratics()
    toy.terms = turned
    other = _steps(kind(turned, seed=3), toy, 3)
    if not torch.allclose(point, other, rtol=1e-4, atol=1e-5):
        raise ValueError(f"in another order the losses lead elsewhere: {point} and {other}")


def _missing_labels(kind: type[Method]) -> None:
    """A batch may lack a task's losses; the others are trained, and all again afterwards."""
    method, toy = kind(LOSSES, seed=3), Quadratics()
    full, partial = LOSSES, LOSSES[:3]
    for terms in (full, partial, full, full, partial):
        toy.terms = terms
        weighting = step_toy(method, toy)
        if list(weighting.weights) != [term.name for term in terms]:
            raise ValueError(f"weights for {list(weighting.weights)}, not for {len(terms)} losses")
        if not torch.isfinite(toy.shared).all():
            raise ValueError(f"with {len(terms)} of {len(LOSSES)} losses the update is not finite")


def _loss_scale(kind: type[Method]) -> None:
    """The scale of fp16 training is for the optimiser; a method decides as without it."""
    plain = _steps(kind(LOSSES, seed=3), Quadratics(), 3)
    scaled = _steps(kind(LOSSES, seed=3), Quadratics(), 3, scale=1024.0)
    if not torch.allclose(plain, scaled, rtol=1e-4, atol=1e-6):
        raise ValueError(f"a loss scale of 1024 leads elsewhere: {plain} and {scaled}")


def _two_ranks(kind: type[Method]) -> None:
    """Two ranks with a part of each batch do, bit for bit, what one process does with both."""

    def trained(numbers: Sequence[int], together: Together) -> list[list[float]]:
        method, toy = kind(LOSSES, seed=3), Quadratics()
        weights = [
            list(step_toy(method, toy, numbers=numbers, together=together).weights.values())
            for _ in range(3)
        ]
        return [*weights, *(parameter.flatten().tolist() for parameter in toy.parameters())]

    one = trained((0, 1), ALONE)
    for rank, several in enumerate(side_by_side(2, lambda r: trained((r.rank,), Together(r)))):
        if several != one:
            raise ValueError(
                f"rank {rank} of two differs from one process with both parts of a batch: keep "
                f"state in the instance, and draw from self.generator only; {several} and {one}"
            )


# --- on hard inputs -------------------------------------------------------------------------------


def _finite(kind: type[Method]) -> None:
    """Finite answers for hard inputs; inputs stay as they were."""
    for size in (0.0, 1e-10, 1.0, 1e10):
        step = Step(torch.full((len(LOSSES),), size), torch.arange(len(LOSSES)))
        method = kind(LOSSES, seed=0)
        if isinstance(method, LossMethod):
            _finite_weights(method, step)
        elif isinstance(method, GradientMethod):
            for title, J_TP in _hard_jacobians(size or 1.0).items():
                _finite_answer(kind(LOSSES, seed=0), J_TP, step, f"{title} at {size}")


def _finite_weights(method: LossMethod, step: Step) -> None:
    leaf_T = step.loss_K.clone().requires_grad_()
    total = method.total(Step(leaf_T, step.present))
    (weight_T,) = torch.autograd.grad(total, leaf_T)
    if not (torch.isfinite(total) and torch.isfinite(weight_T).all()):
        losses, weights = step.loss_K.tolist(), weight_T.tolist()
        raise ValueError(f"losses {losses} give total {total}, weights {weights}")
    if not torch.equal(leaf_T.detach(), step.loss_K):
        raise ValueError("total() changed its input in place")


def _finite_answer(method: Method, J_TP: Tensor, step: Step, title: str) -> None:
    assert isinstance(method, GradientMethod)
    if method.needs == "jacobian":
        given = J_TP.clone()
        if isinstance(method, LookAheadMethod):
            answer = method.direction_ahead(given, step, lambda direction_P: J_TP, LR)
        else:
            answer = method.direction(given, step)
        same = torch.equal(given, J_TP)
    else:
        G_TT = (J_TP @ J_TP.T).double()
        given = G_TT.clone()
        weight_T = method.weights(given, Step(step.loss_K.double(), step.present)).to(J_TP)
        answer = weight_T @ J_TP, weight_T
        same = torch.equal(given, G_TT)
    if not all(torch.isfinite(part).all() for part in answer):
        raise ValueError(f"gradients '{title}' give a direction or weights that are not finite")
    if not same:
        raise ValueError("direction() or weights() changed its input in place")


def _hard_jacobians(size: float) -> dict[str, Tensor]:
    draw = torch.Generator().manual_seed(2)
    J_TP = torch.randn(len(LOSSES), 12, generator=draw)
    opposite, zero_row, twice, ill = (J_TP.clone() for _ in range(4))
    opposite[1] = -opposite[0]
    zero_row[2] = 0
    twice[3] = twice[1]
    ill *= torch.logspace(-3, 3, len(LOSSES))[:, None]
    cases = {"random": J_TP, "zero": 0 * J_TP, "equal": J_TP[:1].repeat(len(LOSSES), 1)}
    cases |= {"opposite": opposite, "one zero": zero_row, "one twice": twice, "ill-scaled": ill}
    return {title: size * case for title, case in cases.items()}


# --- on what it declares --------------------------------------------------------------------------


def _space(kind: type[Method]) -> None:
    """What may be tuned can be drawn, and trials read in the file what the class has."""
    read = of_method(plugins.name_of(Path(inspect.getfile(kind))))
    if read != kind.space:
        raise ValueError(f"trials read space = {read} in the file, and the class has {kind.space}")


def _replayable(kind: type[Method]) -> None:
    """A direction that can be replayed is that of the weights."""
    method = kind(LOSSES, seed=0)
    if method.needs == "jacobian" and getattr(method, "replayable", False):
        assert isinstance(method, GradientMethod)
        J_TP = _hard_jacobians(1.0)["random"]
        step = Step(torch.ones(len(LOSSES)), torch.arange(len(LOSSES)))
        direction_P, weight_T = method.direction(J_TP.clone(), step)
        if not torch.allclose(direction_P, weight_T.to(J_TP) @ J_TP, rtol=1e-4, atol=1e-5):
            raise ValueError("replayable = True, but the direction is not weights @ J")


METHOD_CHECKS: dict[str, Callable[[type[Method]], None]] = {
    "learns": _learns,
    "finite on hard inputs": _finite,
    "one loss is plain training": _one_term,
    "same seed, same update": _same_seed_same_update,
    "state round trip": _state_round_trip,
    "order of losses": _permutation,
    "missing labels": _missing_labels,
    "invisible loss scale": _loss_scale,
    "two ranks are one": _two_ranks,
    "space of hyper-parameters": _space,
    "replayable": _replayable,
}
