"""Methods of 2024 and later: values worked out by hand, and identities.

Shapes: T losses of the method, K of them given, P parameters.
"""

import itertools
import math
import sys

import pytest
import torch
from support.methods import head_weights, step_of, weights
from support.terms import TERMS, WHOLE_TASKS

from mtl_bench.bench.check.methods import LOSSES, Quadratics
from mtl_bench.core import plugins
from mtl_bench.core.method import Composed
from mtl_bench.core.terms import Term
from mtl_bench.train.backward import backward
from mtl_bench.train.compose import compose

F64 = torch.float64


def make(name, tasks=2, **settings):
    terms = [Term(f"task{i}", "depth", "regression", 1.0) for i in range(tasks)]
    return plugins.load("methods", name)(terms, **settings)


def losses(*values):
    return torch.tensor(values, dtype=F64)


# --- GO4Align -------------------------------------------------------------------------------------


def test_go4align_of_a_group_each_is_mean_over_loss_times_the_smooth_share():
    method = make("go4align", 2, groups=2, beta=math.log(3) / 2)
    # q = (1/2 3^(-1/2), 1/2 3^(-3/2)) over their sum: 3/4 and 1/4; the mean loss is 2
    expected = losses(3 / 4 * 2 / 1, 1 / 4 * 2 / 3)
    torch.testing.assert_close(weights(method, losses(1.0, 3.0)), expected)
    # once more: 9/10 and 1/10
    expected = losses(9 / 10 * 2 / 1, 1 / 10 * 2 / 3)
    torch.testing.assert_close(weights(method, losses(1.0, 3.0)), expected)


def test_go4align_of_one_group_is_the_mean_indicator():
    method = make("go4align", 3, groups=1, beta=0.0)
    mean = 7 / 3
    indicator = mean * (1 + 1 / 2 + 1 / 4) / 3 / 3
    torch.testing.assert_close(
        weights(method, losses(1, 2, 4)), torch.full((3,), indicator, dtype=F64)
    )


def test_go4align_puts_the_two_near_ones_together():
    method = make("go4align", 3, groups=2, beta=0.0)
    weight_K = weights(method, losses(1.0, 10.0, 11.0))
    mean = 22 / 3
    together = (mean / 10 + mean / 11) / 2 / 3
    torch.testing.assert_close(weight_K, losses(mean / 3, together, together))


def test_go4align_with_beta_0_and_a_group_each_is_parallel_to_the_sum_of_logarithms():
    loss_K = losses(0.2, 3.0, 40.0, 500.0)
    ours = weights(make("go4align", 4, groups=4, beta=0.0), loss_K)
    other = weights(make("scale_invariant", 4), loss_K)
    torch.testing.assert_close(ours / ours.sum(), other / other.sum())


@pytest.mark.parametrize("groups", [1, 2, 3])
def test_the_groups_are_the_best_of_all(groups):
    centres = sys.modules[plugins.load("methods", "go4align").__module__].centres
    generator = torch.Generator().manual_seed(groups)
    for _ in range(3):
        value_K = torch.randn(5, generator=generator, dtype=F64).exp()
        least = math.inf
        for labels in itertools.product(range(groups), repeat=5):
            label_K = torch.tensor(labels)
            found_K = torch.stack([value_K[label_K == label].mean() for label in label_K])
            least = min(least, float((value_K - found_K).square().sum()))
        ours_K = centres(value_K, groups)
        assert float((value_K - ours_K).square().sum()) == pytest.approx(least)
        assert len(ours_K.unique()) == groups
    torch.testing.assert_close(centres(value_K, groups + 5), value_K)  # empty groups do no harm


def test_go4align_wants_a_group():
    with pytest.raises(ValueError, match="groups 0 must be at least 1, beta"):
        make("go4align", groups=0)


# --- NTKMTL ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ntkmtl", "ntkmtl_sr"])
def test_ntkmtl_by_hand(name):
    G_KK = torch.tensor([[9.0, 2.0], [2.0, 16.0]], dtype=F64)
    method = make(name)
    weight_K = method.weights(G_KK, step_of(losses(1, 1)))
    torch.testing.assert_close(weight_K, losses(math.sqrt(12.5) / 3, math.sqrt(12.5) / 4))
    torch.testing.assert_close(head_weights(method, weight_K, losses(1, 1)), weight_K)


def test_ntkmtl_makes_all_kernels_equally_large_and_keeps_their_mean():
    J_KP = torch.randn(5, 20, generator=torch.Generator().manual_seed(1), dtype=F64)
    J_KP *= torch.logspace(-3, 3, 5, dtype=F64)[:, None]
    weight_K = make("ntkmtl", 5).weights(J_KP @ J_KP.T, step_of(torch.ones(5, dtype=F64)))
    square_K = (weight_K[:, None] * J_KP).square().sum(1)
    torch.testing.assert_close(square_K, J_KP.square().sum(1).mean().expand(5))


def test_ntkmtl_leaves_a_zero_gradient_out():
    G_KK = torch.diag(losses(9.0, 0.0, 16.0))
    weight_K = make("ntkmtl", 3).weights(G_KK, step_of(losses(1, 1, 1)))
    torch.testing.assert_close(weight_K, losses(math.sqrt(12.5) / 3, 1.0, math.sqrt(12.5) / 4))


# --- LDC-MTL --------------------------------------------------------------------------------------


def test_ldc_by_hand():
    method = make("ldc", lam=0.1, normalize="none")
    loss_K = torch.tensor([1.0, 3.0], requires_grad=True)
    total = method.total(step_of(loss_K))
    assert total.item() == pytest.approx((1 + 3) / 2 + 0.1 * (3 - 1))
    total.backward()
    torch.testing.assert_close(loss_K.grad, torch.tensor([0.5 - 0.1, 0.5 + 0.1]))
    # d/da_i sum_j s_j l_j = s_i (l_i - sum_j s_j l_j)
    torch.testing.assert_close(method.logit_T.grad, torch.tensor([0.5 * (1 - 2), 0.5 * (3 - 2)]))


def test_ldc_with_weighted_levels_moves_its_weights_towards_equal_levels():
    method = make("ldc", lam=1.0, tau="weights", normalize="none")
    method.total(step_of(torch.tensor([1.0, 3.0]))).backward()
    # beside the sum's -1/2: the level 3 s_2 - s_1 has the derivative -3 s_1 s_2 - s_1 s_2 = -1
    torch.testing.assert_close(method.logit_T.grad, torch.tensor([-1.5, 1.5]))


def test_ldcs_penalty_is_the_mean_of_the_papers_over_all_orders():
    values = [0.3, 1.0, 2.5, 4.0]
    ours = make("ldc", 4, normalize="none", lam=1.0).total(step_of(torch.tensor(values))).item()
    adjacent = [
        sum(abs(a - b) for a, b in itertools.pairwise(order))
        for order in itertools.permutations(values)
    ]
    assert ours == pytest.approx(sum(values) / 4 + sum(adjacent) / len(adjacent))


def test_ldc_counts_losses_from_their_first_value():
    method = make("ldc", lam=0.1)
    first = weights(method, torch.tensor([1.0, 300.0]))
    torch.testing.assert_close(
        first, torch.tensor([0.5, 0.5 / 300])
    )  # both levels are 1: no penalty
    later = weights(method, torch.tensor([1.0, 150.0]))
    torch.testing.assert_close(later, torch.tensor([0.5 + 0.1, (0.5 - 0.1) / 300]))


def test_ldc_names_what_it_does_not_know():
    with pytest.raises(ValueError, match="tau 'two' is not one of one, weights"):
        plugins.load("methods", "ldc")(TERMS, tau="two")


# --- wrappers -------------------------------------------------------------------------------------


def gramians(count, tasks=3):
    generator = torch.Generator().manual_seed(7)
    for _ in range(count):
        J_KP = torch.randn(tasks, 6, generator=generator, dtype=F64)
        yield J_KP @ J_KP.T


def composed(name, tasks=3, **settings):
    terms = [Term(f"task{i}", "depth", "regression", 1.0) for i in range(tasks)]
    return compose(name, settings, terms, seed=0)


def test_relative_shares_are_of_the_tasks_first_losses_for_good():
    terms = (Term("a", "one", "regression", 1.0), Term("b", "one", "regression", 10.0))
    terms += (Term("c", "two", "regression", 1.0),)
    shares = {"one": 3.0, "two": 1.0}
    method = plugins.load("methods", "scalarised")(terms, shares=shares, relative=True)
    first_K = torch.tensor([2.0, 0.4, 100.0])  # of tasks 2 + 10 * 0.4 = 6, and 100
    one, two = 2 * 0.75 / 6, 2 * 0.25 / 100
    expected = torch.tensor([one, 10 * one, two])
    torch.testing.assert_close(weights(method, first_K), expected)
    torch.testing.assert_close(weights(method, first_K / 7), expected)


def test_relative_shares_wait_for_a_task_that_is_absent_at_first():
    method = plugins.load("methods", "scalarised")(WHOLE_TASKS, relative=True)
    torch.testing.assert_close(weights(method, torch.tensor([0.5])), torch.tensor([2.0]))
    found_2 = weights(method, torch.tensor([0.1, 4.0]))
    torch.testing.assert_close(found_2, torch.tensor([2.0, 0.25]))


def test_cr_averages_the_weights_of_what_it_is_around():
    method, plain = composed("cr+ntkmtl", cr={"alpha": 0.75}), make("ntkmtl", 3)
    step, average = step_of(torch.ones(3, dtype=F64)), None
    for G_KK in gramians(4):
        new = plain.weights(G_KK, step)
        average = new if average is None else 0.75 * average + 0.25 * new
        torch.testing.assert_close(method.weights(G_KK, step), average)
    torch.testing.assert_close(method.head_weights(average, step), average)


def test_cr_equals_torchjds():
    theirs = pytest.importorskip("torchjd.aggregation")
    oracle = theirs.CRMOGMWeighting(theirs.UPGradWeighting(), alpha=0.9)
    ours = composed("cr+upgrad")
    for G_KK in gramians(5):
        weight_K = ours.weights(G_KK, step_of(torch.ones(3, dtype=F64)))
        torch.testing.assert_close(weight_K, oracle(G_KK), rtol=1e-4, atol=1e-6)


def test_cr_keeps_the_weights_of_absent_tasks():
    method = composed("cr+ntkmtl", cr={"alpha": 0.5})
    both, one = step_of(losses(1, 1, 1)), step_of(losses(1), torch.tensor([1]))
    first = method.weights(torch.diag(losses(1, 4, 1)), both)
    method.weights(torch.diag(losses(9)), one)
    assert method.weight_T.tolist() == [first[0], (first[1] + 1) / 2, first[2]]


def test_a_composition_of_three_is_a_loss_value_method_on_a_wrapped_one():
    method = composed("uncertainty+cr+nash", cr={"alpha": 0.5}, nash={"every": 3})
    assert isinstance(method, Composed)
    assert (type(method.gradient).__name__, method.gradient.alpha) == ("CorrelationReduced", 0.5)
    assert (method.gradient.inner.every, method.gradient.weighted_heads) == (3, True)
    assert composed("cr+mgda_ub").needs == "representation"
    assert composed("cr+cr+mgda").inner.inner.needs == "gramian"


def test_samo_with_the_mean_alone_takes_all_gradients_one_step_up():
    method = compose("samo", {"alpha": 1.0, "rho": 0.3}, LOSSES, seed=0)
    toy, plain = Quadratics(), Quadratics()
    before, losses_before = toy.shared.detach().clone(), toy.forward().losses
    weighting = backward(method, [[toy.forward]], toy)
    assert torch.equal(toy.shared.detach(), before)  # bit by bit back where it was
    expected = {name: loss.item() for name, loss in losses_before.items()}
    assert weighting.losses == pytest.approx(expected)
    total = sum(plain.forward().losses.values())
    (mean,) = torch.autograd.grad(total, plain.shared)
    with torch.no_grad():
        plain.shared += 0.3 * mean / mean.norm()
    sum(plain.forward().losses.values()).backward()
    torch.testing.assert_close(toy.shared.grad, plain.shared.grad)
    for name, own in toy.own.items():
        torch.testing.assert_close(own.grad, plain.own[name].grad)


def test_samos_own_share_moves_up_the_losss_own_slope():
    method, toy = compose("samo", {"alpha": 0.0, "rho": 0.3}, LOSSES, seed=0), Quadratics()
    gradients = [torch.autograd.grad(loss, toy.shared)[0] for loss in toy.forward().losses.values()]
    start = toy.shared.detach().clone()

    def losses_at(shift):
        with torch.no_grad():
            toy.shared.copy_(start + shift[0])
            return torch.stack(list(toy.forward().losses.values()))

    shifts = method.shifts([sum(gradients)], losses_at, step_of(torch.ones(len(LOSSES))))
    for (shift,), gradient in zip(shifts, gradients, strict=True):
        assert shift.norm().item() == pytest.approx(0.3)
        assert shift @ gradient > 0


def test_samo_goes_around_another_method_and_works_in_parts():
    whole, halves = Quadratics(), Quadratics()
    for toy, parts in ((whole, 1), (halves, 2)):
        method = compose("samo+mgda", {"samo": {"alpha": 1.0}}, LOSSES, seed=0)
        weighting = backward(method, [[toy.forward] * parts], toy)
        assert sum(weighting.weights.values()) == pytest.approx(1)
    torch.testing.assert_close(whole.shared.grad, halves.shared.grad)


@pytest.mark.parametrize("name", ["samo+mgda_ub", "samo+modo"])
def test_samo_refuses_what_does_not_end_at_the_parameters(name):
    with pytest.raises(ValueError, match="SAMO"):
        composed(name)


@pytest.mark.parametrize("name", ["mgda+cr", "cr+fixed", "fixed+gls", "mgda+nash", "cr+fixed+mgda"])
def test_parts_in_another_order_are_refused(name):
    with pytest.raises(ValueError, match="is not a loss-value method"):
        composed(name)


@pytest.mark.parametrize("name", ["cr+modo", "cr+graddrop", "cr+auto_lambda"])
def test_a_wrapper_refuses_what_answers_with_more_than_weights(name):
    with pytest.raises(ValueError, match="goes around methods that weigh one batch, not"):
        composed(name)
