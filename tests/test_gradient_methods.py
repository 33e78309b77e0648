"""The methods that need more than a Gramian, against their formulas written down a second time.

Oracles: autograd and torch.optim where a rule is a derivative, plain numpy elsewhere, and torchjd
where it has the method. Conventions that differ from torchjd 0.18:

| method   | torchjd                        | here                                                 |
| graddrop | drops where P = U              | keeps the sign - there: where P = 0, always          |
| excess   | 0 warm-up steps: first one raw | at least 1 warm-up step                              |
| modo     | weights only, given J_1 J_2^T  | the same weights, times J_3                          |
| sdmgrad  | as modo; A / (scale^2 + 1e-8)  | A / scale^2, A if that is 0                          |
"""

import copy
import io

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from mtl_bench.core import plugins
from mtl_bench.core.method import LookAheadMethod
from mtl_bench.core.terms import Term

torchjd = pytest.importorskip("torchjd.aggregation")

NAMES = ("gradnorm", "graddrop", "excess", "moco", "modo", "sdmgrad", "db_mtl", "auto_lambda")
DETERMINISTIC = tuple(name for name in NAMES if name != "graddrop")
QUICK = {"excess": {"warm_up": 1, "eta": 0.5}, "auto_lambda": {"lr": 0.05}, "modo": {"gamma": 0.01}}


def make(name, tasks, seed=0, **settings):
    terms = [Term(f"task{i}", "depth", "regression", 1.0) for i in range(tasks)]
    return plugins.load("methods", name)(terms, seed=seed, **settings)


def quick(name, tasks, seed=0):
    """Settings under which a few steps change all of the state."""
    return make(name, tasks, seed, **QUICK.get(name, {}))


def sequence(steps, tasks, size=7, seed=0):
    """Per step, three batches' gradients and losses."""
    draw = torch.Generator().manual_seed(seed)
    kind = {"generator": draw, "dtype": torch.float64}
    J = torch.randn(steps, 3, tasks, size, **kind) + torch.randn(tasks, size, **kind)
    return list(zip(J, torch.rand(steps, 3, tasks, **kind) + 0.1, strict=True))


def update(method, J_NKP, loss_NK):
    """One answer, given as many of the three batches as the method takes."""
    if isinstance(method, LookAheadMethod):
        return method.direction_ahead(J_NKP[0], loss_NK[0], lambda direction_P: J_NKP[1], 0.1)
    if method.batches == 1:
        return method.direction(J_NKP[0], loss_NK[0])
    return method.direction(J_NKP[: method.batches], loss_NK[: method.batches])


def same(found, expected, tolerance=1e-10):
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), tolerance, tolerance)


def simplex(v_K):
    """Projection on the simplex by its optimality condition: one shift, found by root search."""
    shift = brentq(lambda t: np.maximum(v_K - t, 0).sum() - 1, v_K.min() - 1, v_K.max(), xtol=1e-15)
    return np.maximum(v_K - shift, 0)


# --- formulas -------------------------------------------------------------------------------------


def test_gradnorm_is_algorithm_1():
    method, steps = make("gradnorm", 4), sequence(5, 4)
    w = torch.ones(4, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([w], lr=0.025)
    for J_NKP, loss_NK in steps:
        direction_P, weight_K = update(method, J_NKP, loss_NK)
        same(direction_P, w.detach() @ J_NKP[0])  # by the weights as they are
        same(weight_K, w.detach())
        norm_K = torch.stack([torch.linalg.norm(w[i] * J_NKP[0, i]) for i in range(4)])
        inverse_rate_K = loss_NK[0] / steps[0][1][0]
        r_K = inverse_rate_K / inverse_rate_K.mean()
        target_K = (norm_K.mean() * r_K**1.5).detach()
        adam.zero_grad()
        (norm_K - target_K).abs().sum().backward()
        adam.step()
        with torch.no_grad():
            w.mul_(4 / w.sum())
    assert method.head_weights(weight_K, loss_NK[0]) is weight_K


def test_gradnorm_keeps_weights_positive():
    method = make("gradnorm", 3, lr=0.5)
    for J_NKP, loss_NK in sequence(30, 3):
        J_NKP[:, 0] *= 100
        update(method, J_NKP, loss_NK)
        assert (method.weight_T > 0).all()
        same(method.weight_T.sum(), 3.0)
    assert method.weight_T[0] < 0.1


@pytest.mark.parametrize("scaled", [True, False])
def test_moco_is_algorithm_1(scaled):
    method = make("moco", 4, rho=0.2, scaled=scaled)
    y_KP, lambda_K = np.zeros((4, 7)), np.full(4, 0.25)
    for k, (J_NKP, loss_NK) in enumerate(sequence(5, 4), 1):
        direction_P, weight_K = update(method, J_NKP, loss_NK)
        for i, (g_P, loss) in enumerate(zip(J_NKP[0].numpy(), loss_NK[0].numpy(), strict=True)):
            h_P = loss * g_P / np.sqrt((g_P**2).sum()) if scaled else g_P
            y_KP[i] = y_KP[i] - 0.5 / np.sqrt(k) * (y_KP[i] - h_P)
        pull_K = (y_KP @ y_KP.T + 0.2 * np.eye(4)) @ lambda_K
        lambda_K = simplex(lambda_K - 0.1 / np.sqrt(k) * pull_K)
        same(weight_K, lambda_K)
        same(direction_P, sum(lambda_K[i] * y_KP[i] for i in range(4)))


@pytest.mark.parametrize(("beta", "decay"), [(0.9, 0.0), (0.5, 0.5)])
def test_db_mtl_is_algorithm_1(beta, decay):
    method, m_KP = make("db_mtl", 4, beta=beta, decay=decay), np.zeros((4, 7))
    for k, (J_NKP, loss_NK) in enumerate(sequence(5, 4), 1):
        direction_P, weight_K = update(method, J_NKP, loss_NK)
        loss_K = loss_NK[0].clone().requires_grad_()
        (log_K,) = torch.autograd.grad((loss_K + 1e-8).log().sum(), loss_K)
        beta_k = beta / k**decay
        m_KP = beta_k * m_KP + (1 - beta_k) * log_K.numpy()[:, None] * J_NKP[0].numpy()
        norm_K = np.linalg.norm(m_KP, axis=1)
        same(direction_P, norm_K.max() * sum(m_KP[i] / norm_K[i] for i in range(4)))
        same(method.head_weights(weight_K, loss_NK[0]), log_K)
    one_step = make("db_mtl", 4, beta=0.0)
    direction_P, weight_K = update(one_step, J_NKP, loss_NK)
    same(weight_K @ J_NKP[0], direction_P)  # the logged weights, without memory


def test_db_mtl_does_not_see_the_scale_of_losses():
    first, second, factor_K = make("db_mtl", 3), make("db_mtl", 3), torch.tensor([1e-3, 1.0, 1e3])
    for J_NKP, loss_NK in sequence(4, 3):
        loss_NK = loss_NK * 1e3  # so that the 1e-8 in the logarithm is nothing
        direction_P, _ = update(first, J_NKP, loss_NK)
        scaled_P, _ = update(second, J_NKP * factor_K[:, None], loss_NK * factor_K)
        same(scaled_P, direction_P, 1e-6)


class Bowls:
    """Two batches of quadratic losses |A_i theta - b_i|^2 / 2 with all derivatives known."""

    def __init__(self, tasks=3, size=5, seed=0):
        draw = torch.Generator().manual_seed(seed)
        self.A = torch.randn(2, tasks, 4, size, generator=draw, dtype=torch.float64)
        self.b = torch.randn(2, tasks, 4, generator=draw, dtype=torch.float64)
        self.theta = torch.randn(size, generator=draw, dtype=torch.float64)

    def losses(self, batch, theta):
        return 0.5 * (self.A[batch] @ theta - self.b[batch]).square().sum(1)

    def J(self, batch, theta):
        residual = self.A[batch] @ theta - self.b[batch]
        return torch.einsum("tri,tr->ti", self.A[batch], residual)


def test_auto_lambda_descends_the_look_ahead_loss():
    """Against autograd through the step and torch's Adam; the bowls move with the updates."""
    bowls, method, lr = Bowls(), make("auto_lambda", 3, init=0.2, lr=0.03), 0.05
    reference = torch.full((3,), 0.2, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([reference], lr=0.03)
    for _ in range(5):
        theta, J_KP = bowls.theta, bowls.J(0, bowls.theta)

        def ahead(direction_P, theta=theta):
            return bowls.J(1, theta - lr * direction_P)

        direction_P, weight_K = method.direction_ahead(
            J_KP, bowls.losses(0, theta).detach(), ahead, lr
        )
        adam.zero_grad()
        bowls.losses(1, theta - lr * (reference @ J_KP)).sum().backward()
        adam.step()
        same(weight_K, reference.detach())
        same(direction_P, reference.detach() @ J_KP)  # lambda first, then the network
        bowls.theta = theta - lr * direction_P
    assert method.head_weights(weight_K, weight_K) is weight_K


def test_auto_lambda_hypergradient_by_finite_differences():
    bowls, method, lr = Bowls(), make("auto_lambda", 3), 0.05
    J_KP = bowls.J(0, bowls.theta)
    looked = []

    def ahead(direction_P):
        looked.append(direction_P)
        return bowls.J(1, bowls.theta - lr * direction_P)

    method.direction_ahead(J_KP, bowls.losses(0, bowls.theta), ahead, lr)
    same(looked[0], 0.1 * J_KP.sum(0))
    found_K = method.adam.first / (1 - 0.9)  # what Adam got at its first step
    for i in range(3):
        sums = []
        for change in (1e-5, -1e-5):
            lambda_K = torch.full((3,), 0.1, dtype=torch.float64)
            lambda_K[i] += change
            sums.append(bowls.losses(1, bowls.theta - lr * (lambda_K @ J_KP)).sum())
        same(found_K[i], (sums[0] - sums[1]) / 2e-5, 1e-7)


# --- torchjd --------------------------------------------------------------------------------------


def jacobians(tasks):
    """Three batches each: what gradients can look like."""
    random = sequence(1, tasks, 12, seed=5)[0][0]
    aligned = random.abs()
    opposed, double, zero_row = (random.clone() for _ in range(3))
    opposed[:, 1] = -2 * opposed[:, 0]
    double[:, 1] = double[:, 0]
    zero_row[:, 2] = 0
    scale_K = torch.logspace(-3, 3, tasks, dtype=torch.float64)
    return {
        "random": random,
        "aligned": aligned,
        "opposed": opposed,
        "double": double,
        "zero row": zero_row,
        "ill-scaled": random * scale_K[:, None],
    }


CASES = [
    pytest.param(J_NKP, id=f"{title}-{tasks}")
    for tasks in (3, 5, 11)
    for title, J_NKP in jacobians(tasks).items()
]


@pytest.mark.parametrize("J_NKP", CASES)
@pytest.mark.parametrize("leak", [0.0, 0.3])
def test_graddrop_is_torchjds(J_NKP, leak, monkeypatch):
    J_KP = J_NKP[0]
    method = make("graddrop", len(J_KP), seed=7, leak=leak)
    copied = copy.deepcopy(method).generator
    drawn_P = torch.rand(J_KP.shape[1], dtype=J_KP.dtype, generator=copied)
    direction_P, weight_K = method.direction(J_KP, torch.ones(len(J_KP)))
    with monkeypatch.context() as patch:
        patch.setattr(torch, "rand", lambda *args, **kwargs: drawn_P)
        leak_K = torch.full((len(J_KP),), leak, dtype=J_KP.dtype)
        same(direction_P, torchjd.GradDrop(leak=leak_K)(J_KP))
    same(method.head_weights(weight_K, weight_K), np.ones(len(J_KP)))


@pytest.mark.parametrize("J_NKP", CASES)
def test_excess_is_torchjds(J_NKP):
    tasks = J_NKP.shape[1]
    method = make("excess", tasks, eta=0.3, warm_up=2)
    reference = torchjd.ExcessMTLWeighting(robust_step_size=0.3, n_warmup_steps=2)
    for step in range(6):
        J_KP = J_NKP[step % 3] * 0.9**step
        direction_P, weight_K = method.direction(J_KP, torch.ones(tasks))
        same(weight_K, reference(J_KP))
        same(direction_P, weight_K @ J_KP)
    assert weight_K.std() > 1e-4


@pytest.mark.parametrize("J_NKP", CASES)
def test_modo_is_torchjds(J_NKP):
    method = make("modo", J_NKP.shape[1], gamma=0.02, rho=0.1)
    reference = torchjd.MoDoWeighting(gamma=0.02, rho=0.1)
    for step in range(5):
        batches = J_NKP.roll(step, 0)
        direction_P, weight_K = update(method, batches, batches[..., 0])
        same(weight_K, reference(batches[0] @ batches[1].T), 1e-6)
        same(direction_P, weight_K @ batches[2])


@pytest.mark.parametrize("J_NKP", CASES)
def test_sdmgrad_is_torchjds(J_NKP):
    method, reference = make("sdmgrad", J_NKP.shape[1]), torchjd.SDMGradWeighting()
    for step in range(5):
        batches = J_NKP.roll(step, 0)
        direction_P, weight_K = update(method, batches, batches[..., 0])
        A_KK = batches[0] @ batches[1].T
        scale = A_KK.diagonal().clamp_min(0).sqrt().mean()
        reference.lr = 10 * float(1 + 1e-8 / scale**2)  # its 1e-8 is felt: the inner steps are long
        same(weight_K, reference(A_KK), 1e-6)
        same(direction_P, weight_K @ batches[2])


# --- properties -----------------------------------------------------------------------------------


def test_graddrop_without_conflict_is_the_sum():
    for sign in (1, -1):
        J_KP = sign * sequence(1, 4, 5000)[0][0][0].abs().float()
        direction_P, weight_K = make("graddrop", 4).direction(J_KP, torch.ones(4))
        assert torch.equal(direction_P, J_KP.sum(0))
        same(weight_K, np.ones(4), 1e-6)


@pytest.mark.parametrize("leak", [0.0, 0.25])
def test_graddrop_on_average_weighs_the_signs_by_purity(leak):
    draws, J_KP = 40_000, sequence(1, 4)[0][0][0]
    direction_P, _ = make("graddrop", 4, leak=leak).direction(J_KP.repeat(1, draws), torch.ones(4))
    found_P = direction_P.view(draws, -1).mean(0)
    plus_P, minus_P = J_KP.clamp_min(0).sum(0), J_KP.clamp_max(0).sum(0)
    purity_P = plus_P / (plus_P - minus_P)
    kept_P = purity_P * plus_P + (1 - purity_P) * minus_P
    error_P = 5 * J_KP.abs().sum(0) / draws**0.5
    expected_P = leak * J_KP.sum(0) + (1 - leak) * kept_P
    assert ((found_P - expected_P).abs() < error_P).all()


def shortest(J_KP, target_P):
    """Of two tasks: w on the simplex with the shortest J^T w + target, in closed form."""
    start, way = J_KP[1] + target_P, J_KP[0] - J_KP[1]
    first = float((-(start @ way) / (way @ way)).clamp(0, 1))
    return torch.tensor([first, 1 - first], dtype=J_KP.dtype)


@pytest.mark.parametrize("seed", range(4))
def test_modo_on_equal_batches_ends_at_the_shortest_combination(seed):
    J_KP = sequence(1, 2, seed=seed)[0][0][0]
    batches, method = J_KP.expand(3, 2, 7), make("modo", 2, gamma=0.01, rho=0.0)
    for _ in range(3000):
        _, weight_K = update(method, batches, batches[..., 0])
    same(weight_K, shortest(J_KP, torch.zeros(7)), 1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_sdmgrad_on_equal_batches_ends_at_the_shortest_near_the_average(seed):
    J_KP, lam = sequence(1, 2, seed=seed)[0][0][0], 0.3
    batches = J_KP.expand(3, 2, 7)
    method = make("sdmgrad", 2, lam=lam, lr=0.3)
    for _ in range(50):
        direction_P, weight_K = update(method, batches, batches[..., 0])
    best_K = shortest(J_KP, lam * J_KP.mean(0))
    same(weight_K, (best_K + lam / 2) / (1 + lam), 1e-6)
    same(direction_P, (best_K @ J_KP + lam * J_KP.mean(0)) / (1 + lam), 1e-6)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_the_order_of_tasks_does_not_matter(name):
    order = torch.tensor([2, 0, 3, 1])
    first, second = quick(name, 4), quick(name, 4)
    for J_NKP, loss_NK in sequence(4, 4):
        direction_P, weight_K = update(first, J_NKP, loss_NK)
        other_P, other_K = update(second, J_NKP[:, order], loss_NK[:, order])
        same(other_P, direction_P, 1e-9)
        same(other_K, weight_K[order], 1e-9)


# --- state ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_state_goes_into_a_fresh_method(name):
    steps = [(J.float(), loss.float()) for J, loss in sequence(6, 4)]
    straight, first, second = quick(name, 4, 3), quick(name, 4, 3), quick(name, 4, 99)
    for J_NKP, loss_NK in steps[:3]:
        update(straight, J_NKP, loss_NK)
        update(first, J_NKP, loss_NK)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    for J_NKP, loss_NK in steps[3:]:
        for found, expected in zip(
            update(second, J_NKP, loss_NK), update(straight, J_NKP, loss_NK), strict=True
        ):
            assert torch.equal(found, expected)
    for key, value in straight.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(second.state_dict()[key], value), key


@pytest.mark.parametrize("name", NAMES)
def test_an_absent_task_keeps_its_state(name):
    """On a method that has seen all tasks, and on one whose first batch lacks one."""
    here = torch.tensor([0, 2])
    for seen in (2, 0):
        method, steps = quick(name, 3), sequence(seen + 1, 3)
        *before, last = steps
        for J_NKP, loss_NK in before:
            update(method, J_NKP, loss_NK)
        old = {key: value.clone() for key, value in method.named_buffers() if value.ndim}
        method.present = here
        direction_P, weight_K = update(method, last[0][:, here], last[1][:, here])
        assert weight_K.shape == (2,)
        assert torch.isfinite(direction_P).all()
        for key, value in method.named_buffers():
            if value.ndim and old[key].numel():
                assert torch.equal(value[1], old[key][1]), key
                assert "rows" not in key or not torch.equal(value[0], old[key][0]), key
        method.present = torch.arange(3)
        direction_P, _ = update(method, *last)
        assert torch.isfinite(direction_P).all()


@pytest.mark.parametrize(
    ("name", "state", "total"),
    [("gradnorm", "weight_T", 3.0), ("moco", "lambda_T", 1.0), ("modo", "lambda_T", 1.0)],
)
def test_the_present_tasks_keep_their_part_of_the_weight(name, state, total):
    method = quick(name, 3)
    for present in ([0, 1, 2], [0, 2], [1], [0, 1, 2]):
        method.present = torch.tensor(present)
        before = getattr(method, state)[method.present].sum().item()
        for J_NKP, loss_NK in sequence(3, 3):
            update(method, J_NKP[:, method.present], loss_NK[:, method.present])
        same(getattr(method, state)[method.present].sum(), before)
        same(getattr(method, state).sum(), total)


def test_excess_weights_sum_to_1_over_all_tasks():
    method = quick("excess", 3)
    for present in ([0, 1, 2], [0, 2], [1]):
        method.present = torch.tensor(present)
        for J_NKP, loss_NK in sequence(3, 3):
            update(method, J_NKP[:, method.present], loss_NK[:, method.present])
        same(method.log_weight_T.exp().sum(), 1.0)


def test_excess_waits_for_the_warm_up():
    method = make("excess", 3, warm_up=3, eta=1.0)
    weights = [update(method, *step)[1] for step in sequence(5, 3)]
    for weight_K in weights[:3]:
        same(weight_K, np.full(3, 1 / 3))
    assert weights[3].std() > 1e-3
    with pytest.raises(ValueError, match="warm_up 0"):
        make("excess", 3, warm_up=0)


# --- hard inputs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-10, 1.0, 1e10])
@pytest.mark.parametrize("loss", [1e-10, 1.0, 1e10])
@pytest.mark.parametrize("name", NAMES)
def test_hard_inputs_stay_finite(name, size, loss):
    cases = {**jacobians(5), "zero": torch.zeros(3, 5, 12)}
    cases["equal"] = cases["random"][:, :1].repeat(1, 5, 1)
    for title, J_NKP in cases.items():
        method, J_NKP = quick(name, 5), size * J_NKP.float()
        for loss_NK in (torch.full((3, 5), loss), torch.zeros(3, 5), torch.full((3, 5), loss)):
            given = J_NKP.clone()
            direction_P, weight_K = update(method, given, loss_NK)
            head_K = method.head_weights(weight_K, loss_NK[0])
            for tensor in (direction_P, weight_K, head_K, *method.buffers()):
                assert torch.isfinite(tensor).all(), title
            assert torch.equal(given, J_NKP), title


@pytest.mark.parametrize("name", ["moco", "modo", "sdmgrad"])
def test_weights_stay_on_the_simplex_at_any_scale(name):
    for size in (1e-10, 1e10):
        method = quick(name, 5)
        for J_NKP, loss_NK in sequence(3, 5):
            _, weight_K = update(method, (size * J_NKP).float(), (size * loss_NK).float())
            same(weight_K.sum(), 1.0, 1e-6)
            assert (weight_K >= 0).all()
