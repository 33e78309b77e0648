"""Batch norms can keep the means of many batches' statistics in place of running ones."""

import copy

import pytest
import torch
from support.ranks import network_cell
from support.training import run
from torch import nn
from torch.optim.swa_utils import update_bn

from mtl_bench.bench.check.side_by_side import side_by_side
from mtl_bench.core.ranks import ALONE
from mtl_bench.train import checkpoint
from mtl_bench.train.progress import Interrupted, Progress
from mtl_bench.train.statistics import mean_statistics


def parts(number):
    draw = torch.Generator().manual_seed(0)
    return torch.randn(number, 8, 3, generator=draw).double() + torch.arange(3) * number


def norms():
    torch.manual_seed(0)
    net = nn.Sequential(nn.BatchNorm1d(3, momentum=0.3), nn.Linear(3, 3), nn.BatchNorm1d(3))
    net = net.double()
    for part in parts(4):
        net(9 * part)  # what they remember of earlier
    return net


def test_they_are_what_torch_makes_of_all_batches():
    found, expected = norms(), norms()
    with torch.no_grad(), mean_statistics(found, ALONE):
        for part in parts(5):
            found(part)
    update_bn(parts(5), expected)
    torch.testing.assert_close(found.state_dict(), expected.state_dict(), atol=0, rtol=0)
    assert [found[0].momentum, found[2].momentum] == [0.3, 0.1]
    assert int(found[0].num_batches_tracked) == 5


def test_all_ranks_have_those_of_all_parts():
    built = norms()  # here, as ranks are threads, which draw from one generator

    def seen(ranks):
        net = copy.deepcopy(built)
        with torch.no_grad(), mean_statistics(net, ranks):
            for part in parts(6).chunk(ranks.size)[ranks.rank]:
                net(part)
        return net.state_dict()

    expected = seen(ALONE)
    for found in side_by_side(3, seen):
        torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-12)


def test_a_frozen_norm_keeps_its_own():
    net, before = norms(), norms()
    net[2].eval()
    with torch.no_grad(), mean_statistics(net, ALONE):
        net(parts(1)[0])
    assert torch.equal(net[2].running_mean, before[2].running_mean)
    assert not torch.equal(net[0].running_mean, before[0].running_mean)


def weights(run_dir):
    return checkpoint.read(run_dir / "last.pt")["model"]


@pytest.mark.parametrize("dtype", ["fp32", "bf16"])
def test_nothing_but_statistics_changes(dtype, smoke_root, tmp_path):
    settings = f"recipe.optim.precision={dtype}", "recipe.optim.micro_batch=none"
    cell = network_cell("fixed", *settings)
    run(cell, smoke_root, tmp_path / "running")
    cell = network_cell("fixed", *settings, "recipe.optim.statistics_batches=4")
    run(cell, smoke_root, tmp_path / "means")
    running, means = weights(tmp_path / "running"), weights(tmp_path / "means")
    assert running.keys() == means.keys()
    moved = {key for key in means if not torch.equal(means[key], running[key])}
    kinds = ("running_mean", "running_var", "num_batches_tracked")
    assert moved == {key for key in means if key.endswith(kinds)}


def test_it_survives_an_interruption(smoke_root, tmp_path):
    cell = network_cell("fixed", "recipe.optim.statistics_batches=3")
    run(cell, smoke_root, tmp_path / "straight")

    class Asked(Progress):
        def update(self, stage, step, steps, note=""):
            self.stop_asked = stage == "train" and step == 2

    with pytest.raises(Interrupted):
        run(cell, smoke_root, tmp_path / "run", Asked(tmp_path, lambda line: None))
    run(cell, smoke_root, tmp_path / "run")
    torch.testing.assert_close(
        weights(tmp_path / "run"), weights(tmp_path / "straight"), atol=0, rtol=0
    )
