"""The published dense networks: parameters, maps, and what does not fit together in a line."""

from dataclasses import replace

import pytest
import torch

from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.recipe import Optim
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.model import build_model
from mtl_bench.train.loop import schedule


def model_of(recipe, backbone, **network):
    recipe = load_recipe(recipe)
    recipe = replace(recipe, network=replace(recipe.network, **network))
    cell = Cell(recipe, backbone, "fixed")
    return build_model(cell, tasks_of_cell(cell))


@pytest.mark.parametrize(
    ("recipe", "backbone", "trunk", "all_of_it"),
    [
        ("nyuv2-segnet", "segnet", 24_943_296, 25_055_185),
        ("nyuv2-deeplab", "deeplab_resnet50", 23_508_032, 71_888_721),
        ("cityscapes2-segnet", "segnet", 24_943_296, 25_017_672),
        ("cityscapes2-deeplab", "deeplab_resnet50", 23_508_032, 55_760_968),
    ],
)
def test_parameters_are_the_published_ones(recipe, backbone, trunk, all_of_it):
    with torch.device("meta"):
        model = model_of(recipe, backbone)
    assert sum(p.numel() for p in model.net.backbone.parameters()) == trunk
    assert sum(p.numel() for p in model.parameters()) == all_of_it


@pytest.mark.parametrize(
    ("recipe", "backbone"), [("nyuv2-segnet", "segnet"), ("nyuv2-deeplab", "deeplab_resnet50")]
)
def test_maps_have_the_size_of_the_input_and_every_parameter_trains(recipe, backbone):
    model = model_of(recipe, backbone).train()
    outputs = model.net(torch.rand(2, 3, 32, 64))
    shapes = {name: tuple(maps[name].shape) for name, maps in outputs.maps.items()}
    assert shapes == {
        "semantic": (2, 13, 32, 64),
        "depth_supervised": (2, 1, 32, 64),
        "normals": (2, 3, 32, 64),
    }
    assert len(outputs.representation) == 1
    sum(maps[name].square().mean() for name, maps in outputs.maps.items()).backward()
    assert all(parameter.grad is not None for parameter in model.parameters())
    assert model.net.context is None


def test_what_does_not_fit_together_is_one_line():
    with pytest.raises(ValueError, match=r"backbone 'segnet' has no features at stride 4"):
        model_of("dense-smoke", "segnet", strides=(4,))
    with pytest.raises(ValueError, match=r"'mgnet' reads three levels, and network.strides has 1"):
        model_of("dense-smoke", "segnet", strides=(1,))
    with pytest.raises(ValueError, match="'decoder' must be mgnet or aspp or none, not 'asp'"):
        model_of("dense-smoke", "tiny", decoder="asp")
    with pytest.raises(ValueError, match=r"but task 'panoptic' has decoders of its own: set it to"):
        model_of("smoke", "tiny", decoder="aspp")
    recipe = load_recipe("nyuv2-segnet")
    cell = Cell(replace(recipe, data=replace(recipe.data, width=400)), "segnet", "fixed")
    with pytest.raises(ValueError, match=r"288x400 is not divisible by the deepest stride 32"):
        build_model(cell, tasks_of_cell(cell))


def test_the_rate_halves_at_a_milestone():
    optim = Optim(steps=10, warmup_steps=0, poly_power=0.0, milestones=(4, 8))
    assert [schedule(step, optim) for step in range(10)] == [1.0] * 4 + [0.5] * 4 + [0.25] * 2
