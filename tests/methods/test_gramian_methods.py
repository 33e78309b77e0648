"""The methods that need only the Gramian: each answer satisfies its paper's defining equation.

Shapes: K tasks of T, P parameters. The gradients are those of test_torchjd_parity.py and harder
ones, so that an equation is also tested where no other implementation solves it.
"""

import importlib
import math

import pytest
import torch
from scipy.optimize import minimize
from support.methods import head_weights, one_update, step_of
from support.terms import TERMS

from mtl_bench.bench.check.methods import Quadratics
from mtl_bench.core import plugins
from mtl_bench.core.terms import Term
from mtl_bench.train.backward import backward

NAMES = (
    *("mgda", "mgda_ub", "pcgrad", "gradvac", "cagrad", "imtl_g", "nash"),
    *("aligned", "upgrad", "dualproj", "config", "fairgrad"),
)
RANDOM = ("pcgrad", "gradvac")
SIZES = (1, 2, 3, 5, 11)
KIND = {"dtype": torch.float64}


def make(name, tasks, seed=0, **settings):
    terms = [Term(f"task{i}", "depth", "regression", 1.0) for i in range(tasks)]
    return plugins.load("methods", name)(terms, seed=seed, **settings)


def weigh(name, J_KP, loss_K=None, **settings):
    """The weights of a method's equation: before what clips a direction to a length."""
    if name == "nash":
        settings.setdefault("max_norm", math.inf)
    loss_K = torch.ones(len(J_KP), **KIND) if loss_K is None else loss_K
    return make(name, len(J_KP), **settings).weights(J_KP @ J_KP.T, step_of(loss_K))


def solvers():
    """The helper of the methods, as they see it."""
    package = plugins.load("methods", "mgda").__module__.rpartition(".")[0]
    return importlib.import_module(f"{package}._solvers")


def unit(J_KP):
    return torch.nn.functional.normalize(J_KP, dim=1)


def draw(K, seed=0, size=None):
    generator = torch.Generator().manual_seed(100 * K + seed)
    return torch.randn(K, size or 3 * K + 4, generator=generator, **KIND)


def conflicting(K, seed=0):
    J_KP = draw(K, seed)
    return J_KP - 0.9 * J_KP.mean(0) if K > 1 else J_KP


def aligned(K, seed=0):
    return draw(K, seed).abs()


def duplicated(K, seed=0):
    J_KP = conflicting(K, seed)
    J_KP[-1] = 2 * J_KP[0]
    return J_KP


def ill_scaled(K, seed=0):
    return conflicting(K, seed) * torch.logspace(-3, 3, K, **KIND)[:, None]


def zero_row(K, seed=0):
    J_KP = conflicting(K, seed)
    J_KP[K // 2] = 0
    return J_KP


def opposite(K, seed=0):
    J_KP = conflicting(K, seed)
    J_KP[-1] = -0.5 * J_KP[0]
    return J_KP


REGULAR = (aligned, conflicting, duplicated, ill_scaled)  # some direction helps all tasks
every_size = pytest.mark.parametrize("K", SIZES)
several_sizes = pytest.mark.parametrize("K", SIZES[1:])
regular = pytest.mark.parametrize("gradients", REGULAR, ids=lambda case: case.__name__)
with_zero = pytest.mark.parametrize(
    "gradients", [*REGULAR, zero_row], ids=lambda case: case.__name__
)


# --- defining equations ---------------------------------------------------------------------------


@every_size
@pytest.mark.parametrize("gradients", [*REGULAR, zero_row, opposite], ids=lambda c: c.__name__)
def test_mgda_is_the_shortest_convex_combination(gradients, K):
    J_KP = gradients(K)
    w_K = weigh("mgda", J_KP)
    assert (w_K >= 0).all()
    assert math.isclose(float(w_K.sum()), 1.0, rel_tol=1e-12)
    short_P = w_K @ J_KP  # optimal: no vertex has a smaller product with it than itself
    norm_K = J_KP.norm(dim=1)
    floor = norm_K[norm_K > 0].min() if norm_K.any() else 1.0
    slack_K = (J_KP @ short_P - short_P @ short_P) / (norm_K.clamp_min(1e-9) * floor)
    assert (slack_K >= -1e-12).all()
    assert (short_P.norm() <= norm_K * (1 + 1e-9) + 1e-12 * norm_K.max()).all()  # identity 8


def test_mgda_of_two_is_the_closed_form():
    for seed in range(20):
        first_P, second_P = draw(2, seed, size=3)
        gap_P = second_P - first_P
        share = float(((second_P @ gap_P) / (gap_P @ gap_P)).clamp(0, 1))
        w_K = weigh("mgda", torch.stack([first_P, second_P]))
        assert w_K.tolist() == pytest.approx([share, 1 - share], abs=1e-9)


def test_mgda_normalizes_as_the_authors_do():
    J_KP, loss_K = draw(4), torch.tensor([0.5, 2.0, 3.0, 0.1], **KIND)
    norm_K = J_KP.norm(dim=1)
    for name, scale_K in (("l2", norm_K), ("loss", loss_K), ("loss+", norm_K * loss_K)):
        expected_K = weigh("mgda", J_KP / scale_K[:, None]) / scale_K
        found_K = weigh("mgda", J_KP, loss_K, normalize=name)
        torch.testing.assert_close(found_K, expected_K, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="normalize 'l1' is not one of"):
        make("mgda", 2, normalize="l1")


def test_mgda_ub_is_mgda_on_the_representation():
    assert make("mgda_ub", 2).needs == "representation"
    assert make("mgda", 2).needs == "gramian"
    J_KP = draw(3)
    assert torch.equal(weigh("mgda", J_KP), weigh("mgda_ub", J_KP))


@several_sizes
@with_zero
@pytest.mark.parametrize("c", [0.1, 0.4, 0.9])
def test_cagrad_is_optimal(gradients, K, c):
    """In the ball, and as good as the dual, which no point in the ball can beat, allows."""
    J_KP = gradients(K)
    mean_P = J_KP.mean(0)
    w_K = (1 + c**2) * weigh("cagrad", J_KP, c=c)
    d_P = w_K @ J_KP
    assert (d_P - mean_P).norm() <= c * mean_P.norm() * (1 + 1e-9)
    present_K = J_KP.norm(dim=1) > 0
    J_KP = J_KP[present_K]
    primal = (J_KP @ d_P).min()
    share_K = (w_K - 1 / K)[present_K]  # of the move in the gradients
    share_K = share_K / share_K.sum()
    dual = share_K @ J_KP @ mean_P + c * mean_P.norm() * (share_K @ J_KP).norm()
    assert float(dual - primal) <= 1e-7 * float(mean_P.norm() * J_KP.norm(dim=1).min())


def test_cagrad_where_gradients_cancel_goes_no_further_than_it_must():
    """No direction helps all: the best minimum is 0, reached inside of the ball."""
    J_KP = torch.tensor([[1.0, 0.0], [-0.9, 0.0], [0.0, 1.0]], **KIND)
    d_P = 1.16 * weigh("cagrad", J_KP, c=0.4) @ J_KP
    assert d_P.tolist() == pytest.approx([0.0, 1 / 3], abs=1e-8)  # 2e-9 on some processors


def test_cagrad_without_radius_is_the_mean():  # identity 10
    torch.testing.assert_close(weigh("cagrad", draw(5), c=0.0), torch.full((5,), 0.2, **KIND))


@every_size
@regular
def test_imtl_g_projects_equally(gradients, K):  # identity 9
    J_KP = gradients(K)
    w_K = weigh("imtl_g", J_KP)
    projection_K = unit(J_KP) @ (w_K @ J_KP)
    assert (projection_K > 0).all()
    torch.testing.assert_close(
        projection_K, projection_K.mean().expand(K), rtol=1e-6, atol=0, check_stride=False
    )
    assert math.isclose(float(w_K.abs().sum()), 1.0, rel_tol=1e-12)
    paper_K = weigh("imtl_g", J_KP, paper_sum=True)
    assert math.isclose(float(paper_K.sum()), 1.0, rel_tol=1e-9)


def test_imtl_g_descends_where_the_papers_sum_is_negative():
    J_KP = torch.tensor([[1.0, 0.8], [1.0, -0.8], [0.01, 0.0]], **KIND)
    J_KP = torch.cat([J_KP, 0.05 * torch.eye(3, **KIND) * J_KP.norm(dim=1)[:, None]], 1)
    assert (J_KP @ (weigh("imtl_g", J_KP, paper_sum=True) @ J_KP) < 0).all()
    assert (J_KP @ (weigh("imtl_g", J_KP) @ J_KP) > 0).all()


@every_size
@regular
def test_config_has_one_cosine_and_the_projected_length(gradients, K):
    J_KP = gradients(K)
    d_P = weigh("config", J_KP) @ J_KP
    cosine_K = unit(J_KP) @ d_P / d_P.norm()
    torch.testing.assert_close(cosine_K, cosine_K[:1].expand(K), rtol=1e-6, atol=0)
    length = float((J_KP @ d_P).sum() / d_P.norm())
    assert float(d_P.norm()) == pytest.approx(length, rel=1e-9)


@every_size
@regular
@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 5.0])
def test_fairgrad_solves_its_equation(gradients, K, alpha):
    J_KP = gradients(K)
    w_K = weigh("fairgrad", J_KP, alpha=alpha)
    assert (w_K > 0).all()
    residual_K = (J_KP @ (w_K @ J_KP)) * w_K ** (1 / alpha) - 1
    assert residual_K.abs().max() < 1e-5  # a repeated task of another scale is known to 1e-6


@every_size
@regular
def test_nash_solves_its_equation(gradients, K):
    J_KP = gradients(K)
    w_K = weigh("nash", J_KP)
    assert ((J_KP @ (w_K @ J_KP)) * w_K - 1).abs().max() < 1e-6
    assert float((w_K @ J_KP).square().sum()) == pytest.approx(K, rel=1e-6)  # identity 2
    torch.testing.assert_close(w_K, weigh("fairgrad", J_KP, alpha=1.0))  # identity 1


def test_nash_of_two_is_the_closed_form():  # identity 2
    for seed in range(20):
        J_KP = draw(2, seed) * torch.tensor([[1e-2], [1e2]], **KIND)
        cosine = float(torch.cosine_similarity(*J_KP, dim=0))
        expected_K = 1 / (J_KP.norm(dim=1) * math.sqrt(1 + cosine))
        torch.testing.assert_close(weigh("nash", J_KP), expected_K, rtol=1e-8, atol=0)


@several_sizes
@pytest.mark.parametrize("name", ["nash", "fairgrad"])
def test_a_zero_gradient_does_not_change_the_bargain(name, K):
    J_KP = zero_row(K)
    present_K = J_KP.norm(dim=1) > 0
    w_K = weigh(name, J_KP)
    own = w_K[~present_K].tolist()
    assert own == pytest.approx([1.0])  # its decoders are trained by the loss as it is
    torch.testing.assert_close(w_K[present_K], weigh(name, J_KP[present_K]))


@every_size
@with_zero
def test_aligned_is_the_papers_rule_on_the_gradients(gradients, K):
    """By the gradients' own singular value decomposition, as the paper has it."""
    J_KP = gradients(K)
    U_KR, sigma_R, V_RP = torch.linalg.svd(J_KP, full_matrices=False)
    rank = int(torch.linalg.matrix_rank(unit(J_KP)))
    if rank == 0:
        assert not weigh("aligned", J_KP).any()
        return
    expected_P = sigma_R[rank - 1] * U_KR[:, :rank].sum(0) @ V_RP[:rank]
    torch.testing.assert_close(weigh("aligned", J_KP) @ J_KP, expected_P, rtol=1e-6, atol=1e-9)


def test_aligned_of_orthonormal_gradients_is_the_sum():  # identity 11
    Q_PK, _ = torch.linalg.qr(draw(5).T)
    torch.testing.assert_close(weigh("aligned", Q_PK.T), torch.ones(5, **KIND))


def test_aligned_takes_rounding_of_float32_for_zero():
    """A repeated task, with the noise that float32 leaves in the Gramian."""
    J_KP = conflicting(4)
    J_KP[3] = J_KP[0]
    G_KK = J_KP @ J_KP.T
    noisy_KK = (J_KP.float() * (1 + 1e-7 * draw(4, 1).float())).double()
    step = step_of(torch.ones(4, **KIND))
    found_P = make("aligned", 4).weights(noisy_KK @ noisy_KK.T, step) @ J_KP
    torch.testing.assert_close(
        found_P, make("aligned", 4).weights(G_KK, step) @ J_KP, rtol=1e-4, atol=1e-4
    )


@every_size
@pytest.mark.parametrize("gradients", [*REGULAR, zero_row, opposite], ids=lambda c: c.__name__)
def test_upgrad_and_dualproj_are_projections(gradients, K):
    """Optimal for v^T G v over v >= w: slope >= 0, and 0 where v > w."""
    solve, J_KP = solvers(), gradients(K)
    G_KK = solve.regularized(J_KP @ J_KP.T, 1e-4)
    own_KK = torch.eye(K, **KIND) / K
    v_NK = solve.project_on_dual_cone(G_KK, torch.cat([own_KK, own_KK.sum(0)[None]]))
    more_NK, slope_NK = v_NK - torch.cat([own_KK, own_KK.sum(0)[None]]), v_NK @ G_KK
    assert (more_NK >= 0).all()
    assert (slope_NK >= -1e-9).all()
    assert (more_NK * slope_NK).abs().max() < 1e-9
    torch.testing.assert_close(weigh("upgrad", J_KP), v_NK[:K].sum(0))
    torch.testing.assert_close(weigh("dualproj", J_KP), v_NK[K])


@several_sizes
@pytest.mark.parametrize("name", ["upgrad", "dualproj"])
def test_no_gradient_opposes(name, K):  # identity 7
    for seed in range(5):
        J_KP = conflicting(K, seed)
        w_K = weigh(name, J_KP)
        allowed = 2e-4 * w_K.max() * J_KP.square().sum()
        assert (J_KP @ (w_K @ J_KP) >= -allowed).all()
        exact_P = weigh(name, J_KP, regularization=0.0) @ J_KP
        assert (J_KP @ exact_P >= -1e-9 * J_KP.square().sum()).all()


@pytest.mark.parametrize("name", ["upgrad", "dualproj"])
def test_dual_cone_projection_by_another_solver(name):
    J_KP = conflicting(4, 3)
    mean_P, K = J_KP.mean(0), len(J_KP)
    targets = [mean_P] if name == "dualproj" else list(J_KP / K)
    expected_P = torch.zeros_like(mean_P)
    for target_P in targets:
        target = target_P.numpy()
        found = minimize(
            lambda d, target=target: ((d - target) ** 2).sum(),
            target,
            jac=lambda d, target=target: 2 * (d - target),
            constraints={"type": "ineq", "fun": lambda d: J_KP.numpy() @ d},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        expected_P += torch.from_numpy(found.x)
    found_P = weigh(name, J_KP, regularization=0.0) @ J_KP
    torch.testing.assert_close(found_P, expected_P, rtol=1e-5, atol=1e-6)


# --- the two random ones, literally on the gradients ----------------------------------------------


def literal_pcgrad(J_KP, seed):
    generator = torch.Generator().manual_seed(seed)
    total_P = torch.zeros_like(J_KP[0])
    for i in range(len(J_KP)):
        turned_P = J_KP[i].clone()
        for j in torch.randperm(len(J_KP), generator=generator).tolist():
            if j != i and turned_P @ J_KP[j] < 0:
                turned_P -= (turned_P @ J_KP[j]) / (J_KP[j] @ J_KP[j]) * J_KP[j]
        total_P += turned_P
    return total_P


@every_size
@pytest.mark.parametrize("size", [3, None])  # where there is no room, turned gradients oppose own
def test_pcgrad_is_algorithm_1_on_the_gradients(K, size):
    for seed in range(20):
        J_KP = conflicting(K, seed) if size is None else draw(K, seed, size)
        found_P = weigh("pcgrad", J_KP, seed=seed) @ J_KP
        torch.testing.assert_close(found_P, literal_pcgrad(J_KP, seed), rtol=1e-9, atol=1e-9)


def literal_gradvac(J_KP, phi_KK, beta, generator):
    total_P = torch.zeros_like(J_KP[0])
    for i in range(len(J_KP)):
        turned_P, others = J_KP[i].clone(), [j for j in range(len(J_KP)) if j != i]
        for index in torch.randperm(len(others), generator=generator).tolist():
            j = others[index]
            phi = turned_P @ J_KP[j] / (turned_P.norm() * J_KP[j].norm())
            usual = phi_KK[i, j].clone()
            if phi < usual:
                above = usual * (1 - phi**2).sqrt() - phi * (1 - usual**2).sqrt()
                factor = turned_P.norm() * above / (J_KP[j].norm() * (1 - usual**2).sqrt())
                turned_P = turned_P + factor * J_KP[j]
                reached = turned_P @ J_KP[j] / (turned_P.norm() * J_KP[j].norm())
                assert reached == pytest.approx(float(usual), abs=1e-9)  # what the formula is for
            phi_KK[i, j] = (1 - beta) * usual + beta * phi
        total_P += turned_P
    return total_P


@several_sizes
def test_gradvac_is_algorithm_1_on_the_gradients(K):
    method, generator = make("gradvac", K, seed=3, beta=0.3), torch.Generator().manual_seed(3)
    phi_KK, loss_K = torch.zeros(K, K, **KIND), torch.ones(K, **KIND)
    for seed in range(6):
        J_KP = draw(K, seed) + 0.5 * draw(K)[:1]
        found_P = method.weights(J_KP @ J_KP.T, step_of(loss_K)) @ J_KP
        expected_P = literal_gradvac(J_KP, phi_KK, 0.3, generator)
        torch.testing.assert_close(found_P, expected_P, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(method.phi_TT, phi_KK)


# --- identities -----------------------------------------------------------------------------------


@every_size
def test_without_conflict_nothing_is_changed(K):  # identity 6
    J_KP = aligned(K)
    for name in ("pcgrad", "gradvac"):
        torch.testing.assert_close(weigh(name, J_KP), torch.ones(K, **KIND))
    for name in ("upgrad", "dualproj"):
        torch.testing.assert_close(weigh(name, J_KP), torch.full((K,), 1 / K, **KIND))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in RANDOM])
@several_sizes
def test_the_order_of_tasks_does_not_matter(name, K):  # identity 12
    J_KP = conflicting(K)
    order = torch.randperm(K, generator=torch.Generator().manual_seed(K))
    found_K, turned_K = weigh(name, J_KP), weigh(name, J_KP[order])
    torch.testing.assert_close(turned_K, found_K[order], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", RANDOM)
def test_the_order_of_two_tasks_does_not_matter_to_the_random_ones(name):  # nothing to draw
    J_KP = conflicting(2)
    torch.testing.assert_close(weigh(name, J_KP).flip(0), weigh(name, J_KP.flip(0)))


@pytest.mark.parametrize("name", NAMES)
@several_sizes
def test_rescaled_losses(name, K):  # identity 13
    """Bargains and equal angles do not see the units of a loss; the others do."""
    J_KP, scale_K = conflicting(K), torch.logspace(-1, 1, K, **KIND)
    before_P = weigh(name, J_KP) @ J_KP
    after_P = weigh(name, scale_K[:, None] * J_KP) @ (scale_K[:, None] * J_KP)
    same_direction = torch.cosine_similarity(before_P, after_P, dim=0) > 1 - 1e-9
    assert bool(same_direction) == (name in ("nash", "fairgrad", "imtl_g", "config"))
    if name in ("nash", "fairgrad"):
        torch.testing.assert_close(before_P, after_P, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_one_scale_for_all_losses_keeps_the_direction(name):
    for factor in (1e-10, 1e10):
        J_KP = conflicting(4)
        before_P, after_P = weigh(name, J_KP) @ J_KP, weigh(name, factor * J_KP) @ (factor * J_KP)
        torch.testing.assert_close(
            before_P / before_P.norm(), after_P / after_P.norm(), rtol=1e-7, atol=1e-9
        )


@pytest.mark.parametrize("name", ["nash", "fairgrad"])
@several_sizes
def test_a_task_twice_has_a_bargain(name, K):  # identity 15
    J_KP = conflicting(K)
    J_KP = torch.cat([J_KP, J_KP[:1]])
    w_K = weigh(name, J_KP)
    assert ((J_KP @ (w_K @ J_KP)) * w_K - 1).abs().max() < 1e-6
    assert float(w_K[0]) == pytest.approx(float(w_K[-1]), rel=1e-6)


@pytest.mark.parametrize("name", ["imtl_g", "config"])
def test_opposite_gradients_have_no_equal_projection(name):
    for K in (2, 3, 4):
        J_KP = draw(1) * torch.tensor([3.0, -0.7, -1.1, 0.2], **KIND)[:K, None]
        signs = {2: True, 3: False, 4: True}  # whether as many point forwards as backwards
        direction_P = weigh(name, J_KP) @ J_KP
        assert bool(direction_P.norm() < 1e-9) == signs[K]


# --- hard inputs ----------------------------------------------------------------------------------


def hard_gradients(K):
    J_KP = conflicting(K)
    yield "zero", 0 * J_KP
    yield "equal", J_KP[:1].repeat(K, 1)
    yield "all opposite", J_KP[:1] * torch.tensor([(-1.0) ** i for i in range(K)], **KIND)[:, None]
    yield "a zero row", zero_row(K)
    yield "opposite", opposite(K) if K > 1 else J_KP
    yield "in a plane", J_KP[:, :2]
    yield "on a line", J_KP[:, :1]
    yield "nearly equal", J_KP[:1] + 1e-7 * J_KP
    yield "nearly opposite", torch.cat([J_KP, -J_KP[:1] + 1e-7 * J_KP[-1:]])
    yield "far apart", J_KP * torch.logspace(-8, 8, K, **KIND)[:, None]
    yield "more tasks than parameters", draw(K, 5, size=1)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("K", [1, 2, 5])
@pytest.mark.parametrize("precision", [torch.float32, torch.float64])
def test_hard_gradients_give_finite_answers(name, K, precision):
    for size in (1e-10, 1.0, 1e10):
        for title, J_KP in hard_gradients(K):
            given_KP = (size * J_KP).to(precision)
            loss_K = torch.ones(len(J_KP), dtype=precision)
            direction_P, weight_K = one_update(make(name, len(J_KP)), given_KP, loss_K)
            assert torch.isfinite(direction_P).all(), title
            assert torch.isfinite(weight_K).all(), title
            if title == "zero":
                assert not direction_P.any()


@pytest.mark.parametrize("name", NAMES)
def test_one_task_is_its_gradient(name):
    J_KP = draw(1)
    direction_P, _ = one_update(make(name, 1), J_KP, torch.ones(1, **KIND))
    assert torch.cosine_similarity(direction_P, J_KP[0], dim=0) > 1 - 1e-12


@pytest.mark.parametrize("name", NAMES)
def test_a_gramian_that_is_not_finite_is_an_error_that_shows_it(name):
    G_KK = torch.tensor([[1.0, float("inf")], [float("inf"), 2.0]], **KIND)
    with pytest.raises(ArithmeticError, match=r"not finite.*\[\[1\.0, inf\], \[inf, 2\.0\]\]"):
        make(name, 2).weights(G_KK, step_of(torch.ones(2, **KIND)))


@pytest.mark.parametrize("name", ["mgda", "upgrad", "dualproj", "cagrad"])
def test_a_failed_solve_is_an_error(name, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(solvers(), "nnls", fail)
    with pytest.raises(ArithmeticError, match=r"Maximum number.*the matrix was \[\["):
        weigh(name, conflicting(3))


def test_a_bargain_that_is_not_found_is_an_error(monkeypatch):
    monkeypatch.setattr(solvers(), "_damped", lambda *args: torch.zeros(3, **KIND))
    with pytest.raises(ArithmeticError, match=r"no w with .* found; the matrix was \[\["):
        weigh("nash", conflicting(3))


@pytest.mark.parametrize(
    ("name", "settings"),
    [("fairgrad", {"alpha": 0.0}), ("nash", {"every": 0}), ("nash", {"max_norm": 0.0})],
)
def test_a_setting_out_of_range_is_an_error(name, settings):
    with pytest.raises(ValueError, match=f"{next(iter(settings))} "):
        make(name, 2, **settings)


def test_projection_on_the_simplex():
    project = solvers().project_on_simplex
    for K in SIZES:
        for seed in range(10):
            v_K = 3 * draw(K, seed)[:, 0]
            found_K = project(v_K)
            assert (found_K >= 0).all()
            assert math.isclose(float(found_K.sum()), 1.0, rel_tol=1e-12)
            towards_K = v_K - found_K  # optimal: largest, and equal, where the answer is positive
            assert (towards_K[found_K > 0] - towards_K.max()).abs().max() < 1e-12


# --- state ----------------------------------------------------------------------------------------


def test_nash_reuses_weights_and_clips_only_the_direction():
    method = make("nash", 3, every=3)
    steps = [draw(3, seed) for seed in range(4)]
    solved = [weigh("nash", J_KP) for J_KP in steps]
    for step, J_KP in enumerate(steps):
        direction_P, weight_K = one_update(method, J_KP, torch.ones(3, **KIND))
        bargained_K = solved[3 if step == 3 else 0]
        torch.testing.assert_close(head_weights(method, weight_K, torch.ones(3)), bargained_K)
        whole_P = bargained_K @ J_KP
        assert whole_P.norm() > 1
        torch.testing.assert_close(direction_P, whole_P / whole_P.norm())
        torch.testing.assert_close(weight_K @ J_KP, direction_P)  # logged as they act
    free = make("nash", 3, max_norm=math.inf)
    free_P, weight_K = one_update(free, steps[0], torch.ones(3, **KIND))
    torch.testing.assert_close(free_P, weight_K @ steps[0])
    torch.testing.assert_close(weight_K, solved[0])


def test_an_absent_task_keeps_its_state():
    J_KP, loss_K = conflicting(4), torch.ones(4, **KIND)
    present = torch.tensor([0, 2, 3])
    part_KP = J_KP[present]
    nash, vaccine = make("nash", 4), make("gradvac", 4, beta=0.5)
    for method in (nash, vaccine):
        method.weights(J_KP @ J_KP.T, step_of(loss_K))
    weight_T, phi_TT = nash.weight_T.clone(), vaccine.phi_TT.clone()
    for method in (nash, vaccine):
        step = step_of(loss_K[present], present)
        assert len(method.weights(part_KP @ part_KP.T, step)) == 3
    assert nash.weight_T[1] == weight_T[1]
    torch.testing.assert_close(nash.weight_T[present], weigh("nash", part_KP))
    assert torch.equal(vaccine.phi_TT[1], phi_TT[1])
    assert torch.equal(vaccine.phi_TT[:, 1], phi_TT[:, 1])
    assert not torch.equal(vaccine.phi_TT[2, 3], phi_TT[2, 3])


@pytest.mark.parametrize("name", ["pcgrad", "gradvac", "nash"])
def test_state_goes_into_a_fresh_method(name):
    settings = {"nash": {"every": 2}}.get(name, {})
    first, second = make(name, 5, seed=1, **settings), make(name, 5, seed=2, **settings)
    loss_K, steps = torch.ones(5, **KIND), [conflicting(5, seed) for seed in range(6)]
    for J_KP in steps[:3]:
        one_update(first, J_KP, loss_K)
    second.load_state_dict(first.state_dict())
    for J_KP in steps[3:]:
        for mine, other in zip(
            one_update(first, J_KP, loss_K), one_update(second, J_KP, loss_K), strict=True
        ):
            assert torch.equal(mine, other)


def test_imtl_is_its_two_halves():
    """By the engine, with scales that have moved: as imtl_l and imtl_g one after the other."""
    toy, method = Quadratics(TERMS), plugins.load("methods", "imtl")(TERMS, init=-0.3)
    torch.testing.assert_close(method.loss.log_scale_T.data, torch.full((len(TERMS),), -0.3))
    with torch.no_grad():
        method.loss.log_scale_T += torch.linspace(-1, 1, len(TERMS))
    backward(method, [[toy.forward]], toy, lr=0.1)
    losses = toy.forward().losses
    scale_T = method.loss.log_scale_T.detach().exp()
    rows = [torch.autograd.grad(loss, toy.shared, retain_graph=True)[0] for loss in losses.values()]
    J_TP = (scale_T[:, None] * torch.stack(rows)).double()
    expected_P = weigh("imtl_g", J_TP) @ J_TP
    torch.testing.assert_close(toy.shared.grad, expected_P.float(), rtol=1e-4, atol=1e-5)
    for scale, name in zip(scale_T, losses, strict=True):
        assert float(toy.own[name].grad) == pytest.approx(2 * float(scale), rel=1e-5)
    expected_T = scale_T * torch.stack([loss.detach() for loss in losses.values()]) - 1
    torch.testing.assert_close(method.loss.log_scale_T.grad, expected_T)
