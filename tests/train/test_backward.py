"""Losses and a method become gradients in one place; all kinds of method agree where they must."""

from functools import partial

import pytest
import torch
from support.methods import step_of
from support.terms import DEPTH, PANOPTIC, TERMS, WHOLE_TASKS
from torch import nn

from mtl_bench.bench.check.methods import Quadratics
from mtl_bench.core import plugins
from mtl_bench.core.method import Composed, CrossMethod, GradientMethod, LookAheadMethod, LossMethod
from mtl_bench.core.terms import gather
from mtl_bench.train.backward import Pass, backward, frozen_statistics, losses_of


class Sum(LossMethod):
    def total(self, step):
        return step.loss_K.sum()


class Squares(LossMethod):
    """Weights that depend on the losses."""

    def total(self, step):
        return step.loss_K.square().sum()


class SumOfGradients(GradientMethod):
    def weights(self, G_KK, step):
        return torch.ones_like(step.loss_K)


class SumAtRepresentation(SumOfGradients):
    needs = "representation"


class Halved(GradientMethod):
    weighted_heads = True

    def weights(self, G_KK, step):
        assert G_KK.dtype == torch.float64
        return torch.full_like(step.loss_K, 0.5)


class ByNorm(GradientMethod):
    """Weights that depend on the gradients and the losses."""

    weighted_heads = True

    def weights(self, G_KK, step):
        return step.loss_K / G_KK.diag().sqrt()


class ByNormAtRepresentation(ByNorm):
    needs = "representation"


def grads(method, scale=1.0, toy=None, **options):
    toy = toy or Quadratics(TERMS)
    weighting = backward(method, [[toy.forward]] * method.batches, toy, scale=scale, **options)
    own = torch.stack([own.grad for own in toy.own.values()])
    return toy.shared.grad, own, weighting


class TinyNet(nn.Module):
    """A trunk with batch norm and two decoders, one of which two losses share."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.trunk = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Tanh(), nn.Linear(8, 6))
        self.decoders = nn.ModuleList([nn.Linear(6, 3), nn.Linear(6, 2)])

    def shared_parameters(self):
        return self.trunk.parameters()

    def task_parameters(self):
        return self.decoders.parameters()

    def forward(self, x, names=tuple(term.name for term in TERMS)):
        z = self.trunk(x)
        z = z.view_as(z)
        first, second = (decoder(z) for decoder in self.decoders)
        values = [first.square().mean(), first[:, 0].abs().mean(), first[:, 1].exp().mean()]
        values += [second.square().mean(), second.tanh().mean() + 1]
        losses = dict(zip([term.name for term in TERMS], values, strict=True))
        return Pass({name: losses[name] for name in names}, [z])


def net_grads(method, parts, **options):
    net = TinyNet()
    backward(method, [[partial(net, x) for x in parts]], net, **options)
    return [parameter.grad for parameter in net.parameters()]


X = torch.randn(12, 4, generator=torch.Generator().manual_seed(5))


def test_a_gradient_method_with_unit_weights_is_the_sum():
    for one, other in zip(grads(Sum(TERMS))[:2], grads(SumOfGradients(TERMS))[:2], strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("kind", [SumOfGradients, SumAtRepresentation])
def test_unit_weights_in_either_space_are_ordinary_backward(kind):
    for one, other in zip(net_grads(Sum(TERMS), [X]), net_grads(kind(TERMS), [X]), strict=True):
        torch.testing.assert_close(one, other)


def test_weighted_heads_follow_the_weights():
    shared, own, weighting = grads(Halved(TERMS))
    full_shared, full_own, _ = grads(SumOfGradients(TERMS))
    torch.testing.assert_close(shared, 0.5 * full_shared)
    torch.testing.assert_close(own, 0.5 * full_own)
    assert weighting.weights == {term.name: 0.5 for term in TERMS}


def test_only_declared_head_weights_are_asked():
    class Tripled(SumOfGradients):
        def head_weights(self, weight_K, step):
            return 3 * step.loss_K

    class Declared(Tripled):
        weighted_heads = True

    toy, sum_own = Quadratics(TERMS), grads(SumOfGradients(TERMS))[1]
    assert torch.equal(grads(Tripled(TERMS))[1], sum_own)
    _, _, weighting = grads(Declared(TERMS), toy=toy)
    own = torch.stack([toy.own[term.name].grad for term in TERMS])
    torch.testing.assert_close(own, 6 * weighting.step.loss_K)  # a single loss's is 2
    assert set(weighting.weights.values()) == {1.0}


def test_a_method_that_needs_gradients_gets_them_and_their_direction_counts():
    class Signs(GradientMethod):
        needs = "jacobian"

        def direction(self, J_KP, step):
            assert J_KP.shape == (len(step.loss_K), 6)
            return J_KP.sign().sum(0), torch.full_like(step.loss_K, 2.0)

    shared, own, weighting = grads(Signs(TERMS))
    assert torch.equal(shared, shared.round())
    assert torch.equal(own, grads(SumOfGradients(TERMS))[1])
    assert set(weighting.weights.values()) == {2.0}


def test_weights_are_the_derivatives_of_the_total():
    weights = grads(plugins.load("methods", "fixed")(TERMS))[2].weights
    assert list(weights.values()) == pytest.approx([1, 200, 0.01, 1, 0.001])


@pytest.mark.parametrize("name", ["fixed", "uncertainty", "fixed_uncertainty"])
def test_loss_scale_multiplies_every_gradient_and_no_weight(name):
    method, scaled = (plugins.load("methods", name)(TERMS) for _ in range(2))
    shared, own, weighting = grads(method)
    shared_scaled, own_scaled, weighting_scaled = grads(scaled, 1024.0)
    torch.testing.assert_close(shared_scaled, 1024 * shared)
    torch.testing.assert_close(own_scaled, 1024 * own)
    assert weighting_scaled.weights == pytest.approx(weighting.weights)
    for parameter, other in zip(method.parameters(), scaled.parameters(), strict=True):
        torch.testing.assert_close(other.grad, 1024 * parameter.grad)


def test_overflow_reaches_the_scaler_and_not_the_method():
    class Never(GradientMethod):
        needs = "jacobian"

        def direction(self, J_KP, step):
            raise AssertionError("the method saw an overflow")

    toy = Quadratics(TERMS)

    def overflow():
        passed = toy.forward()
        losses = {name: loss * torch.inf for name, loss in passed.losses.items()}
        return Pass(losses, passed.representation)

    backward(Never(TERMS), [[overflow]], toy)
    assert not torch.isfinite(toy.shared.grad).all()


# --- a batch in parts -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", [Sum, Squares, SumOfGradients, ByNorm, SumAtRepresentation, ByNormAtRepresentation]
)
def test_parts_of_a_batch_are_the_batch(kind):
    """Exact where the network itself is: batch norm is left out, as it has statistics by part."""

    def run(parts):
        net = TinyNet()
        net.trunk[1] = nn.Identity()
        backward(kind(TERMS), [[partial(net, x) for x in parts]], net)
        return [parameter.grad for parameter in net.parameters()]

    for one, other in zip(run([X]), run(X.split(4)), strict=True):
        torch.testing.assert_close(one, other)


def test_parts_with_different_labels_average_over_those_that_have_them():
    net = TinyNet()
    net.trunk[1] = nn.Identity()
    parts = [partial(net, X[:6]), partial(net, X[6:], names=("semantic",))]
    weighting = backward(Sum(TERMS), [parts], net)
    only = TinyNet()
    only.trunk[1] = nn.Identity()
    other = backward(
        SumOfGradients(TERMS),
        [
            [
                partial(only, x, n)
                for x, n in ((X[:6], [t.name for t in TERMS]), (X[6:], ["semantic"]))
            ]
        ],
        only,
    )
    assert weighting.losses == pytest.approx(other.losses)
    for one, two in zip(net.parameters(), only.parameters(), strict=True):
        torch.testing.assert_close(one.grad, two.grad)


def test_looking_at_losses_leaves_batch_norm_alone():
    net = TinyNet()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    losses_of([partial(net, X)], net)
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    with frozen_statistics(net):
        frozen = net(X).losses["center"]
    assert torch.equal(frozen, net(X).losses["center"])  # it normalises as in training
    assert not torch.equal(before["trunk.1.running_mean"], net.state_dict()["trunk.1.running_mean"])


# --- losses that a batch lacks, tasks in place of terms -------------------------------------------


@pytest.mark.parametrize("kind", [Sum, SumOfGradients])
def test_a_missing_task_is_as_if_the_cell_never_had_it(kind):
    names = tuple(term.name for term in DEPTH)
    net, other = TinyNet(), TinyNet()
    weighting = backward(kind(TERMS), [[partial(net, X, names)]], net)
    backward(kind(DEPTH), [[partial(other, X, names)]], other)
    assert tuple(weighting.weights) == names
    for one, two in zip(net.parameters(), other.parameters(), strict=True):
        assert (one.grad is None) == (two.grad is None)
        if one.grad is not None:
            torch.testing.assert_close(one.grad, two.grad)


def test_a_batch_without_any_labels_is_an_error():
    with pytest.raises(ValueError, match="without labels for any"):
        backward(Sum(TERMS), [[lambda: Pass({}, [])]], Quadratics(TERMS))


def test_a_task_is_the_sum_of_its_terms_at_fixed_weights():
    tasks = WHOLE_TASKS
    assert [(t.name, t.task, t.fixed_weight) for t in tasks] == [
        ("panoptic", "panoptic", 1.0),
        ("depth", "depth", 1.0),
    ]
    losses = {term.name: torch.tensor(float(i)) for i, term in enumerate(TERMS, 1)}
    mine = gather(losses, tasks)
    assert mine["panoptic"].item() == pytest.approx(1 + 200 * 2 + 0.01 * 3)
    assert mine["depth"].item() == pytest.approx(4 + 0.001 * 5)


def test_fixed_weights_over_tasks_are_fixed_weights_over_terms():
    fixed = plugins.load("methods", "fixed")
    whole = net_grads(fixed(WHOLE_TASKS), [X])
    for one, two in zip(net_grads(fixed(TERMS), [X]), whole, strict=True):
        torch.testing.assert_close(one, two)


# --- composition, look-ahead, cosines -------------------------------------------------------------


def test_composition_weighs_the_rows_first():
    uncertain = plugins.load("methods", "fixed_uncertainty")
    alone, loss = uncertain(TERMS), uncertain(TERMS)
    shared, own, weighting = grads(alone)
    composed = grads(Composed(loss, SumOfGradients(TERMS)))
    torch.testing.assert_close(composed[0], shared)
    torch.testing.assert_close(composed[1], own)
    assert composed[2].weights == pytest.approx(weighting.weights)
    torch.testing.assert_close(loss.log_variance_T.grad, alone.log_variance_T.grad)


def test_composition_with_a_missing_task():
    names = tuple(term.name for term in DEPTH)
    uncertain, net, other = plugins.load("methods", "fixed_uncertainty"), TinyNet(), TinyNet()
    composed = Composed(uncertain(TERMS), SumOfGradients(TERMS))
    weighting = backward(composed, [[partial(net, X, names)]], net)
    backward(uncertain(TERMS), [[partial(other, X, names)]], other)
    assert tuple(weighting.weights) == names
    for one, two in zip(net.trunk.parameters(), other.trunk.parameters(), strict=True):
        torch.testing.assert_close(one.grad, two.grad)


def test_composition_travels_in_a_checkpoint():
    first = Composed(plugins.load("methods", "uncertainty")(TERMS), SumOfGradients(TERMS, seed=3))
    with torch.no_grad():
        first.loss.log_variance_T.fill_(0.5)
    second = Composed(plugins.load("methods", "uncertainty")(TERMS), SumOfGradients(TERMS, seed=4))
    second.load_state_dict(first.state_dict())
    assert torch.equal(second.loss.log_variance_T, first.loss.log_variance_T)
    drawn = [m.gradient.generator.get_state() for m in (first, second)]
    assert torch.equal(*drawn)


def test_independent_batches_are_compared_in_the_losses_that_all_have():
    class Last(CrossMethod):
        def weights(self, G_KK, step):
            assert G_KK.shape == (2, 2)
            assert step.present.tolist() == [0, 4]
            return torch.ones_like(step.loss_K)

    net, names = TinyNet(), [term.name for term in TERMS]
    lists = (names, [names[0], names[4]], names[:1] + names[3:])
    batches = [[partial(net, X, some)] for some in lists]
    weighting = backward(Last(TERMS), batches, net)
    assert list(weighting.weights) == ["semantic", "smoothness"]
    one_batch = TinyNet()
    backward(SumOfGradients(TERMS), [[partial(one_batch, X, lists[1])]], one_batch)
    for one, two in zip(net.parameters(), one_batch.parameters(), strict=True):
        torch.testing.assert_close(one.grad, two.grad)


def cross_toy(kind, parts, scale=1.0):
    """Gradients of a step over three batches, and its weights."""
    net, method = TinyNet(), kind(TERMS)
    weighting = backward(method, [[partial(net, x) for x in xs] for xs in parts], net, scale=scale)
    found = [parameter.grad / scale for parameter in net.parameters()]
    return found, weighting


class ByCross(CrossMethod):
    """Weights that depend on all of the matrix, which is not symmetric."""

    def weights(self, G_KK, step):
        assert G_KK.dtype == torch.float64
        return 1 + G_KK[0].abs() / (1 + G_KK.abs().sum()) + 0.1 * step.loss_K


class ByCrossWithHeads(ByCross):
    weighted_heads = True


@pytest.mark.parametrize("kind", [ByCross, ByCrossWithHeads])
def test_cross_weights_come_from_two_batches_and_train_on_a_third(kind):
    batches = [X[:4], X[4:8], X[8:]]
    found, weighting = cross_toy(kind, [[x] for x in batches])
    net, J, losses = TinyNet(), [], []
    shared, own = list(net.shared_parameters()), list(net.task_parameters())
    for x in batches:
        values = list(net(x).losses.values())
        rows = [torch.autograd.grad(v, shared, retain_graph=True) for v in values]
        J.append(torch.stack([torch.cat([g.flatten() for g in row]) for row in rows]))
        losses.append(torch.stack(values))
    A_KK, mean_K = (J[0] @ J[1].T).double(), (losses[0] + losses[1]).detach() / 2
    weight_K = kind(TERMS).weights(A_KK, step_of(mean_K.double())).float()
    assert list(weighting.weights.values()) == pytest.approx(weight_K.tolist(), rel=1e-5)
    direction_P = weight_K @ J[2]
    torch.testing.assert_close(torch.cat([g.flatten() for g in found[: len(shared)]]), direction_P)
    head_K = weight_K if kind.weighted_heads else torch.ones(5)
    expected = torch.autograd.grad((head_K * losses[2]).sum(), own)
    for mine, other in zip(found[len(shared) :], expected, strict=True):
        torch.testing.assert_close(mine, other)


def test_cross_batches_in_parts_and_a_loss_scale_change_nothing():
    class Fixed(CrossMethod):  # batch norm sees parts, so weights that depend on gradients differ
        def weights(self, G_KK, step):
            return torch.arange(1.0, 6.0).to(step.loss_K)

    batches = [X[:4], X[4:8], X[8:]]
    whole, _ = cross_toy(Fixed, [[x] for x in batches])
    for mine, other in zip(cross_toy(Fixed, [[x] for x in batches], 64.0)[0], whole, strict=True):
        torch.testing.assert_close(mine, other)
    twice, _ = cross_toy(Fixed, [[x, x] for x in batches])
    for mine, other in zip(twice, whole, strict=True):
        torch.testing.assert_close(mine, other)


def test_independent_batches_without_a_common_loss_are_refused():
    net, names = TinyNet(), [term.name for term in TERMS]
    with pytest.raises(ValueError, match="share no labels"):
        backward(ByCross(TERMS), [[partial(net, X, names[i : i + 1])] for i in range(3)], net)


def test_look_ahead_sees_the_moved_point_and_leaves_it():
    class Looks(LookAheadMethod):
        def direction_ahead(self, J_KP, step, ahead, lr):
            direction_P = J_KP.sum(0)
            self.there = ahead(direction_P), lr
            return direction_P, torch.ones_like(step.loss_K)

    toy, method = Quadratics(TERMS), Looks(TERMS)
    point = toy.shared.detach().clone()
    shared, _, _ = grads(method, toy=toy, lr=0.1)
    assert torch.equal(toy.shared, point)
    targets = torch.stack([toy.target[term.name] for term in TERMS])
    expected = 2 * (point - 0.1 * shared - targets) / len(point)
    torch.testing.assert_close(method.there[0], expected)
    assert method.there[1] == 0.1


@pytest.mark.parametrize("kind", [Sum, SumOfGradients])
def test_cosines_are_those_of_the_gradients(kind):
    toy = Quadratics(TERMS)
    rows = [torch.autograd.grad(v, toy.shared)[0] for v in toy.forward().losses.values()]
    plain = grads(kind(TERMS))
    shared, _, weighting = grads(kind(TERMS), cosines=True)
    assert len(weighting.cosines) == 10
    expected = torch.cosine_similarity(rows[0], rows[3], dim=0).item()
    assert weighting.cosines["semantic.photometric"] == pytest.approx(expected, abs=1e-6)
    torch.testing.assert_close(shared, plain[0])  # measuring changes nothing


# Reference values: section "uncertainty total" of MGNet's public code, computed with it.
WEIGHTED = torch.tensor([0.8, 0.08, 0.06, 0.09, 5e-5], dtype=torch.float64)


@pytest.mark.parametrize(
    ("log_variance", "expected"),
    [([0.0] * 5, 0.915025), ([-0.5, -1.0, 0.3, -2.0, -3.0], -1.317057500806)],
)
def test_fixed_uncertainty_equals_the_papers_loss(log_variance, expected):
    method = plugins.load("methods", "fixed_uncertainty")(TERMS).double()
    with torch.no_grad():
        method.log_variance_T.copy_(torch.tensor(log_variance))
    fixed = torch.tensor([1, 200, 0.01, 1, 0.001], dtype=torch.float64)
    assert method.total(step_of(WEIGHTED / fixed)).item() == pytest.approx(expected, abs=1e-6)


def test_uncertainty_is_stationary_where_the_theory_says():
    """One term's optimum is exp(s) = 2 tau L, and it then contributes 1/2 (1 + s)."""
    method = plugins.load("methods", "uncertainty")(TERMS).double()
    loss_T = torch.tensor([0.7, 0.002, 3.0, 0.1, 0.05], dtype=torch.float64)
    with torch.no_grad():
        method.log_variance_T.copy_(torch.log(2 * method.tau_T * loss_T))
    method.total(step_of(loss_T)).backward()
    torch.testing.assert_close(method.log_variance_T.grad, torch.zeros(5, dtype=torch.float64))


def test_state_is_tied_to_its_terms():
    method = plugins.load("methods", "uncertainty")
    with pytest.raises(ValueError, match="method state is for the terms"):
        method(PANOPTIC).load_state_dict(method(DEPTH).state_dict())
