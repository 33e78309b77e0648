"""The network's sizes are the paper's, parameter by parameter, and its outputs fit the input."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from mtl_bench.core.config import Cell, Network, Recipe, load_recipe, recipe_names
from mtl_bench.core.device import initial_weights
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.model import build_model
from mtl_bench.model.layers import Decoder, GlobalContext, Head
from mtl_bench.tasks.depth.pose import PoseNetwork

PAPER = Cell(Recipe(), backbone="resnet18", method="fixed")
SMALL = Network(strides=(2, 4, 8), channels=8, fused=8, head=8, pose="light", pose_channels=8)
TINY = Cell(replace(Recipe(), network=SMALL), backbone="tiny", method="fixed")


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
    model = build_model(replace(PAPER, tasks=tasks), labels)
    assert inference_count(model) == expected
    assert count(model.net.backbone) == 11_176_512


def test_training_parameters_are_the_papers():
    model = build_model(PAPER, CITYSCAPES20)
    assert count(model) + 5 == 30_944_273  # five log-variances are the method's


def test_outputs_have_the_inputs_size():
    model = build_model(TINY, CITYSCAPES20).train()
    outputs = model.net(torch.rand(2, 3, 32, 64))
    assert outputs.semantic_BCHW.shape == (2, 20, 32, 64)
    assert outputs.center_B1HW.shape == (2, 1, 32, 64)
    assert outputs.offset_B2HW.shape == (2, 2, 32, 64)
    assert [depth.shape for depth in outputs.inverse_depth] == [(2, 1, 32, 64)] * 3
    assert outputs.center_B1HW.min() >= 0
    assert outputs.center_B1HW.max() <= 1
    assert outputs.inverse_depth[0].max() <= 1 / SMALL.min_depth
    model.eval()
    assert len(model.net(torch.rand(1, 3, 32, 64)).inverse_depth) == 1


def test_pyramid_of_the_paper_at_128x256():
    model = build_model(PAPER, CITYSCAPES20).eval()
    features = model.net.backbone(torch.rand(1, 3, 128, 256))
    assert {s: tuple(f.shape[1:]) for s, f in features.items()} == {
        8: (128, 16, 32),
        16: (256, 8, 16),
        32: (512, 4, 8),
    }


@pytest.mark.parametrize("tasks", [("panoptic",), ("depth",), ("panoptic", "depth")])
def test_every_parameter_is_either_shared_or_a_tasks(tasks):
    model = build_model(replace(TINY, tasks=tasks), CITYSCAPES20)
    shared = {id(p) for p in model.shared_parameters()}
    own = {id(p) for p in model.task_parameters()}
    assert not shared & own
    assert shared | own == {id(p) for p in model.parameters()}


def test_every_parameter_gets_a_gradient():
    model = build_model(TINY, CITYSCAPES20).train()
    image, context = torch.rand(2, 3, 32, 64), torch.rand(2, 2, 3, 32, 64)
    outputs = model.net(image)
    transforms = model.pose(image, context)
    assert transforms.shape == (2, 2, 4, 4)
    parts = [outputs.semantic_BCHW, outputs.center_B1HW, outputs.offset_B2HW, transforms]
    sum(part.square().sum() for part in [*parts, *outputs.inverse_depth]).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []


def test_poses_start_near_the_identity():
    model = build_model(TINY, CITYSCAPES20).eval()
    transforms = model.pose(torch.rand(2, 3, 32, 64), torch.rand(2, 2, 3, 32, 64))
    assert (transforms - torch.eye(4)).abs().max() < 0.05


def test_same_seed_same_weights_and_other_seed_others():
    def weights(seed):
        with initial_weights(seed):
            return torch.cat([p.flatten() for p in build_model(TINY, CITYSCAPES20).parameters()])

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))


def test_input_that_the_pyramid_does_not_divide():
    data = replace(Recipe().data, height=60, width=128)
    with pytest.raises(ValueError, match="60x128 is not divisible by the deepest stride 8"):
        build_model(replace(TINY, recipe=replace(TINY.recipe, data=data)), CITYSCAPES20)


def test_missing_weights_file():
    with pytest.raises(ValueError, match=r"no weights file 'nowhere\.pth'"):
        build_model(replace(PAPER, pretrained="nowhere.pth"), CITYSCAPES20)


def test_weights_file_is_loaded(tmp_path):
    import timm

    reference = timm.create_model("mnasnet_100", pretrained=False)
    path = tmp_path / "mnasnet.pth"
    torch.save(reference.state_dict(), path)
    cell = replace(PAPER, backbone="mnasnet", pretrained=str(path), tasks=("panoptic",))
    backbone = build_model(cell, CITYSCAPES20).net.backbone
    assert torch.equal(backbone.pyramid.conv_stem.weight, reference.conv_stem.weight)


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_builds(name):
    cell = Cell(load_recipe(name), backbone="resnet18", method="fixed")
    assert count(build_model(cell, CITYSCAPES20)) > 10_000


def test_the_cityscapes_recipe_is_the_papers_network():
    model = build_model(replace(PAPER, recipe=load_recipe("cityscapes")), CITYSCAPES20)
    assert inference_count(model) == 17_843_008
