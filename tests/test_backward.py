"""Losses and a method become gradients in one place; both kinds of method agree where they must."""

import pytest
import torch

from mtl_bench import plugins
from mtl_bench.backward import backward
from mtl_bench.check import TERMS, Quadratics
from mtl_bench.losses.terms import terms_of
from mtl_bench.method import GradientMethod, LossMethod


class Sum(LossMethod):
    def total(self, loss_T):
        return loss_T.sum()


class SumOfGradients(GradientMethod):
    def weights(self, G_TT, loss_T):
        return torch.ones_like(loss_T)


class Halved(GradientMethod):
    weighted_heads = True

    def weights(self, G_TT, loss_T):
        assert G_TT.dtype == torch.float64
        return torch.full_like(loss_T, 0.5)


def grads(method, scale=1.0):
    toy = Quadratics(TERMS)
    weighting = backward(method, toy.losses(), toy, scale)
    return toy.shared.grad, toy.own.grad, weighting


def test_a_gradient_method_with_unit_weights_is_the_sum():
    for one, other in zip(grads(Sum(TERMS))[:2], grads(SumOfGradients(TERMS))[:2], strict=True):
        torch.testing.assert_close(one, other)


def test_weighted_heads_follow_the_weights():
    shared, own, weighting = grads(Halved(TERMS))
    full_shared, full_own, _ = grads(SumOfGradients(TERMS))
    torch.testing.assert_close(shared, 0.5 * full_shared)
    torch.testing.assert_close(own, 0.5 * full_own)
    assert weighting.weight_T.tolist() == [0.5] * len(TERMS)


def test_weights_are_the_derivatives_of_the_total():
    method = plugins.load("methods", "fixed")(TERMS)
    assert grads(method)[2].weight_T.tolist() == pytest.approx([1, 200, 0.01, 1, 0.001])


@pytest.mark.parametrize("name", ["fixed", "uncertainty", "fixed_uncertainty"])
def test_loss_scale_multiplies_every_gradient_and_no_weight(name):
    method, scaled = (plugins.load("methods", name)(TERMS) for _ in range(2))
    shared, own, weighting = grads(method)
    shared_scaled, own_scaled, weighting_scaled = grads(scaled, 1024.0)
    torch.testing.assert_close(shared_scaled, 1024 * shared)
    torch.testing.assert_close(own_scaled, 1024 * own)
    torch.testing.assert_close(weighting_scaled.weight_T, weighting.weight_T)
    for parameter, other in zip(method.parameters(), scaled.parameters(), strict=True):
        torch.testing.assert_close(other.grad, 1024 * parameter.grad)


def test_overflow_reaches_the_scaler_and_not_the_method():
    class Never(GradientMethod):
        def direction(self, J_TP, loss_T):
            raise AssertionError("the method saw an overflow")

    toy = Quadratics(TERMS)
    losses = {name: loss * torch.inf for name, loss in toy.losses().items()}
    backward(Never(TERMS), losses, toy)
    assert not torch.isfinite(toy.shared.grad).all()


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
    assert method.total(WEIGHTED / fixed).item() == pytest.approx(expected, abs=1e-6)


def test_uncertainty_is_stationary_where_the_theory_says():
    """One term's optimum is exp(s) = 2 tau L, and it then contributes 1/2 (1 + s)."""
    method = plugins.load("methods", "uncertainty")(TERMS).double()
    loss_T = torch.tensor([0.7, 0.002, 3.0, 0.1, 0.05], dtype=torch.float64)
    with torch.no_grad():
        method.log_variance_T.copy_(torch.log(2 * method.tau_T * loss_T))
    method.total(loss_T).backward()
    torch.testing.assert_close(method.log_variance_T.grad, torch.zeros(5, dtype=torch.float64))


def test_state_is_tied_to_its_terms():
    method = plugins.load("methods", "uncertainty")
    with pytest.raises(ValueError, match="method state is for the terms"):
        method(terms_of(["panoptic"])).load_state_dict(method(terms_of(["depth"])).state_dict())
