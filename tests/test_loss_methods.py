"""Loss-value methods: parity with torchjd, identities, missing losses, resuming, hard inputs."""

import ast
import inspect
import io
import re
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mtl_bench.core import plugins
from mtl_bench.core.config import TASKS
from mtl_bench.core.terms import Term, terms_of

NAMES = (
    *("fixed", "uncertainty", "fixed_uncertainty", "uncertainty_revised", "uncertainty_soft"),
    *("scale_invariant", "gls", "rlw", "dwa", "imtl_l", "stch", "famo"),
)
POSITIVE = ("scale_invariant", "gls", "stch", "famo")  # of a logarithm: losses below 1e-8 are it
SHORT = {"dwa": {"window": 2}, "stch": {"warmup": 3}}  # so that a few steps cross the boundaries
WINDOW, WARMUP = 4, 5
F32, F64 = torch.float32, torch.float64


# --- conventions ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Convention:
    """How torchjd's numbers become ours."""

    build: Callable[[Any, tuple[Term, ...]], Any]  # their module, our terms -> their scalarizer
    why: str
    factor: Callable[[int], float] = lambda K: 1.0  # times their scalar, of K losses
    feed: Callable[[Tensor, "Theirs"], Tensor] = lambda loss_K, theirs: loss_K
    settings: Mapping[str, Any] = field(default_factory=dict)  # of our method
    dtype: torch.dtype = F64


CONVENTIONS = {  # our name, their class
    ("fixed", "Sum"): Convention(
        lambda jd, terms: jd.Sum(), "equal weights of 1", settings={"prior": "equal"}
    ),
    ("fixed", "Mean"): Convention(
        lambda jd, terms: jd.Mean(),
        "equal weights of 1, theirs of 1/K",
        factor=lambda K: K,
        settings={"prior": "equal"},
    ),
    ("fixed", "Constant"): Convention(
        lambda jd, terms: jd.Constant(torch.tensor([t.fixed_weight for t in terms]).to(F64)),
        "the terms' fixed weights, given to theirs",
    ),
    ("uncertainty", "UW"): Convention(
        lambda jd, terms: jd.UW(len(terms)).to(F64),
        "theirs knows no classification: all terms are regressions",
    ),
    ("fixed_uncertainty", "UW"): Convention(
        lambda jd, terms: jd.UW(len(terms)).to(F64),
        "as above; theirs gets the losses times their fixed weights",
        feed=lambda loss_K, theirs: loss_K * theirs.fixed_K,
    ),
    ("imtl_l", "IMTLL"): Convention(lambda jd, terms: jd.IMTLL(len(terms)).to(F64), "the same"),
    ("gls", "GeometricMean"): Convention(lambda jd, terms: jd.GeometricMean(), "the same"),
    ("rlw", "Random"): Convention(
        lambda jd, terms: (torch.manual_seed(0), jd.Random())[1],
        "theirs draws from the global generator, in the losses' type; ours in single precision",
        dtype=F32,
    ),
    ("dwa", "DWA"): Convention(
        lambda jd, terms: jd.DWA(2.0),
        "their step() at the end of each of our windows",
        settings={"window": WINDOW},
    ),
    ("famo", "FAMO"): Convention(
        lambda jd, terms: jd.FAMO(len(terms), lr=0.025, weight_decay=1e-3).to(F64),
        "theirs adds 1e-8 to a loss, ours takes the larger; their update() is our after_step",
        feed=lambda loss_K, theirs: loss_K - 1e-8,
    ),
    ("stch", "STCH"): Convention(
        lambda jd, terms: jd.STCH(1.0, weights=torch.ones(len(terms), dtype=F64)),
        "theirs is the core on given values, preferences 1/K unless given: it gets log(L / n)",
        factor=lambda K: K,
        feed=lambda loss_K, theirs: (loss_K / torch.stack(theirs.past[:WARMUP]).mean(0)).log(),
        settings={"warmup": WARMUP},
    ),
}
NO_COUNTERPART = {"scale_invariant", "uncertainty_revised", "uncertainty_soft"}
PAIRS = pytest.mark.parametrize("pair", CONVENTIONS, ids="-".join)

LOSSES = {
    "equal": [0.7] * 3,
    "mild": [2.3, 0.5, 1.1],
    "duplicated": [0.4, 0.4, 3.0],
    "ill-scaled": [1e-3, 1.0, 1e3],
    "eleven": [10 ** (k / 5 - 1) for k in range(11)],
}


def regressions(size: int) -> tuple[Term, ...]:
    return tuple(Term(f"loss{k}", "depth", "regression", 0.5 + k) for k in range(size))


def make(name: str, terms: tuple[Term, ...] = terms_of(TASKS), **settings: Any) -> Any:
    return plugins.load("methods", name)(terms, **settings)


def weights(method: Any, loss_K: Tensor) -> Tensor:
    leaf_K = loss_K.clone().requires_grad_()
    (weight_K,) = torch.autograd.grad(method.total(leaf_K), leaf_K)
    return weight_K


class Theirs:
    """torchjd's scalarizer under a convention, with our two hooks."""

    def __init__(self, pair: tuple[str, str], terms: tuple[Term, ...]):
        module = pytest.importorskip("torchjd.scalarization")
        self.name, self.convention = pair[1], CONVENTIONS[pair]
        self.scalarizer = self.convention.build(module, terms)
        self.fixed_K = torch.tensor([term.fixed_weight for term in terms])
        self.past: list[Tensor] = []

    def total(self, loss_K: Tensor) -> Tensor:
        self.past.append(loss_K.detach())
        if self.name == "STCH" and len(self.past) <= WARMUP:
            return loss_K.log().sum()
        value = self.scalarizer(self.convention.feed(loss_K, self))
        if self.name == "DWA" and len(self.past) % WINDOW == 0:
            self.scalarizer.step()
        return self.convention.factor(len(loss_K)) * value

    def after_step(self, after_K: Tensor) -> None:
        if self.name == "FAMO":
            self.scalarizer.update(self.convention.feed(after_K, self))


# --- parity ---------------------------------------------------------------------------------------


def test_every_method_has_an_oracle_or_a_reason():
    assert {name for name, _ in CONVENTIONS} | NO_COUNTERPART == set(NAMES)


@PAIRS
@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES)
def test_weights_are_torchjds(pair, losses):
    convention, terms = CONVENTIONS[pair], regressions(len(losses))
    ours = make(pair[0], terms, **convention.settings).to(convention.dtype)
    theirs = Theirs(pair, terms)
    loss_K = torch.tensor(losses, dtype=convention.dtype)
    slope_K = torch.linspace(0.5, 1.5, len(losses), dtype=convention.dtype)
    for step in range(3 * WINDOW):  # past the warm-up and the first two windows
        now_K = loss_K * (1 + 0.1 * step * slope_K)
        found_K, expected_K = weights(ours, now_K), weights(theirs, now_K)
        torch.testing.assert_close(found_K, expected_K, rtol=1e-6, atol=0)
        if ours.reevaluates:
            after_K = now_K * (1 - 0.3 * slope_K / 2)
            ours.after_step(now_K, after_K)
            theirs.after_step(after_K)


def train(method: Any, after_step: Callable[[Tensor, Tensor], None], own: Any, dtype) -> Tensor:
    """20 steps of a small network with three losses; returns its parameters, and the method's."""
    torch.manual_seed(1)
    net = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 3)).to(dtype)
    input_B4, target_B3 = torch.randn(16, 4).to(dtype), torch.randn(16, 3).to(dtype)
    scale_K = torch.tensor([0.1, 1.0, 5.0], dtype=dtype)

    def losses() -> Tensor:
        return scale_K * ((net(input_B4) - target_B3).square().mean(0) + 0.01)

    torch.manual_seed(0)  # for their random weights
    optimizer = torch.optim.SGD([*net.parameters(), *own], lr=0.05)
    for _ in range(20):
        before_K = losses()
        optimizer.zero_grad()
        method.total(before_K).backward()
        optimizer.step()
        after_step(before_K.detach(), losses().detach())
    return torch.cat([p.detach().flatten() for p in (*net.parameters(), *own)])


@PAIRS
def test_trajectory_of_a_network_is_torchjds(pair):
    convention, terms = CONVENTIONS[pair], regressions(3)
    ours = make(pair[0], terms, **convention.settings).to(convention.dtype)
    theirs = Theirs(pair, terms)

    def hook(before_K: Tensor, after_K: Tensor) -> None:
        if ours.reevaluates:
            ours.after_step(before_K, after_K)

    own = [p for p in theirs.scalarizer.parameters() if pair[1] != "FAMO"]
    expected = train(theirs, lambda _, after_K: theirs.after_step(after_K), own, convention.dtype)
    found = train(ours, hook, list(ours.parameters()), convention.dtype)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


# --- formulas -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", NAMES)
def test_answers_in_the_losses_type(name, dtype):
    method, loss_K = make(name).to(dtype), torch.tensor([0.3, 2.0, 0.5, 7.0, 1.0], dtype=dtype)
    weight_K = weights(method, loss_K)
    assert weight_K.dtype == method.total(loss_K).dtype == dtype
    assert (weight_K > 0).all()
    if name != "rlw":
        in_double_K = weights(make(name).to(F64), loss_K.to(F64))
        torch.testing.assert_close(weight_K.to(F64), in_double_K, rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", ["uncertainty", "fixed_uncertainty"])
def test_a_full_batch_gives_what_it_gave_before_losses_could_be_missing(name):
    torch.manual_seed(0)
    method, loss_T = make(name), torch.rand(5)
    with torch.no_grad():
        method.log_variance_T.copy_(torch.randn(5))
    tau_T = torch.tensor([1.0, 0.5, 0.5, 0.5, 0.5])
    scale_T = tau_T * method.fixed_T if name == "fixed_uncertainty" else tau_T
    s_T = method.log_variance_T.detach().clone().requires_grad_()
    expected = (scale_T * torch.exp(-s_T) * loss_T + 0.5 * s_T).sum()
    found = method.total(loss_T)
    assert torch.equal(found, expected)
    found.backward(), expected.backward()
    assert torch.equal(method.log_variance_T.grad, s_T.grad)


def test_revised_uncertainty():
    method, loss_T = make("uncertainty_revised").to(F64), torch.full((5,), 2.0, dtype=F64)
    s_T = torch.tensor([-3.0, -1.0, 0.0, 1.0, 40.0], dtype=F64)
    with torch.no_grad():
        method.log_variance_T.copy_(s_T)
    tau_T = torch.tensor([1.0, 0.5, 0.5, 0.5, 0.5], dtype=F64)
    expected = (tau_T * torch.exp(-s_T) * loss_T + torch.log1p(torch.exp(s_T))).sum()
    torch.testing.assert_close(method.total(loss_T), expected)
    torch.testing.assert_close(weights(method, loss_T), tau_T * torch.exp(-s_T))
    assert make("uncertainty_revised").total(torch.full((5,), 1e-6)) > 0


def test_soft_uncertainty():
    loss_T = torch.tensor([0.1, 1.0, 2.0, 4.0, 8.0], dtype=F64)
    exponent_T = torch.exp(1 / loss_T / 3)
    found_T = weights(make("uncertainty_soft", temperature=3.0), loss_T)
    torch.testing.assert_close(found_T, exponent_T / exponent_T.sum())


def test_fixed_weights_by_name():
    loss_T = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])
    assert weights(make("fixed"), loss_T).tolist() == make("fixed").fixed_T.tolist()
    assert weights(make("fixed", prior="equal"), loss_T).tolist() == [1.0] * 5
    changed = {"center": 100, "panoptic": 3.0}  # a task's, which this cell does not weigh
    found_T = weights(make("fixed", weights=changed), loss_T)
    torch.testing.assert_close(found_T, torch.tensor([1.0, 100.0, 0.01, 1.0, 0.001]))
    tasks = terms_of(TASKS, "tasks")
    assert weights(make("fixed", tasks, weights={"depth": 0.5}), loss_T[:2]).tolist() == [1, 0.5]


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("fixed", {"weights": {"centre": 1.0}}, r"no loss called 'centre'.*mean 'center'"),
        ("fixed", {"prior": "equals"}, r"no prior called 'equals'.*mean 'equal'"),
        ("dwa", {"window": 0}, "window 0 .* must be positive"),
        ("dwa", {"temperature": 0.0}, "temperature 0.0 must be positive"),
        ("stch", {"mu": 0.0}, "mu 0.0 .* must be positive"),
        ("stch", {"warmup": 0}, "warmup 0 must be positive"),
        ("uncertainty_soft", {"temperature": -1.0}, "temperature -1.0 must be positive"),
    ],
)
def test_impossible_settings_are_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        make(name, **settings)


def test_dwa_by_hand():
    method = make("dwa", regressions(2), window=2, temperature=2.0).to(F64)
    windows = [[4.0, 1.0], [2.0, 1.5], [3.0, 3.0]]  # losses; each twice, apart by 0.2
    seen = []
    for window in windows:
        for offset in (-0.1, 0.1):
            seen.append(weights(method, torch.tensor(window, dtype=F64) + offset))
    assert [w.tolist() for w in seen[:4]] == [[1.0, 1.0]] * 4
    expected_K = 2 * torch.softmax(torch.tensor([2 / 4, 1.5 / 1], dtype=F64) / 2, 0)
    torch.testing.assert_close(torch.stack(seen[4:]), expected_K.expand(2, 2))


def test_stch_warms_up_on_logarithms_and_then_looks_at_the_worst():
    method = make("stch", regressions(3), warmup=2, mu=1e-3).to(F64)
    for loss_K in ([1.0, 2.0, 3.0], [3.0, 2.0, 5.0]):
        found_K = weights(method, torch.tensor(loss_K, dtype=F64))
        torch.testing.assert_close(found_K, 1 / torch.tensor(loss_K, dtype=F64))
    relative = weights(method, torch.tensor([2.0, 3.0, 4.4], dtype=F64))  # 1, 1.5 and 1.1 times n
    torch.testing.assert_close(relative, torch.tensor([0.0, 3 / 3.0, 0.0], dtype=F64))


def test_stch_has_a_warm_up_for_a_loss_that_first_comes_later():
    method, loss_K = make("stch", regressions(3), warmup=2).to(F64), torch.ones(3, dtype=F64)
    method.present = torch.tensor([0, 1])
    for _ in range(3):
        method.total(loss_K[:2])
    method.present = torch.arange(3)
    late_K = torch.tensor([1.0, 1.0, 4.0], dtype=F64)
    for _ in range(2):
        torch.testing.assert_close(weights(method, late_K), torch.tensor([1, 1, 0.25], dtype=F64))
    torch.testing.assert_close(weights(method, late_K), torch.tensor([1, 1, 0.25], dtype=F64))
    assert weights(method, late_K * torch.tensor([1.0, 1.0, 3.0]))[2] > 0.1  # 1/12 in a warm-up


def test_famo_turns_to_what_fell_least():
    method, loss_K = make("famo", regressions(2)), torch.tensor([1.0, 1.0])
    assert method.reevaluates
    for _ in range(10):
        method.after_step(loss_K, torch.tensor([0.5, 0.9]))
    share_K = weights(method, loss_K)
    assert share_K[1] > share_K[0] + 0.1
    assert share_K.sum().item() == pytest.approx(1, abs=1e-6)


# --- Adam -----------------------------------------------------------------------------------------


def adam(*args: Any, **kwargs: Any) -> Any:
    return inspect.getmodule(plugins.load("methods", "famo")).Adam(*args, **kwargs)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_adam_is_torchs(dtype, decay):
    torch.manual_seed(0)
    settings = {"lr": 0.025, "betas": (0.8, 0.99), "eps": 1e-6, "weight_decay": decay}
    value = torch.randn(5, dtype=dtype)
    expected = nn.Parameter(value.clone())
    mine, torchs = adam(value, **settings), torch.optim.Adam([expected], **settings)
    for _ in range(50):
        expected.grad = torch.randn(5, dtype=dtype) * 10 ** torch.randn(5, dtype=dtype)
        value = mine.step(value, expected.grad)
        torchs.step()
        torch.testing.assert_close(value, expected.detach(), rtol=0, atol=1e-6)


def test_adam_leaves_out_what_does_not_move():
    torch.manual_seed(0)
    some, rest, grads = torch.tensor([0, 2]), torch.tensor([1]), torch.randn(6, 3)
    whole, often, seldom = (
        adam(torch.zeros(3), 0.1),
        adam(torch.zeros(2), 0.1),
        adam(torch.zeros(1), 0.1),
    )
    value, often_value, seldom_value = torch.ones(3), torch.ones(2), torch.ones(1)
    for step, grad in enumerate(grads):
        often_value = often.step(often_value, grad[some])
        if step % 2 == 0:
            value[some] = whole.step(value[some], grad[some], some)
        else:
            value = whole.step(value, grad)
            seldom_value = seldom.step(seldom_value, grad[rest])
    assert torch.equal(value[some], often_value)
    assert torch.equal(value[rest], seldom_value)


# --- identities (facts/methods.md, A.4) -----------------------------------------------------------


def direction(weight_K: Tensor) -> Tensor:
    return weight_K / weight_K.sum()


def test_at_its_start_famo_points_where_gls_and_the_logarithm_do():
    loss_T = torch.tensor([0.02, 3.0, 0.5, 40.0, 1.0], dtype=F64)
    expected_T = direction(1 / loss_T)
    for name in ("famo", "gls", "scale_invariant"):
        torch.testing.assert_close(direction(weights(make(name).to(F64), loss_T)), expected_T)


def test_learned_scales_at_their_optimum_are_the_logarithm():
    loss_K = torch.tensor([0.02, 3.0, 0.5], dtype=F64)
    logarithm_K = weights(make("scale_invariant"), loss_K)
    cases = {"imtl_l": (-loss_K.log(), 1.0), "uncertainty": (loss_K.log(), 0.5)}
    for name, (optimum_K, factor) in cases.items():
        method = make(name, regressions(3)).to(F64)
        (parameter,) = method.parameters()
        parameter.data = optimum_K
        torch.testing.assert_close(weights(method, loss_K), factor * logarithm_K)
        method.total(loss_K).backward()
        torch.testing.assert_close(parameter.grad, torch.zeros(3, dtype=F64))


def test_limits_of_the_temperatures():
    loss_K = torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    terms = regressions(3)
    third_K, one_K = torch.full((3,), 1 / 3, dtype=F64), torch.eye(3, dtype=F64)
    soft = {T: weights(make("uncertainty_soft", terms, temperature=T), loss_K) for T in (1e9, 1e-3)}
    torch.testing.assert_close(soft[1e9], third_K)
    torch.testing.assert_close(soft[1e-3], one_K[0])
    for mu, expected_K in {1e9: 1 / loss_K, 1e-3: 3 * one_K[2] / loss_K}.items():
        method = make("stch", terms, mu=mu, warmup=1).to(F64)
        method.total(torch.ones(3, dtype=F64))
        torch.testing.assert_close(weights(method, loss_K), expected_K)


@pytest.mark.parametrize("name", ["scale_invariant", "gls", "famo", "stch"])
def test_units_of_the_losses_do_not_matter(name):
    torch.manual_seed(0)
    unit_T = torch.tensor([1e-3, 1.0, 50.0, 7.0, 0.2], dtype=F64)
    first, second = (make(name, **SHORT.get(name, {})).to(F64) for _ in range(2))
    for loss_T, fall_T in torch.rand(6, 2, 5, dtype=F64) + 0.1:
        mine_T, scaled_T = weights(first, loss_T), weights(second, unit_T * loss_T) * unit_T
        torch.testing.assert_close(direction(scaled_T), direction(mine_T))
        if first.reevaluates:
            first.after_step(loss_T, loss_T * fall_T)
            second.after_step(unit_T * loss_T, unit_T * loss_T * fall_T)


def test_random_weights_are_equal_on_average():
    method, loss_T = make("rlw", seed=5), torch.ones(5)
    draws = torch.stack([weights(method, loss_T) for _ in range(2000)])
    torch.testing.assert_close(draws.sum(1), torch.ones(2000))
    torch.testing.assert_close(draws.mean(0), torch.full((5,), 0.2), rtol=0, atol=0.015)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rlw"])
def test_the_order_of_the_losses_does_not_matter(name):
    torch.manual_seed(0)
    terms, order = terms_of(TASKS), [3, 0, 4, 2, 1]
    first = make(name, terms, **SHORT.get(name, {})).to(F64)
    second = make(name, tuple(terms[i] for i in order), **SHORT.get(name, {})).to(F64)
    for loss_T in torch.rand(8, 5, dtype=F64) + 0.1:
        torch.testing.assert_close(step(first, loss_T)[order], step(second, loss_T[order]))


# --- state ----------------------------------------------------------------------------------------


def step(method: Any, loss_K: Tensor) -> Tensor:
    """One step with everything that belongs to it, the method's own parameters by plain descent."""
    leaf_K = loss_K.clone().requires_grad_()
    method.zero_grad()
    method.total(leaf_K).backward()
    with torch.no_grad():
        for parameter in method.parameters():
            parameter -= 0.1 * parameter.grad
    if method.reevaluates:
        method.after_step(loss_K, loss_K * (0.5 + loss_K))
    assert leaf_K.grad is not None
    return leaf_K.grad


@pytest.mark.parametrize("steps", [1, 3, 4])
@pytest.mark.parametrize("name", NAMES)
def test_resumed_is_uninterrupted(name, steps):
    torch.manual_seed(0)
    losses = torch.rand(10, 5) + 0.1
    settings = SHORT.get(name, {})
    straight, first, second = (make(name, seed=s, **settings) for s in (1, 1, 2))
    expected = [step(straight, loss_T) for loss_T in losses]
    found = [step(first, loss_T) for loss_T in losses[:steps]]
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    found += [step(second, loss_T) for loss_T in losses[steps:]]
    assert torch.equal(torch.stack(found), torch.stack(expected))


def per_term(method: Any) -> dict[str, Tensor]:
    """What a method remembers: all of it is one value a term."""
    state = {name: value for name, value in method.state_dict().items() if torch.is_tensor(value)}
    assert all(value.shape == (len(method.terms),) for value in state.values())
    return state


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rlw"])
def test_a_missing_loss_keeps_its_state_and_the_others_go_on_with_theirs(name):
    torch.manual_seed(0)
    terms, present = terms_of(TASKS), torch.tensor([0, 2, 4])
    losses = torch.rand(12, 5) + 0.1
    whole = make(name, terms, **SHORT.get(name, {}))
    for loss_T in losses[:5]:
        step(whole, loss_T)
    part = make(name, tuple(terms[i] for i in present), **SHORT.get(name, {}))
    state = {key: value[present].clone() for key, value in per_term(whole).items()}
    part.load_state_dict({**part.state_dict(), **state})
    absent = {key: value[[1, 3]].clone() for key, value in per_term(whole).items()}

    whole.present = present
    for loss_T in losses[5:]:
        torch.testing.assert_close(step(whole, loss_T[present]), step(part, loss_T[present]))
    after = per_term(whole)
    for key, value in per_term(part).items():
        torch.testing.assert_close(after[key][present], value)
        assert torch.equal(after[key][[1, 3]], absent[key])

    whole.present = torch.arange(5)
    assert torch.isfinite(step(whole, losses[0])).all()


def test_random_weights_do_not_hang_on_what_is_missing():
    whole, part = make("rlw", seed=1), make("rlw", seed=1)
    part.present = torch.tensor([0, 3])
    for _ in range(3):
        all_T, two_K = weights(whole, torch.ones(5)), weights(part, torch.ones(2))
        torch.testing.assert_close(two_K[0] / two_K[1], all_T[0] / all_T[3])


@pytest.mark.parametrize("name", NAMES)
def test_a_network_alone_is_trained_along_its_loss(name):
    method = make(name, terms_of(TASKS)[:1], **SHORT.get(name, {}))
    for loss in (2.0, 1.0, 0.5, 0.8, 0.2, 0.1):
        assert step(method, torch.tensor([loss])).item() > 0


# --- hard inputs ----------------------------------------------------------------------------------

HARD = {
    "zero": [0.0] * 5,
    "one zero": [1.0, 0.0, 1.0, 1.0, 1.0],
    "tiny": [1e-10] * 5,
    "huge": [1e10] * 5,
    "both": [0.0, 1e-10, 1e-3, 1.0, 1e10],
}


@pytest.mark.parametrize("losses", HARD.values(), ids=HARD)
@pytest.mark.parametrize("name", NAMES)
def test_finite_on_hard_losses(name, losses):
    method, ones_T = make(name, **SHORT.get(name, {})), torch.ones(5)
    for loss_T in (*[torch.tensor(losses)] * 5, *[ones_T] * 5, torch.tensor(losses)):
        assert torch.isfinite(method.total(loss_T))
        assert torch.isfinite(weights(method, loss_T)).all()
        if method.reevaluates:
            method.after_step(loss_T, ones_T)
    assert all(torch.isfinite(value).all() for value in per_term(method).values())


@pytest.mark.parametrize("name", POSITIVE)
def test_a_loss_below_the_clamp_counts_as_the_clamp(name):
    below, at = torch.tensor([0.0, 1, 1, 1, 1]), torch.tensor([1e-8, 1, 1, 1, 1])
    first, second = (make(name, **SHORT.get(name, {})) for _ in range(2))
    for _ in range(5):
        torch.testing.assert_close(first.total(below), second.total(at))
    assert weights(first, below)[0] == 0


# --- the files ------------------------------------------------------------------------------------


def test_files_are_short_and_name_their_source():
    lines = {}
    for name in NAMES:
        path = plugins.path_of("methods", name)
        text = path.read_text(encoding="ascii")
        lines[name] = len(text.splitlines())
        _, source, *rest = (ast.get_docstring(ast.parse(text)) or "").split("\n\n")
        assert source.startswith("Source: ")
        assert not rest
        assert re.search(r"\b([A-Z][A-Za-z]+) ((?:19|20)\d\d)\b", source), name
    assert statistics.median(lines.values()) <= 45
    assert max(lines.values()) <= 100
