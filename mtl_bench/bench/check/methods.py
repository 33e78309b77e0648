"""What every weighting method has to hold, tried on a toy and on hard inputs.

Shapes: T losses, N batches, P shared parameters.
"""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.config import TASKS
from mtl_bench.core.method import GradientMethod, LookAheadMethod, LossMethod, Method
from mtl_bench.core.terms import Term, terms_of
from mtl_bench.train.backward import Pass, Weighting, backward, losses_now
from mtl_bench.train.gradients import stack_losses

TERMS = terms_of(TASKS)
LR = 0.02


class Quadratics(nn.Module):
    """A toy with shared and own parameters: each loss pulls the shared point to its own target."""

    def __init__(self, terms: Sequence[Term], size: int = 6):
        super().__init__()
        draw = torch.Generator().manual_seed(1)
        self.terms = tuple(terms)
        self.shared = nn.Parameter(torch.randn(size, generator=draw))
        self.own = nn.ParameterDict({term.name: nn.Parameter(torch.ones(())) for term in TERMS})
        targets_TS = torch.randn(len(TERMS), size, generator=draw)
        self.target = {t.name: target for t, target in zip(TERMS, targets_TS, strict=True)}

    def shared_parameters(self) -> Iterator[nn.Parameter]:
        yield self.shared

    def task_parameters(self) -> Iterator[nn.Parameter]:
        yield from self.own.values()

    def forward(self) -> Pass:
        read = self.shared.view_as(self.shared)
        losses = {
            term.name: (read - self.target[term.name]).square().mean()
            + self.own[term.name].square()
            + 0.1
            for term in self.terms
        }
        return Pass(losses, [read])

    def distances(self) -> list[float]:
        """What the shared point alone adds to each loss; own parameters may hide its way up."""
        return [float((self.shared - x).detach().square().mean()) for x in self.target.values()]


def step_toy(method: Method, toy: Quadratics, scale: float = 1.0) -> Weighting:
    """One step of gradient descent, of a length that no method can make explode."""
    parameters = [*toy.parameters(), *method.parameters()]
    for parameter in parameters:
        parameter.grad = None
    parts = [[toy.forward]] * method.batches
    weighting = backward(method, parts, toy, scale=scale, lr=LR)
    with torch.no_grad():
        for parameter in parameters:
            if parameter.grad is not None:
                grad = parameter.grad / scale
                parameter.sub_(LR * grad / grad.norm().clamp_min(1.0))
    if method.reevaluates:
        method.after_step(weighting.loss_K, stack_losses(method, losses_now(parts[0], toy)))
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
    toy = Quadratics(TERMS)
    before = toy.distances()
    _steps(kind(TERMS, seed=3), toy, 60)
    after = toy.distances()
    if not any(new < old for new, old in zip(after, before, strict=True)):
        raise ValueError(f"60 steps lead down in none of {len(TERMS)} bowls: {before} to {after}")


def _same_seed_same_update(kind: type[Method]) -> None:
    first, second = (_trace(kind(TERMS, seed=3), Quadratics(TERMS), 3) for _ in range(2))
    if first != second:
        raise ValueError("two runs with one seed differ: draw from self.generator only")


def _state_round_trip(kind: type[Method]) -> None:
    straight = _trace(kind(TERMS, seed=3), Quadratics(TERMS), 6)
    toy, first = Quadratics(TERMS), kind(TERMS, seed=3)
    _steps(first, toy, 3)
    second = kind(TERMS, seed=99)
    second.load_state_dict(first.state_dict())
    if _trace(second, toy, 3) != straight[3:]:
        raise ValueError("3 steps, save, load, 3 steps is not 6 steps: some state is not saved")


def _one_term(kind: type[Method]) -> None:
    """With a single loss, the shared update is that loss's gradient up to a positive factor."""
    terms = TERMS[:1]
    toy = Quadratics(terms)
    (loss,) = toy.forward().losses.values()
    (plain,) = torch.autograd.grad(loss, toy.shared)
    method = kind(terms, seed=0)
    backward(method, [[toy.forward]] * method.batches, toy, lr=LR)
    assert toy.shared.grad is not None
    cosine = torch.cosine_similarity(plain, toy.shared.grad, dim=0)
    if cosine < 1 - 1e-5:
        raise ValueError(
            f"one loss, but the update is not along its gradient (cosine {cosine:.4f})"
        )


def _permutation(kind: type[Method]) -> None:
    """The order of the losses changes nothing; a method that draws at random is exempt."""
    method = kind(TERMS, seed=3)
    untouched = method.generator.get_state()
    point = _steps(method, Quadratics(TERMS), 3)
    if not torch.equal(method.generator.get_state(), untouched):
        return
    turned = (*TERMS[2:], *TERMS[:2])
    other = _steps(kind(turned, seed=3), Quadratics(turned), 3)
    if not torch.allclose(point, other, rtol=1e-4, atol=1e-5):
        raise ValueError(f"in another order the losses lead elsewhere: {point} and {other}")


def _missing_labels(kind: type[Method]) -> None:
    """A batch may lack a task's losses; the others are trained, and all again afterwards."""
    method, toy = kind(TERMS, seed=3), Quadratics(TERMS)
    full, partial = TERMS, TERMS[:3]
    for terms in (full, partial, full, full, partial):
        toy.terms = terms
        weighting = step_toy(method, toy)
        if list(weighting.weights) != [term.name for term in terms]:
            raise ValueError(f"weights for {list(weighting.weights)}, not for {len(terms)} losses")
        if not torch.isfinite(toy.shared).all():
            raise ValueError(f"with {len(terms)} of {len(TERMS)} losses the update is not finite")


def _loss_scale(kind: type[Method]) -> None:
    """The scale of fp16 training is for the optimiser; a method decides as without it."""
    plain = _steps(kind(TERMS, seed=3), Quadratics(TERMS), 3)
    scaled = _steps(kind(TERMS, seed=3), Quadratics(TERMS), 3, scale=1024.0)
    if not torch.allclose(plain, scaled, rtol=1e-4, atol=1e-6):
        raise ValueError(f"a loss scale of 1024 leads elsewhere: {plain} and {scaled}")


# --- on hard inputs -------------------------------------------------------------------------------


def _finite(kind: type[Method]) -> None:
    """Finite answers for hard inputs; inputs stay as they were."""
    for size in (0.0, 1e-10, 1.0, 1e10):
        loss_T = torch.full((len(TERMS),), size)
        method = kind(TERMS, seed=0)
        if isinstance(method, LossMethod):
            _finite_weights(method, loss_T)
        elif isinstance(method, GradientMethod):
            for title, J_TP in _hard_jacobians(size or 1.0).items():
                _finite_direction(kind(TERMS, seed=0), J_TP, loss_T, f"{title} at {size}")


def _finite_weights(method: LossMethod, loss_T: Tensor) -> None:
    leaf_T = loss_T.clone().requires_grad_()
    total = method.total(leaf_T)
    (weight_T,) = torch.autograd.grad(total, leaf_T)
    if not (torch.isfinite(total) and torch.isfinite(weight_T).all()):
        weights = weight_T.tolist()
        raise ValueError(f"losses {loss_T.tolist()} give total {total}, weights {weights}")
    if not torch.equal(leaf_T.detach(), loss_T):
        raise ValueError("total() changed its input in place")


def _finite_direction(method: Method, J_TP: Tensor, loss_T: Tensor, title: str) -> None:
    assert isinstance(method, GradientMethod)
    given, losses = J_TP.clone(), loss_T
    if isinstance(method, LookAheadMethod):
        answer = method.direction_ahead(given, losses, lambda direction_P: J_TP, LR)
    else:
        if method.batches > 1:
            given = given.expand(method.batches, *given.shape)
            losses = losses.expand(method.batches, *losses.shape)
        answer = method.direction(given, losses)
    if not all(torch.isfinite(part).all() for part in answer):
        raise ValueError(f"gradients '{title}' give a direction or weights that are not finite")
    if not torch.equal(given if given.dim() == 2 else given[0], J_TP):
        raise ValueError("direction() changed its input in place")


def _hard_jacobians(size: float) -> dict[str, Tensor]:
    draw = torch.Generator().manual_seed(2)
    J_TP = torch.randn(len(TERMS), 12, generator=draw)
    opposite, zero_row, twice, ill = (J_TP.clone() for _ in range(4))
    opposite[1] = -opposite[0]
    zero_row[2] = 0
    twice[3] = twice[1]
    ill *= torch.logspace(-3, 3, len(TERMS))[:, None]
    cases = {"random": J_TP, "zero": 0 * J_TP, "equal": J_TP[:1].repeat(len(TERMS), 1)}
    cases |= {"opposite": opposite, "one zero": zero_row, "one twice": twice, "ill-scaled": ill}
    return {title: size * case for title, case in cases.items()}


METHOD_CHECKS: dict[str, Callable[[type[Method]], None]] = {
    "learns": _learns,
    "finite on hard inputs": _finite,
    "one loss is plain training": _one_term,
    "same seed, same update": _same_seed_same_update,
    "state round trip": _state_round_trip,
    "order of losses": _permutation,
    "missing labels": _missing_labels,
    "invisible loss scale": _loss_scale,
}
