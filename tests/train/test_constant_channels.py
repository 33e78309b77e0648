"""A channel that training saw as constant stays so, whatever an image brings."""

from dataclasses import replace

import torch
from support.training import run
from torch import nn

from mtl_bench.train import checkpoint
from mtl_bench.train.progress import Progress
from mtl_bench.train.statistics import silence_constants


def trained(x_BCHW):
    """A norm that has seen one batch for long."""
    torch.manual_seed(0)
    norm = nn.BatchNorm2d(3)
    with torch.no_grad():
        norm.bias.uniform_()
    for _ in range(300):
        norm(x_BCHW)
    return norm


def test_a_constant_channel_is_silenced_and_no_other():
    x = torch.randn(4, 3, 5, 5)
    x[:, 1] = 0.7
    x[:, 2] *= 1e-4  # small, but no constant
    norm = trained(x)
    before = norm.eval()(x)
    assert silence_constants(norm.train()) == 1
    torch.testing.assert_close(norm.eval()(x), before, rtol=0, atol=1e-3)
    assert norm.weight.tolist() == [1, 0, 1]


def test_an_image_that_wakes_it_drowns_nothing():
    x = torch.randn(4, 3, 5, 5)
    x[:, 1] = 0
    norm, woken = trained(x), torch.full((1, 3, 5, 5), 0.5)
    assert norm.eval()(woken)[:, 1].max() > 100
    silence_constants(norm.train())
    assert torch.equal(norm.eval()(woken)[0, 1], norm.bias[1].expand(5, 5))


def test_what_is_frozen_stays():
    norm = trained(torch.zeros(4, 3, 5, 5)).eval()
    assert silence_constants(norm) == 0
    assert norm.weight.tolist() == [1, 1, 1]


def test_the_last_checkpoint_has_it(smoke_cell, smoke_root, with_optim, tmp_path):
    """A dead channel of the decoders: its convolution's weights are 0, and do not learn."""
    sizes = replace(smoke_cell.recipe.network, batch_norm_momentum=1.0)
    cell = replace(smoke_cell, recipe=replace(smoke_cell.recipe, network=sizes))
    name = "decoders.depth.fusion.conv"

    def kill(model):
        convolution = model.net.get_submodule(name)[0]
        with torch.no_grad():
            convolution.weight[0] = 0
        convolution.weight.requires_grad_(False)

    said = []
    progress = Progress(tmp_path, said.append)
    run(with_optim(cell, steps=2), smoke_root, tmp_path / "run", progress, rehearse=kill)
    assert said[-1].endswith("stay so: 1")
    weights = checkpoint.read(tmp_path / "run" / "last.pt")["model"][f"net.{name}.1.weight"]
    assert weights[0] == 0
    assert (weights[1:] != 0).all()
