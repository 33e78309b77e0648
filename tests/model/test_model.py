"""The network's sizes are the paper's, parameter by parameter, and its outputs fit the input."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, Network, Recipe, load_recipe, recipe_names
from mtl_bench.core.device import initial_weights
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.task import tasks_of
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.model import Model, build_model
from mtl_bench.model.layers import Decoder, GlobalContext, Head
from mtl_bench.tasks.depth.pose import PoseNetwork

PAPER = Cell(Recipe(), backbone="resnet18", method="fixed")
SMALL = Network(strides=(2, 4, 8), channels=8, fused=8, head=8, pose="light", pose_channels=8)
TINY = Cell(replace(Recipe(), network=SMALL), backbone="tiny", method="fixed")


def built(cell: Cell, labels: LabelSet = CITYSCAPES20) -> Model:
    return build_model(cell, tasks_of(cell.recipe, cell.tasks, labels))


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def inference_count(model) -> int:
    auxiliary = list(model.net.heads["depth"])[1:] if "depth" in model.net.heads else []
    return count(model.net) - sum(count(head) for head in auxiliary)


def test_parts_have_the_published_sizes():
    assert count(GlobalContext(512, 128)) == 65_792
    decoder = Decoder((128, 256, 512), 128, 256)
    assert count(decoder.arm_deep) == 606_720
    assert count(decoder.arm_middle) == 311_808
    assert count(decoder.refine_deep) == count(decoder.refine_middle) == 147_712
    assert count(decoder.fusion) == 197_120
    assert count(decoder) == 1_411_072
    sizes = [count(Head(256, 256, outputs)) for outputs in (20, 19, 1, 2)]
    assert sizes == [595_456, 595_200, 590_592, 590_848]
    assert count(Head(128, 256, 1)) == 295_680
    pose = PoseNetwork()
    assert (count(pose.encoder), count(pose.decoder)) == (11_195_328, 1_314_572)


@pytest.mark.parametrize(
    ("labels", "tasks", "expected"),
    [
        (CITYSCAPES20, ("panoptic", "depth"), 17_843_008),
        (CITYSCAPES19, ("panoptic", "depth"), 17_842_752),
        (CITYSCAPES20, ("panoptic",), 15_841_344),
    ],
)
def test_inference_parameters_are_the_papers(labels, tasks, expected):
    model = built(replace(PAPER, tasks=tasks), labels)
    assert inference_count(model) == expected
    assert count(model.net.backbone) == 11_176_512


def test_training_parameters_are_the_papers():
    model = built(PAPER)
    assert count(model) + 5 == 30_944_273  # five log-variances are the method's


def test_outputs_have_the_inputs_size():
    model = built(TINY).train()
    maps = model.net(torch.rand(2, 3, 32, 64)).maps
    assert list(maps) == ["panoptic", "depth"]
    panoptic, depth = maps["panoptic"], maps["depth"]
    assert panoptic["semantic"].shape == (2, 20, 32, 64)
    assert panoptic["center"].shape == (2, 1, 32, 64)
    assert panoptic["offset"].shape == (2, 2, 32, 64)
    assert {name: inverse.shape for name, inverse in depth.items()} == dict.fromkeys(
        ("inverse", "inverse.1", "inverse.2"), (2, 1, 32, 64)
    )
    assert panoptic["center"].min() >= 0
    assert panoptic["center"].max() <= 1
    assert depth["inverse"].max() <= 1 / SMALL.min_depth
    model.eval()
    assert list(model.net(torch.rand(1, 3, 32, 64)).maps["depth"]) == ["inverse"]


def test_pyramid_of_the_paper_at_128x256():
    model = built(PAPER).eval()
    features = model.net.backbone(torch.rand(1, 3, 128, 256))
    assert {s: tuple(f.shape[1:]) for s, f in features.items()} == {
        8: (128, 16, 32),
        16: (256, 8, 16),
        32: (512, 4, 8),
    }


@pytest.mark.parametrize("tasks", [("panoptic",), ("depth",), ("panoptic", "depth")])
def test_every_parameter_is_either_shared_or_a_tasks(tasks):
    model = built(replace(TINY, tasks=tasks))
    shared = {id(p) for p in model.shared_parameters()}
    own = {id(p) for p in model.task_parameters()}
    assert not shared & own
    assert shared | own == {id(p) for p in model.parameters()}


def test_every_parameter_gets_a_gradient():
    model = built(TINY).train()
    neighbours = {"neighbours": torch.rand(2, 2, 3, 32, 64)}
    outputs = model(Batch(["a", "b"], torch.rand(2, 3, 32, 64), fields=neighbours))
    assert outputs.maps["depth"]["transforms"].shape == (2, 2, 4, 4)
    parts = [map_ for own in outputs.maps.values() for map_ in own.values()]
    assert len(parts) == 3 + 3 + 1
    sum(part.square().sum() for part in parts).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []


def test_poses_start_near_the_identity():
    model = built(TINY).eval()
    transforms = model.pose(torch.rand(2, 3, 32, 64), torch.rand(2, 2, 3, 32, 64))
    assert (transforms - torch.eye(4)).abs().max() < 0.05


def test_same_seed_same_weights_and_other_seed_others():
    def weights(seed):
        with initial_weights(seed):
            return torch.cat([p.flatten() for p in built(TINY).parameters()])

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))


def test_input_that_the_pyramid_does_not_divide():
    data = replace(Recipe().data, height=60, width=128)
    with pytest.raises(ValueError, match="60x128 is not divisible by the deepest stride 8"):
        built(replace(TINY, recipe=replace(TINY.recipe, data=data)))


def test_missing_weights_file():
    with pytest.raises(ValueError, match=r"no weights file 'nowhere\.pth'"):
        built(replace(PAPER, pretrained="nowhere.pth"))


def test_weights_file_is_loaded(tmp_path):
    import timm

    reference = timm.create_model("mnasnet_100", pretrained=False)
    path = tmp_path / "mnasnet.pth"
    torch.save(reference.state_dict(), path)
    cell = replace(PAPER, backbone="mnasnet", pretrained=str(path), tasks=("panoptic",))
    backbone = built(cell).net.backbone
    assert torch.equal(backbone.pyramid.conv_stem.weight, reference.conv_stem.weight)


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_builds(name):
    recipe = load_recipe(name)
    assert count(built(Cell(recipe, recipe.backbone or "resnet18", "fixed"))) > 1_000


def test_the_cityscapes_recipe_is_the_papers_network():
    model = built(replace(PAPER, recipe=load_recipe("cityscapes")))
    assert inference_count(model) == 17_843_008
