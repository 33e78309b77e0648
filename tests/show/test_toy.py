"""The two-dimensional toy: its losses, that methods are asked as in training, and its pictures."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import plugins
from mtl_bench.core.method import LossMethod
from mtl_bench.show import toy
from mtl_bench.train.backward import Pass, backward
from mtl_bench.train.compose import compose

METHODS = sorted(plugins.files("methods"))


def in_torch(x, y):
    """The published formulas, scaled and bounded."""
    zero = torch.zeros(())
    c1 = torch.maximum(torch.tanh(y / 2), zero)
    c2 = torch.maximum(torch.tanh(-y / 2), zero)
    f1 = torch.log(torch.clamp(((-x - 7) / 2 - torch.tanh(-y)).abs(), min=5e-6)) + 6
    f2 = torch.log(torch.clamp(((-x + 3) / 2 + torch.tanh(-y) + 2).abs(), min=5e-6)) + 6
    g1 = ((-x + 7) ** 2 + 0.1 * (-y - 8) ** 2) / 10 - 20
    g2 = ((-x - 7) ** 2 + 0.1 * (-y - 8) ** 2) / 10 - 20
    return 0.1 * (c1 * f1 + c2 * g1) + 2.1, c1 * f2 + c2 * g2 + 21


class Network(nn.Module):
    """The toy as something to train."""

    def __init__(self, x, y):
        super().__init__()
        self.point = nn.Parameter(torch.tensor([x, y]))

    def shared_parameters(self):
        yield self.point

    def task_parameters(self):
        return iter(())

    def forward(self):
        read = self.point.view_as(self.point)
        l1, l2 = in_torch(read[0], read[1])
        return Pass({"l1": l1, "l2": l2}, [read])


@pytest.mark.parametrize("here", [*toy.STARTS, (3.1, -4.0), (-2.0, 0.3), (5.0, -8.3)])
def test_losses_and_derivatives_are_the_published_ones(here):
    point = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in here]
    for ours, theirs in zip(toy.losses(*here), in_torch(*point), strict=True):
        grads = torch.autograd.grad(theirs, point, retain_graph=True)
        assert ours == pytest.approx((theirs.item(), *(g.item() for g in grads)), abs=1e-12)


def test_the_pareto_set_is_one():
    """On it the gradients point against each other, beside it they do not."""
    for x in np.linspace(-6.5, 6.5, 7):
        (_, x1, y1), (_, x2, y2) = toy.losses(x, toy.PARETO_Y)
        cosine = (x1 * x2 + y1 * y2) / math.hypot(x1, y1) / math.hypot(x2, y2)
        assert cosine < -0.999
        assert toy.distance(x, toy.PARETO_Y) == 0
    assert toy.distance(10, toy.PARETO_Y + 4) == pytest.approx(5)
    sums = [sum(loss[0] for loss in toy.losses(x, toy.PARETO_Y)) for x in np.linspace(-7, 7, 1401)]
    assert np.linspace(-7, 7, 1401)[np.argmin(sums)] == pytest.approx(toy.SUM_X, abs=0.01)


@pytest.mark.parametrize("name", [*METHODS, "uncertainty+mgda"])
def test_a_method_is_asked_as_in_training(name):
    ours, theirs = (compose(name, {}, toy.TERMS, seed=3) for _ in range(2))
    here, network = (9.0, -1.0), Network(9.0, -1.0)
    _, direction = toy._asked(ours, here, 0.1)
    parts = [[network.forward]] * theirs.batches
    backward(theirs, parts, network, lr=0.1)
    expected = tuple(network.point.grad.tolist())
    assert direction == pytest.approx(expected, rel=2e-3, abs=1e-5)
    if isinstance(ours, LossMethod):
        for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(mine.grad, other.grad, rtol=1e-3, atol=1e-5)


def test_a_walk_is_adams():
    found = toy.walk(compose("fixed", {}, toy.TERMS, seed=0), (9.0, 9.0), 0.1, 30)
    point = torch.tensor([9.0, 9.0], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([point], lr=0.1)
    for expected in found.points_N2[1:]:
        optimizer.zero_grad()
        sum(in_torch(*point)).backward()
        optimizer.step()
        np.testing.assert_allclose(point.detach(), expected, rtol=1e-4)
    assert found.reached is None
    assert len(found.points_N2) == 31


def test_a_walk_ends_where_the_set_is_reached():
    found = toy.walk(compose("fixed", {}, toy.TERMS, seed=0), (-5.0, -8.0), 0.05, 500)
    inside = [toy.distance(*point) <= toy.NEAR for point in found.points_N2]
    assert inside.index(True) <= found.reached == len(inside) - toy.STAY
    assert all(inside[found.reached :])


# --- the command ----------------------------------------------------------------------------------


def figure(*words):
    return CliRunner().invoke(app, ["figure", "toy", *map(str, words)])


def test_both_pictures_are_drawn(tmp_path):
    out = tmp_path / "toy.png"
    options = ["--lrs", "0.05,0.2", "--steps", 100, "--jobs", 1, "--dpi", 60]
    done = figure("--methods", "fixed,uncertainty+mgda", "--out", out, *options)
    assert done.exit_code == 0, done.output
    assert done.stdout.split() == [str(out), str(tmp_path / "toy-steps.png")]
    assert done.stderr.split() == ["fixed", "uncertainty+mgda"]
    for path in map(tmp_path.joinpath, ("toy.png", "toy-steps.png")):
        assert len(Image.open(path).convert("RGB").getcolors(1 << 20)) > 20


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--methods", "fixd"], "no method called 'fixd' (did you mean 'fixed'?)"),
        (["--methods", ","], "--methods names no method"),
        (["--methods", "fixed", "--lr", 0.3], "--lr 0.3 is not one of --lrs"),
        (["--methods", "fixed", "--lrs", "0.1,x"], "--lrs: 'x' is no learning rate above 0"),
        (["--methods", "mgda+fixed"], "is not a loss-value method + a gradient method"),
    ],
)
def test_what_it_cannot_do_is_one_line(tmp_path, words, said):
    done = figure(*words, "--out", tmp_path / "a.png", "--jobs", 1)
    assert done.exit_code != 0
    assert said in " ".join(done.output.split())
    assert not list(tmp_path.iterdir())
