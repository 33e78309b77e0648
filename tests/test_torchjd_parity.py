"""Every gradient method that torchjd has gives its direction; one table maps the conventions.

Where torchjd does not solve its own definition the case is excluded in the table with the reason;
`test_gramian_methods.py` tests the residual of the defining equation on those cases too, and
`test_an_exclusion_is_needed` fails when an exclusion has become unnecessary.

K tasks, N batches, P parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch

from mtl_bench.core import plugins
from mtl_bench.core.terms import Term

theirs = pytest.importorskip("torchjd.aggregation")
cvxpy = pytest.importorskip("cvxpy")

pytestmark = pytest.mark.filterwarnings("ignore")  # cvxpy's, about Nash-MTL's problem

SIZES = (2, 3, 5, 11)
CASES = ("aligned", "conflicting", "duplicated", "zero-row", "ill-scaled")
CLOSED, SOLVER = 1e-6, 1e-4  # largest |ours - theirs| / |theirs|


@dataclass(frozen=True)
class Row:
    """One method: ours with its settings is `factor` times theirs."""

    name: str
    oracle: Callable[[int], Any]  # of K
    tolerance: float
    why: str  # how the conventions differ
    settings: dict[str, Any] = field(default_factory=dict)
    factor: Callable[[int], float] = lambda K: 1.0
    steps: int = 1  # more where there is state
    scale: float = 1.0  # of the gradients
    excluded: dict[str, str] = field(default_factory=dict)  # case, or case with K -> reason


EXACT = "the same rule"
DRAW = "the same draws: both take them in one order from a generator with one seed"

TABLE = (
    Row(
        "mgda",
        lambda K: theirs.MGDA(epsilon=1e-12, max_iters=8000),
        SOLVER,
        "the same; their Frank-Wolfe steps stop at a step of 1e-3 by default",
        excluded={"ill-scaled 5": "Frank-Wolfe has not converged", "ill-scaled 11": "the same"},
    ),
    Row("pcgrad", lambda K: theirs.PCGrad(), CLOSED, DRAW),
    Row(
        "gradvac",
        lambda K: theirs.GradVac(beta=0.5, eps=0.0),
        CLOSED,
        f"{DRAW}; their eps is added to products of norms and is no part of the rule",
        settings={"beta": 0.5},
        steps=4,
    ),
    Row(
        "cagrad",
        lambda K: theirs.CAGrad(c=0.4, norm_eps=1e-10),
        SOLVER,
        "ours is divided by 1 + c^2; their solver run to 1e-14 in place of 1e-8, and their norm_eps"
        " (1e-4, below which the answer is 0) lowered",
        settings={"c": 0.4},
        factor=lambda K: 1 / (1 + 0.4**2),
        excluded={"zero-row": "g_w = 0 solves their dual and leaves the primal open: 0 or noise"},
    ),
    Row(
        "imtl_g",
        lambda K: theirs.IMTLG(),
        CLOSED,
        "the weights sum to 1; by default ours are divided by the sum of absolute values",
        settings={"paper_sum": True},
        excluded={"ill-scaled 11": "the pseudo-inverse of a Gramian of condition 1e13 is off"},
    ),
    Row(
        "nash",
        lambda K: theirs.NashMTL(K),
        SOLVER,
        "the same, after clipping to norm 1",
        excluded={
            "zero-row": "its weight is infinite: their solver fails and the others go wrong",
            "ill-scaled": "their linearised solver ends elsewhere",
        },
    ),
    Row(
        "fairgrad",
        lambda K: theirs.FairGrad(2.0),
        SOLVER,
        EXACT,
        settings={"alpha": 2.0},
        excluded={"ill-scaled": "their root finder has not converged"},
    ),
    Row(
        "aligned",
        lambda K: theirs.AlignedMTL(scale_mode="min"),
        CLOSED,
        "theirs are averaged, ours summed",
        factor=float,
    ),
    Row("upgrad", lambda K: theirs.UPGrad(), SOLVER, EXACT),
    Row("dualproj", lambda K: theirs.DualProj(), SOLVER, EXACT),
    Row("config", lambda K: theirs.ConFIG(), CLOSED, EXACT),
    Row("graddrop", lambda K: theirs.GradDrop(), CLOSED, DRAW),
    Row(
        "excess",
        lambda K: theirs.ExcessMTL(robust_step_size=0.1, n_warmup_steps=2),
        CLOSED,
        "their step size is our eta, their default of no warm-up takes the first estimate raw",
        settings={"eta": 0.1, "warm_up": 2},
        steps=5,
    ),
    Row(
        "modo",
        lambda K: theirs.MoDoWeighting(gamma=0.01, rho=0.1),
        CLOSED,
        "their weights of J_1 J_2^T, applied to J_3",
        settings={"gamma": 0.01, "rho": 0.1},
        steps=4,
    ),
    Row(
        "sdmgrad",
        lambda K: theirs.SDMGradWeighting(lr=10.0, momentum=0.5, n_iter=20, lambda_=0.3),
        CLOSED,
        "their weights of J_1 J_2^T, applied to J_3; they add 1e-8 to the squared scale, which"
        " large gradients hide",
        settings={"lr": 10.0, "momentum": 0.5, "iterations": 20, "lam": 0.3},
        steps=4,
        scale=1e4,
    ),
)

EVERY = [(row, case, K) for row in TABLE for case in CASES for K in SIZES]


def reason(row: Row, case: str, K: int) -> str | None:
    return row.excluded.get(case) or row.excluded.get(f"{case} {K}")


def gradients(case: str, K: int) -> torch.Tensor:
    """J [K,P]; "conflicting" has negative cosines in every row."""
    draw = torch.Generator().manual_seed(K)
    J_KP = torch.randn(K, 3 * K + 4, generator=draw, dtype=torch.float64)
    if case == "aligned":
        J_KP = J_KP.abs()
        J_KP[:, :K] += 10 * torch.eye(K, dtype=torch.float64)
        return torch.nn.functional.normalize(J_KP, dim=1)
    J_KP = J_KP - 0.9 * J_KP.mean(0)
    if case == "duplicated":
        J_KP[1] = J_KP[0]
    elif case == "zero-row":
        J_KP[1] = 0
    elif case == "ill-scaled":
        J_KP *= torch.logspace(-3, 3, K, dtype=torch.float64)[:, None]
    return J_KP


def sequence(row: Row, case: str, K: int) -> list[torch.Tensor]:
    """J [N,K,P] of every step: noise on one J, as batches of one data set have it."""
    draw, J_KP = torch.Generator().manual_seed(99), row.scale * gradients(case, K)
    if row.steps == 1:
        return [J_KP[None]]
    shape = (row.steps, 3, *J_KP.shape)
    noise = torch.randn(shape, generator=draw, dtype=torch.float64)
    if case == "duplicated":
        noise[:, :, 1] = noise[:, :, 0]
    return list(J_KP + 0.5 * J_KP.norm(dim=1)[:, None] / J_KP.shape[1] ** 0.5 * noise)


def both(row: Row, case: str, K: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Our direction and theirs, with our factor, at every step."""
    terms = [Term(f"t{i}", "depth", "regression", 1.0) for i in range(K)]
    ours, oracle = plugins.load("methods", row.name)(terms, seed=7, **row.settings), row.oracle(K)
    loss_K, found = torch.ones(K, dtype=torch.float64), []
    torch.manual_seed(7)  # theirs draws from the global generator
    for J_NKP in sequence(row, case, K):
        if ours.batches == 1:
            direction_P, _ = ours.direction(J_NKP[0], loss_K)
            expected_P = oracle(J_NKP[0])
        else:
            direction_P, _ = ours.direction(J_NKP, loss_K.expand(3, K))
            expected_P = oracle(J_NKP[0] @ J_NKP[1].T) @ J_NKP[2]
        found.append((direction_P, row.factor(K) * expected_P))
    return found


def distance(found: list[tuple[torch.Tensor, torch.Tensor]]) -> float:
    far = [
        float((ours_P - theirs_P).norm() / theirs_P.norm().clamp_min(1e-9))  # 0 is rounding
        for ours_P, theirs_P in found
    ]
    return max(far) if all(value == value for value in far) else float("inf")


@pytest.fixture(autouse=True)
def _accurate_conic_solver(monkeypatch):
    """Clarabel stops at 1e-8 of the objective, where the argument is only known to 1e-4."""
    solve, tight = cvxpy.Problem.solve, {"tol_gap_abs": 1e-14, "tol_gap_rel": 1e-14}

    def accurate(problem, solver=None, **options):
        extra = tight | {"tol_feas": 1e-12} if solver == cvxpy.CLARABEL else {}
        return solve(problem, solver=solver, **options, **extra)

    monkeypatch.setattr(cvxpy.Problem, "solve", accurate)


def label(value) -> str:
    return value.name if isinstance(value, Row) else str(value)


@pytest.mark.parametrize(
    ("row", "case", "K"), [each for each in EVERY if not reason(*each)], ids=label
)
def test_direction_is_torchjds(row, case, K):
    assert distance(both(row, case, K)) < row.tolerance


@pytest.mark.parametrize(
    ("row", "case"),
    [(row, case) for row in TABLE for case in row.excluded],
    ids=lambda value: label(value),
)
def test_an_exclusion_is_needed(row, case):
    name, _, size = case.partition(" ")
    sizes = [int(size)] if size else SIZES
    found = [distance(both(row, name, K)) for K in sizes]
    assert max(found) > row.tolerance


def test_the_cases_are_what_they_are_called():
    for K in SIZES:
        cosines = {case: torch.nn.functional.normalize(gradients(case, K), dim=1) for case in CASES}
        cosines = {case: unit @ unit.T for case, unit in cosines.items()}
        assert cosines["aligned"].min() > 0
        assert (cosines["conflicting"].min(1).values < 0).all()
        assert cosines["duplicated"][0, 1] > 1 - 1e-12
        assert gradients("zero-row", K)[1].norm() == 0
        norm_K = gradients("ill-scaled", K).norm(dim=1)
        assert norm_K.max() / norm_K.min() > 1e5


def test_every_method_that_torchjd_has_is_in_the_table():
    """But for trivial ones, wrappers, robust means, and PCD, which wants a primary task."""
    elsewhere = {"CRMOGM", "Constant", "Krum", "Mean", "PCD", "Random", "Sum", "TrimmedMean"}
    found = {type(row.oracle(3)).__name__.removesuffix("Weighting") for row in TABLE}
    names = {
        name.removesuffix("Weighting")
        for name, kind in vars(theirs).items()
        if isinstance(kind, type) and issubclass(kind, (theirs.Aggregator, theirs.Weighting))
    }
    abstract = {name for name in names if "Aggregator" in name or not name}
    assert names - found - elsewhere - abstract == set()
