"""The tests that every plug-in gets by being in its folder: `mtl-bench check NAME`."""

import ast
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench import plugins
from mtl_bench.backward import backward
from mtl_bench.config import TASKS
from mtl_bench.losses.terms import Term, terms_of
from mtl_bench.method import GradientMethod, LossMethod, Method

TERMS = terms_of(TASKS)


@dataclass(frozen=True)
class CheckResult:
    name: str
    ok: bool
    detail: str = ""


def check(kind: str, name: str) -> list[CheckResult]:
    """Run every check of a plug-in; a failed one says what was wrong, none stops the others.

    Args:
        kind: "methods" or "backbones".
        name: the file's stem.
    """
    path = plugins.path_of(kind, name)
    results = [_run("documented", lambda: _documented(path))]
    load = _run("loads", lambda: plugins.load(kind, name))
    results.append(load)
    if load.ok:
        plugin = plugins.load(kind, name)
        checks: dict[str, Callable[..., None]] = (
            METHOD_CHECKS if kind == "methods" else BACKBONE_CHECKS
        )
        results += [_run(title, partial(run, plugin)) for title, run in checks.items()]
    return results


def _run(name: str, call: Callable[[], Any]) -> CheckResult:
    """Every exception of the plug-in is a failed check with its place, which is the point here."""
    try:
        call()
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        return CheckResult(name, False, f"{type(error).__name__}: {error} ({where})")
    return CheckResult(name, True)


def _documented(path: Path) -> None:
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    if len(text.splitlines()) < 2:
        raise ValueError("the file's docstring needs a line saying what it does, then its source")


# --- methods --------------------------------------------------------------------------------------


class Quadratics(nn.Module):
    """A toy with shared and own parameters: each term pulls the shared point to its own target."""

    def __init__(self, terms: tuple[Term, ...], size: int = 6):
        super().__init__()
        draw = torch.Generator().manual_seed(1)
        self.terms = terms
        self.shared = nn.Parameter(torch.randn(size, generator=draw))
        self.own = nn.Parameter(torch.ones(len(terms)))
        self.target_TS = torch.randn(len(terms), size, generator=draw)

    def shared_parameters(self) -> Iterator[nn.Parameter]:
        yield self.shared

    def task_parameters(self) -> Iterator[nn.Parameter]:
        yield self.own

    def losses(self) -> dict[str, Tensor]:
        pull_T = (self.shared - self.target_TS).square().mean(1) + self.own.square() + 0.1
        return {term.name: pull for term, pull in zip(self.terms, pull_T, strict=True)}


def _train_toy(kind: type[Method], steps: int, terms: tuple[Term, ...] = TERMS) -> Tensor:
    toy, method = Quadratics(terms), kind(terms, seed=3)
    return _steps(toy, method, steps)


def _steps(toy: Quadratics, method: Method, steps: int) -> Tensor:
    """Plain gradient descent, for tests of determinism: returns where the shared point ended."""
    parameters = [*toy.parameters(), *method.parameters()]
    for _ in range(steps):
        for parameter in parameters:
            parameter.grad = None
        backward(method, toy.losses(), toy)
        with torch.no_grad():
            for parameter in parameters:
                if parameter.grad is not None:
                    norm = parameter.grad.norm().clamp_min(1.0)
                    parameter.sub_(0.02 * parameter.grad / norm)
    return toy.shared.detach().clone()


def _learns(kind: type[Method]) -> None:
    toy = Quadratics(TERMS)
    method = kind(TERMS, seed=3)
    before = sum(loss.item() for loss in toy.losses().values())
    _steps(toy, method, 60)
    after = sum(loss.item() for loss in toy.losses().values())
    if not after < before:
        raise ValueError(f"60 steps on {len(TERMS)} bowls raise their sum: {before} to {after}")


def _same_seed_same_update(kind: type[Method]) -> None:
    if not torch.equal(_train_toy(kind, 3), _train_toy(kind, 3)):
        raise ValueError("two runs with one seed differ: draw from self.generator only")


def _state_round_trip(kind: type[Method]) -> None:
    straight = _train_toy(kind, 6)
    toy, first = Quadratics(TERMS), kind(TERMS, seed=3)
    _steps(toy, first, 3)
    second = kind(TERMS, seed=99)
    second.load_state_dict(first.state_dict())
    if not torch.equal(_steps(toy, second, 3), straight):
        raise ValueError("3 steps, save, load, 3 steps is not 6 steps: some state is not saved")


def _one_term(kind: type[Method]) -> None:
    """With a single term, the shared update is that term's gradient up to a positive factor."""
    terms = TERMS[:1]
    toy = Quadratics(terms)
    (loss,) = toy.losses().values()
    (plain,) = torch.autograd.grad(loss, toy.shared)
    backward(kind(terms, seed=0), toy.losses(), toy)
    assert toy.shared.grad is not None
    cosine = torch.cosine_similarity(plain, toy.shared.grad, dim=0)
    if cosine < 1 - 1e-5:
        raise ValueError(
            f"one term, but the update is not along its gradient (cosine {cosine:.4f})"
        )


def _finite(kind: type[Method]) -> None:
    """Finite answers for hard inputs; inputs stay as they were."""
    for size in (1e-10, 1.0, 1e10):
        loss_T = torch.full((len(TERMS),), size)
        method = kind(TERMS, seed=0)
        if isinstance(method, LossMethod):
            _finite_weights(method, loss_T)
        elif isinstance(method, GradientMethod):
            for title, J_TP in _hard_jacobians(size).items():
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
    given = J_TP.clone()
    direction_P, weight_T = method.direction(given, loss_T)
    if not (torch.isfinite(direction_P).all() and torch.isfinite(weight_T).all()):
        raise ValueError(f"gradients '{title}' give a direction or weights that are not finite")
    if not torch.equal(given, J_TP):
        raise ValueError("direction() changed its input in place")


def _hard_jacobians(size: float) -> dict[str, Tensor]:
    draw = torch.Generator().manual_seed(2)
    J_TP = torch.randn(len(TERMS), 12, generator=draw)
    opposite, zero_row = J_TP.clone(), J_TP.clone()
    opposite[1] = -opposite[0]
    zero_row[2] = 0
    cases = {"random": J_TP, "zero": 0 * J_TP, "equal": J_TP[:1].repeat(len(TERMS), 1)}
    cases |= {"opposite": opposite, "one zero": zero_row}
    return {title: size * case for title, case in cases.items()}


METHOD_CHECKS: dict[str, Callable[[type[Method]], None]] = {
    "learns": _learns,
    "finite on hard inputs": _finite,
    "one term is plain training": _one_term,
    "same seed, same update": _same_seed_same_update,
    "state round trip": _state_round_trip,
}


# --- backbones ------------------------------------------------------------------------------------


def _pyramid(kind: Callable[..., Any]) -> None:
    for strides in ((8, 16, 32), (4, 8, 16), (2, 4, 8)):
        backbone = kind(strides=strides).eval()
        for height, width in ((64, 64), (96, 160)):
            features = backbone(torch.rand(2, 3, height, width))
            for stride in strides:
                expected = (2, backbone.channels[stride], height // stride, width // stride)
                found = tuple(features[stride].shape)
                if found != expected:
                    raise ValueError(f"stride {stride}: {found} is not {expected}")


def _every_parameter_trains(kind: Callable[..., Any]) -> None:
    backbone = kind(strides=(8, 16, 32)).train()
    sum(f.square().mean() for f in backbone(torch.rand(2, 3, 64, 64)).values()).backward()
    idle = [name for name, p in backbone.named_parameters() if p.grad is None]
    if idle:
        raise ValueError(f"parameters without a gradient: {', '.join(idle[:5])}")


def _backbone_round_trip(kind: Callable[..., Any]) -> None:
    first, second, image = kind().eval(), kind().eval(), torch.rand(1, 3, 64, 64)
    second.load_state_dict(first.state_dict())
    for stride, features in first(image).items():
        if not torch.equal(features, second(image)[stride]):
            raise ValueError(f"stride {stride} differs after the state was copied")


BACKBONE_CHECKS: dict[str, Callable[[Callable[..., Any]], None]] = {
    "pyramid as declared": _pyramid,
    "every parameter trains": _every_parameter_trains,
    "state round trip": _backbone_round_trip,
}
