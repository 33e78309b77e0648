"""Pre-trained weights are the model's own or nothing; any pyramid of timm is four lines."""

import pytest
import timm
import torch
from safetensors.torch import save_file
from torch import nn

from mtl_bench.bench.check.backbones import BACKBONE_CHECKS
from mtl_bench.core.backbone import TimmBackbone


def named(timm_name):
    return type("Named", (TimmBackbone,), {"timm_name": timm_name})


@pytest.fixture(scope="module")
def resnet():
    torch.manual_seed(1)
    return timm.create_model("resnet18").state_dict()


def loaded(state, path, name="resnet18"):
    torch.save(state, path)
    return named(name)(pretrained=str(path)).pyramid.state_dict()


def prefixed(state, prefix):
    return {f"{prefix}{name}": value for name, value in state.items()}


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state,
        lambda state: {"state_dict": prefixed(state, "module.")},
        lambda state: prefixed(state, "backbone."),
        lambda state: {"model": prefixed(state, "net.backbone.pyramid."), "epoch": 3},
        lambda state: prefixed(state, "backbone.") | {"decode_head.conv.weight": torch.ones(3)},
        lambda state: {k: v for k, v in state.items() if not k.startswith("fc.")},
        lambda state: {k: v for k, v in state.items() if "num_batches" not in k},
        lambda state: {k: v.half() for k, v in state.items()},
    ],
    ids=["bare", "module", "backbone", "ours", "with a head", "headless", "no counters", "half"],
)
def test_weights_are_found_under_what_scripts_put_before_them(change, resnet, tmp_path):
    found = loaded(change(resnet), tmp_path / "weights.pth")
    for name in ("conv1.weight", "layer4.1.bn2.running_var", "layer4.1.conv2.weight"):
        torch.testing.assert_close(found[name], resnet[name], rtol=1e-3, atol=1e-3)


def test_a_safetensors_file_is_read(resnet, tmp_path):
    save_file(resnet, tmp_path / "weights.safetensors")
    found = named("resnet18")(pretrained=str(tmp_path / "weights.safetensors")).pyramid.state_dict()
    assert all(torch.equal(value, resnet[name]) for name, value in found.items())


def test_a_pyramid_of_other_names_gets_every_weight(tmp_path):
    """Levels that stand in a pyramid are named stages_0, not stages.0."""
    torch.manual_seed(1)
    whole = timm.create_model("convnext_atto").state_dict()
    found = loaded(prefixed(whole, "encoder."), tmp_path / "weights.pth", "convnext_atto")
    flat = {name.replace(".", "_"): value for name, value in whole.items()}
    assert all(torch.equal(v, flat[name.replace(".", "_")]) for name, v in found.items())


def cut(state, start):
    return {name: value for name, value in state.items() if not name.startswith(start)}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda state: {}, "holds no weights"),
        (lambda state: {"epoch": 3, "loss": [1.0]}, "holds no weights"),
        (lambda state: [torch.ones(3)], "cannot be read as weights"),
        (lambda state: cut(state, "layer2.0.conv1"), "lacks 1 of the 100 weights"),
        (lambda state: cut(state, ""), "holds no weights"),
        (lambda state: {"a": torch.ones(1)}, "lacks 100 of the 100 weights of this model, 'conv1"),
        (lambda state: timm.create_model("resnet34").state_dict(), "has 'layer1.2.conv1.weight'"),
        (lambda state: timm.create_model("resnet50").state_dict(), "has 'layer1.0.conv3.weight'"),
        (lambda state: state | {"conv1.weight": torch.ones(64, 1, 7, 7)}, r"shape \(64, 1, 7, 7\)"),
        (lambda state: prefixed(state, "a.") | prefixed(state, "b."), "holds two models, 'a.'"),
        (lambda state: {"a": nn.Linear(1, 1)}, "cannot be read as weights"),  # code, not tensors
    ],
)
def test_weights_that_are_not_the_models_are_one_line(make, words, resnet, tmp_path):
    with pytest.raises(ValueError, match=words) as error:
        loaded(make(resnet), tmp_path / "weights.pth")
    assert "\n" not in str(error.value)
    assert "weights_only=False" not in str(error.value)
    assert str(tmp_path / "weights.pth") in str(error.value)


@pytest.mark.parametrize(
    "content", [b"", b"e", b"\x80\x02junk", b"PK\x03\x04", b"\x89PNG\r\n" * 99]
)
@pytest.mark.parametrize("name", ["weights.pth", "weights.safetensors"])
def test_foreign_files_are_one_line(content, name, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read as weights") as error:
        named("mnasnet_small")(pretrained=str(tmp_path / name))
    assert "\n" not in str(error.value)


def test_weights_change_nothing_that_is_drawn_after_them(resnet, tmp_path):
    torch.save(resnet, tmp_path / "weights.pth")

    def drawn(pretrained):
        torch.manual_seed(3)
        named("resnet18")(pretrained=pretrained)
        return torch.rand(3)

    assert torch.equal(drawn(None), drawn(str(tmp_path / "weights.pth")))


# --- any pyramid of timm --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        *("convnext_atto", "swin_tiny_patch4_window7_224", "poolformer_s12", "fastvit_t8"),
        pytest.param("vgg11", marks=pytest.mark.slow),  # whose classifier takes seconds to draw
    ],
)
def test_pyramids_that_begin_at_another_stride(name):
    backbone = named(name)(strides=(8, 16, 32)).eval()
    with torch.no_grad():
        found = backbone(torch.rand(1, 3, 64, 96))
    for stride in (8, 16, 32):
        assert found[stride].shape == (1, backbone.channels[stride], 64 // stride, 96 // stride)


def test_a_pyramid_builds_no_stage_that_nobody_reads():
    small = named("efficientvit_b0")(strides=(4, 8))
    assert set(small.channels) == {4, 8}
    whole = named("efficientvit_b0")(strides=(8, 16, 32))
    assert len(list(small.parameters())) < len(list(whole.parameters()))


def test_a_pyramid_that_begins_at_stride_4_passes_the_check():
    for check in BACKBONE_CHECKS.values():
        check(named("convnext_atto"))


def test_a_frozen_backbone_passes_the_check():
    class Frozen(named("efficientvit_b0")):
        def __init__(self, *given, **options):
            super().__init__(*given, **options)
            self.requires_grad_(False)

    BACKBONE_CHECKS["every parameter trains"](Frozen)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("vit_tiny_patch16_224", "has features at the strides 16, none at 8, 32"),
        ("efficientvit_m0", "has features at the strides 16, 32, 64, none at 8"),
        ("resnet19", "timm's 'resnet19'"),
        ("mixer_s16_224", "none at 8, 32|timm's 'mixer_s16_224'"),
    ],
)
def test_what_a_model_lacks_is_one_line(name, words):
    with pytest.raises(ValueError, match=words) as error:
        named(name)()
    assert "\n" not in str(error.value)


def test_a_model_that_timm_has_no_weights_for_is_one_line():
    with pytest.raises(ValueError, match="timm has no weights for resnetblur18"):
        named("resnetblur18")(pretrained="timm")
