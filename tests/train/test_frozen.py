"""What is frozen needs no gradient: every kind of method trains the rest."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from support.terms import TERMS
from support.training import curve, run
from torch import nn

from mtl_bench.core import plugins
from mtl_bench.train.backward import Pass, backward
from mtl_bench.train.loop import build_method

KINDS = ["mgda", "mgda_ub", "moco", "modo", "auto_lambda", "fixed_uncertainty+pcgrad", "fixed"]


class Stages(nn.Module):
    """Two stages that two decoders read, and of the second a context as the network has."""

    def __init__(self, frozen):
        super().__init__()
        torch.manual_seed(0)
        self.stages = nn.ModuleList([nn.Linear(4, 6), nn.Linear(6, 6)])
        self.context = nn.Linear(6, 6)
        self.decoders = nn.ModuleList([nn.Linear(6, 3), nn.Linear(6, 2)])
        for index in frozen:
            self.stages[index].requires_grad_(False)

    def shared_parameters(self):
        return [*self.stages.parameters(), *self.context.parameters()]

    def task_parameters(self):
        return self.decoders.parameters()

    def forward(self, x):
        first = self.stages[0](x).tanh()
        second = self.stages[1](first).tanh()
        z = [value.view_as(value) for value in (first, second, self.context(second))]
        one, other = (decoder(sum(z)) for decoder in self.decoders)
        values = [one.square().mean(), one[:, 0].abs().mean(), one[:, 1].exp().mean()]
        values += [other.square().mean(), other.tanh().mean() + 1]
        return Pass(dict(zip([term.name for term in TERMS], values, strict=True)), z)


@pytest.mark.parametrize("frozen", [(0,), (1,), (0, 1)])
@pytest.mark.parametrize("name", KINDS)
def test_a_method_trains_what_is_not_frozen(name, frozen, smoke_cell):
    net = Stages(frozen)
    method = build_method(replace(smoke_cell, method=name), TERMS)
    batches = [[partial(net, torch.randn(12, 4))] for _ in range(method.batches)]
    weighting = backward(method, batches, net, lr=0.1, cosines=True)
    assert len(weighting.cosines) == 10
    for parameter in net.parameters():
        assert (parameter.grad is not None) == parameter.requires_grad


@pytest.mark.parametrize("stages", [1, 5])
def test_a_frozen_backbone_trains(
    stages, monkeypatch, smoke_cell, smoke_root, tmp_path, with_optim
):
    kind = plugins.load("backbones", "tiny")
    real = kind.__init__

    def frozen(self, *given, **options):
        real(self, *given, **options)
        for stage in self.stages[:stages]:
            stage.requires_grad_(False)

    monkeypatch.setattr(kind, "__init__", frozen)
    cell = with_optim(replace(smoke_cell, method="mgda"), steps=2, cosine_every=1)
    run(cell, smoke_root, tmp_path / "run")
    assert len(curve(tmp_path / "run")) == 2
