"""Backbones that give one vector, and the tasks that read it."""

import pytest
import torch

from mtl_bench.core.config import Cell, load_recipe, override
from mtl_bench.core.plugins import load
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.model import build_model


def built(recipe: str, backbone: str = "", settings=(), tasks=()):
    found = load_recipe(recipe)
    cell = override(Cell(found, backbone or found.backbone, "fixed", tasks), settings)
    return build_model(cell, tasks_of_cell(cell))


def millions(modules) -> float:
    return sum(p.numel() for p in modules) / 1e6


def test_celebas_network_has_the_published_size():
    model = built("celeba-cnn9")
    assert millions(model.shared_parameters()) == pytest.approx(5.177, abs=5e-4)
    assert millions(model.parameters()) == pytest.approx(5.20, abs=5e-3)
    assert len(model.net.heads) == 40


def test_lenet_reads_as_many_numbers_as_on_mnist():
    linear = built("digits").net.backbone.layers[-2]
    assert (linear.in_features, linear.out_features) == (320, 50)


def test_the_recipe_says_how_wide_the_trunk_is():
    model = built("conflict", settings=["recipe.network.channels=3"])
    assert model.net.backbone.channels == {0: 3}
    assert {head.in_features for head in model.net.heads.values()} == {3}


@pytest.mark.parametrize("backbone", ["mlp", "lenet", "cnn9"])
def test_each_loss_has_a_gradient_in_the_trunk_through_the_vector(backbone):
    model = built("digits", backbone).train()
    outputs = model.net(torch.rand(4, 3, 16, 16))
    (vector,) = outputs.representation
    assert vector.shape == (4, 50, 1, 1)
    assert {
        task: {n: tuple(m.shape) for n, m in maps.items()} for task, maps in outputs.maps.items()
    } == {
        "classify:left": {"logits": (4, 10)},
        "reconstruct:right_picture": {"grey": (4, 1, 16, 16)},
    }
    for maps in outputs.maps.values():
        (gradient,) = torch.autograd.grad(
            next(iter(maps.values())).sum(), vector, retain_graph=True
        )
        assert gradient.abs().sum() > 0


def test_tasks_of_the_whole_image_read_the_context_of_a_pyramid():
    model = built("digits", "tiny", ["recipe.network.strides=[2, 4, 8]"]).train()
    maps = model.net(torch.rand(2, 3, 16, 16)).maps
    assert maps["classify:left"]["logits"].shape == (2, 10)


def test_a_task_that_reads_maps():
    with pytest.raises(
        ValueError, match="task 'panoptic' reads maps, and backbone 'mlp' gives one"
    ):
        built("small", "mlp", tasks=("panoptic",))


def test_there_are_no_weights_to_begin_with():
    for name in ("mlp", "lenet", "cnn9"):
        with pytest.raises(ValueError, match="no pre-trained weights for this: 'timm'"):
            load("backbones", name)(pretrained="timm")
