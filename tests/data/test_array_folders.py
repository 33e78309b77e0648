"""NYUv2's and Cityscapes' arrays: splits, what is read, what is refused in a line, `data check`."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Generator
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core.config import load_recipe
from mtl_bench.core.dataset import dataset_in
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.recipe import Augment, Data
from mtl_bench.data._array_folders import validation
from mtl_bench.data.cityscapes_mtan import CityscapesMtan
from mtl_bench.data.nyuv2 import Nyuv2
from mtl_bench.data.samples import Samples

H, W, TRAIN, VAL = 24, 32, 10, 3
DATA = Data(dataset="nyuv2", height=H, width=W)


def write(root, kind, dtype=np.float64, labels=None):
    """A tree as it is distributed: float64, label -1 = none, depth 0 = none, zeros = no normal."""
    rng = np.random.default_rng(0)
    classes = labels or len(kind.labels)
    for split, count in (("train", TRAIN), ("val", VAL)):
        for number in range(count):
            label = rng.integers(-1, classes, (H, W))
            label[0, 0] = classes - 1
            normal = rng.normal(size=(H, W, 3))
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            normal[0] = 0
            depth = rng.uniform(0, 0.4, (H, W, 1))
            depth[0] = 0
            arrays = {"image": rng.random((H, W, 3)), "depth": depth}
            if kind is Nyuv2:
                arrays |= {"label": label, "normal": normal, "depth": 20 * depth}
            else:
                arrays |= {"label_7": label, "label_19": label}
            for name, array in arrays.items():
                path = root / split / name / f"{number}.npy"
                path.parent.mkdir(parents=True, exist_ok=True)
                np.save(path, array.astype(dtype))
    return root


@pytest.fixture(scope="module")
def trees(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arrays")
    return {kind: write(folder / kind.__name__, kind) for kind in (Nyuv2, CityscapesMtan)}


KINDS = pytest.mark.parametrize("kind", [Nyuv2, CityscapesMtan])


@KINDS
def test_a_folder_is_recognised_as_one_data_set_alone(trees, kind):
    assert dataset_in(trees[kind]) is kind


@KINDS
def test_validation_is_a_fifth_of_train_and_always_the_same(trees, kind):
    root = trees[kind]
    train, val, test = (kind(root, split, DATA) for split in ("train", "val", "test"))
    assert len(train) == 8
    assert len(val) == 2
    assert len(test) == VAL
    assert sorted([*train.names, *val.names]) == sorted(map(str, range(TRAIN)))
    assert val.names == kind(root, "val", DATA).names
    everything = replace(DATA, train_frames="all")
    assert len(kind(root, "train", everything)) == TRAIN
    with pytest.raises(ValueError, match=r"leaves no frame for validation"):
        kind(root, "val", everything)


def test_the_published_counts():
    for total, held_out in ((795, 159), (2975, 595)):
        assert len(validation([str(n) for n in range(total)])) == held_out


@KINDS
def test_what_is_read_is_what_is_in_the_files(trees, kind):
    dataset = kind(trees[kind], "test", DATA, needs=kind.fields)
    frame = dataset.read("1")
    folder = trees[kind] / "val"

    def stored(name):
        return np.load(folder / name / "1.npy")

    image = frame.images_N3HW[0].permute(1, 2, 0).numpy()
    assert np.abs(image / 255 - stored("image")).max() <= 0.5 / 255 + 1e-9
    labels = stored("label" if kind is Nyuv2 else "label_7")
    assert (labels == -1).any()
    assert np.array_equal(frame.fields["instance_ids"], np.where(labels < 0, IGNORE, labels))
    depth = frame.fields["depth_m" if kind is Nyuv2 else "inverse_depth"]
    assert np.array_equal(depth, stored("depth")[..., 0].astype(np.float32))
    if kind is Nyuv2:
        normals = frame.fields["normals"].permute(1, 2, 0).numpy()
        assert np.allclose(normals, stored("normal"), atol=1e-6)
        assert (normals[0] == 0).all()


def test_a_flip_and_a_zoom_act_by_the_kind_of_field(trees):
    """A zoom divides depth and multiplies inverse depth; a flip negates x; normals stay 1 long."""
    for kind, name in ((Nyuv2, "depth_m"), (CityscapesMtan, "inverse_depth")):
        dataset = kind(trees[kind], "train", DATA, needs=kind.fields, training=True)
        still = Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)
        zoom = replace(still, scales=(2.0,), crop=(H, W))
        before, after = (
            Samples(dataset, augment, keep=kind.fields).sample(0, Generator().manual_seed(3))
            for augment in (still, zoom)
        )
        factor = 0.5 if kind is Nyuv2 else 2.0
        expected = (before.fields[name].unique() * factor).tolist()
        assert set(after.fields[name].unique().tolist()) <= set(expected)
        mirrored = replace(still, flip=True)
        seed = next(
            s for s in range(20) if torch.rand(6, generator=Generator().manual_seed(s))[5] < 0.5
        )
        flipped = Samples(dataset, mirrored, keep=kind.fields).sample(
            0, Generator().manual_seed(seed)
        )
        assert torch.equal(flipped.fields[name], before.fields[name].flip(-1))
        if kind is Nyuv2:
            x, y, z = before.fields["normals"].flip(-1)
            assert torch.equal(flipped.fields["normals"], torch.stack([-x, y, z]))
            length = after.fields["normals"].norm(dim=0)
            assert ((length - 1).abs() < 1e-5).logical_or(length == 0).all()


def test_frames_of_another_size_than_the_input(trees):
    data = replace(DATA, height=12, width=16)
    for training in (True, False):
        dataset = Nyuv2(trees[Nyuv2], "train", data, needs=Nyuv2.fields, training=training)
        frame = dataset.read(dataset.names[0])
        assert tuple(frame.images_N3HW[0].shape) == (3, 12, 16)
        expected = (12, 16) if training else (H, W)
        assert all(tuple(v.shape[-2:]) == expected for v in frame.fields.values())


# --- what is refused ------------------------------------------------------------------------------

SPOILED = {
    "label": (lambda a: a + 10, "labels from .* not whole numbers from -1"),
    "label ": (lambda a: a + 0.5, "not whole numbers"),
    "image": (lambda a: a * 255, "colours from .* not from 0 to 1"),
    "depth": (lambda a: a * 1000 * 10, "depth from .* not from 0 .none. to 1000 .metres."),
    "depth ": (lambda a: a[..., 0] * np.nan, "not finite; 0 marks"),
    "normal": (lambda a: a * 255, "normals up to 255 long"),
    "normal ": (lambda a: a[..., :2], "24x32x2, not height x width x 3"),
    "image ": (lambda a: a.astype("U4"), "values of type <U4, not numbers"),
    "depth  ": (lambda a: a[:-1], "23x32 pixels, its image has 24x32"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_wrong_array_is_one_line(trees, tmp_path, name):
    root = shutil.copytree(trees[Nyuv2], tmp_path / "wrong")
    spoil, message = SPOILED[name]
    path = root / "val" / name.strip() / "0.npy"
    np.save(path, spoil(np.load(path)))
    with pytest.raises(ValueError, match=message) as raised:
        Nyuv2(root, "test", DATA, needs=Nyuv2.fields).read("0")
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_broken_file_and_missing_ones(trees, tmp_path):
    root = shutil.copytree(trees[Nyuv2], tmp_path / "wrong")
    path = root / "val" / "image" / "0.npy"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"not a whole .npy array"):
        Nyuv2(root, "test", DATA).read("0")
    (root / "val" / "depth" / "2.npy").unlink()
    with pytest.raises(ValueError, match=r"2.npy: missing, one of 1 frames without depth_m"):
        Nyuv2(root, "test", DATA, needs={"depth_m"})
    shutil.rmtree(root / "val" / "normal")
    with pytest.raises(ValueError, match=r"no folder normal in it"):
        Nyuv2(root, "test", DATA, needs={"normals"})
    with pytest.raises(ValueError, match=r"no task can compare neighbours"):
        Nyuv2(root, "test", DATA, needs={"neighbours"})
    with pytest.raises(ValueError, match=r"must be published or all, not 'some'"):
        Nyuv2(root, "train", replace(DATA, train_frames="some"))


# --- data check -----------------------------------------------------------------------------------


def check(root, *options):
    return CliRunner().invoke(app, ["data", "check", str(root), *options])


@KINDS
def test_check_says_what_is_there(trees, kind):
    done = check(trees[kind], "--deep")
    assert done.exit_code == 0, done.output
    assert f"train: {TRAIN} frames (published: {kind.published['train']}), 2 of them" in done.output
    assert "float64 24x32x1, " in done.output
    assert "% without value" in done.output
    assert f"{kind.labels.labels[0].name} " in done.output
    name = "nyuv2-segnet" if kind is Nyuv2 else "cityscapes2-segnet"
    assert f"recipe {name}, depth_supervised: ready" in done.output


def test_check_refuses_the_labels_of_other_classes(trees, tmp_path):
    """`label`, which is `label_7` to other readers, is `label_19` here."""
    root = write(tmp_path / "wrong", CityscapesMtan, labels=19)
    for split in ("train", "val"):
        (root / split / "label_7").rename(root / split / "label")
    done = check(root)
    assert done.exit_code == 1
    wrong = [line for line in done.output.splitlines() if line.startswith("wrong: ")]
    assert len(wrong) == 2  # a line a folder
    assert "labels from -1 to 18, not whole numbers from -1 (none) to 6" in wrong[0]
    assert "recipe cityscapes2-segnet, semantic: " + str(root) in done.output
    assert "recipe cityscapes2-segnet, depth_supervised: ready" in done.output


def test_check_counts_what_is_missing_and_of_another_kind(trees, tmp_path):
    root = shutil.copytree(trees[Nyuv2], tmp_path / "wrong")
    (root / "train" / "depth" / "1.npy").unlink()
    (root / "train" / "depth" / "2.npy").unlink()
    path = root / "val" / "normal" / "1.npy"
    np.save(path, np.load(path).astype(np.float32))
    done = check(root)
    assert done.exit_code == 1
    assert "1.npy: missing (and so are 1 more)" in done.output
    assert "arrays of 2 kinds: float64 24x32x3, float32 24x32x3" in done.output


def test_the_stand_ins_are_in_the_layouts(tmp_path):
    for kind in (Nyuv2, CityscapesMtan):
        root = tmp_path / kind.__name__
        assert kind.example(root, replace(load_recipe("dense-smoke").data, height=H, width=W))
        assert dataset_in(root) is kind
        assert kind.check(root, deep=True).problems == []
        assert len(kind(root, "train", DATA)) == 8
        assert len(kind(root, "test", DATA)) == 2
