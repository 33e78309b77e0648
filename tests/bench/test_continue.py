"""A cell that goes on from another's checkpoint, and backbones of which a part is frozen."""

import csv
import json
import shutil
from dataclasses import replace

import pytest
import torch
from typer.testing import CliRunner

from mtl_bench.bench import store
from mtl_bench.bench.jobs import CELLS, load_cell
from mtl_bench.cli.app import app
from mtl_bench.core.config import Cell, load_recipe, override, to_dict
from mtl_bench.core.device import Compute
from mtl_bench.train import checkpoint
from mtl_bench.train.loop import build

CPU = torch.device("cpu")


@pytest.fixture
def start():
    return Cell(load_recipe("smoke"), "tiny", "fixed_uncertainty", ("panoptic",))


def continuing(cell, *settings):
    return override(replace(cell, continues=cell), settings)


def test_it_is_a_cell_of_its_own_with_that_parent(start, tmp_path):
    on = continuing(start, "recipe.optim.lr=0.5")
    assert on.parents == (start,)
    assert len({start.id, on.id, continuing(start).id, continuing(on).id}) == 4
    assert on.label == f"{start.label} continued"
    assert replace(on, video=True).parents == (on,)
    store.run_dir(on, tmp_path).mkdir()
    directory, _ = store.begin(on, tmp_path)
    assert load_cell(directory / "cell.json") == on
    assert CELLS.identity(on)["cell"]["continues"] == start.slug
    CELLS.check([on])


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ("method=fixed", "a continued cell keeps its tasks, backbone, method, network: method"),
        ("backbone=resnet18", "network: backbone"),
        ('tasks=["depth"]', "network: tasks"),
        ("recipe.network.head=64", "network: network"),
        ("backbone.width=16", "network: backbone"),
    ],
)
def test_what_its_checkpoint_has_no_place_in_is_one_line(start, setting, why):
    with pytest.raises(ValueError, match=why) as error:
        continuing(start, setting)
    assert "\n" not in str(error.value)
    apart = replace(start, tasks=("panoptic", "depth"), single_task=True)
    with pytest.raises(ValueError, match="no one network to continue"):
        continuing(apart)


def test_train_continues_a_run(start, smoke_root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def train(*words, code=0):
        options = ("--data", str(smoke_root), "--device", "cpu", *map(str, words))
        done = CliRunner().invoke(app, ["train", *options])
        assert done.exit_code == code, done.output
        return done.output

    named = ("--recipe", "smoke", "--backbone", "tiny", "--method", start.method)
    short = ("--set", "recipe.optim.steps=2")
    train(*named, "--tasks", "panoptic", *short)
    (directory,) = (tmp_path / "runs").glob("*-tiny-*")
    before = (directory / "last.pt").read_bytes()
    first = load_cell(directory / "cell.json")
    again = ("--continue", directory, "--set", "recipe.optim.steps=1")
    train(*again, "--set", "recipe.optim.lr=0.0", "--set", "backbone.frozen=all")
    assert (directory / "last.pt").read_bytes() == before
    settings = ("recipe.optim.steps=1", "recipe.optim.lr=0.0", "backbone.frozen=all")
    on = continuing(first, *settings)
    row = store.load_row(tmp_path / "runs" / on.slug)
    assert row["cell"]["continues"] == first.slug
    one, other = (
        checkpoint.read(tmp_path / "runs" / cell.slug / "last.pt")["model"] for cell in (first, on)
    )
    backbone = [key for key in one if key.startswith("net.backbone.")]
    assert len(backbone) > 10
    assert all(torch.equal(one[key], other[key]) for key in backbone)
    with (tmp_path / "runs" / on.slug / "curve.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 1
    assert "done already" in train(*again, "--set", settings[1], "--set", settings[2])
    other = shutil.copytree(
        smoke_root, tmp_path / "other"
    )  # what is continued may be of other data
    (other / "synthetic.json").unlink()
    with min(other.rglob("*.png")).open("ab") as opened:
        opened.write(b"more")
    assert "row.json" in train(*again, "--set", "seed=3", "--data", str(other))
    mailed = shutil.copy(directory / "last.pt", tmp_path / "mailed.pt")
    done = CliRunner().invoke(app, ["evaluate", str(mailed), "--data", str(smoke_root)])
    metric = store.load_row(directory)["metric"]
    assert json.loads(done.stdout).items() <= metric.items()
    text = train("--continue", directory, "--runs", "elsewhere", code=2)
    assert f"--continue {directory} is not 'elsewhere/{first.slug}': say where it is" in text
    for option in ("--method", "fixed"), ("--seed", "1"), ("--video",), ("--recipe", "smoke"):
        text = train("--continue", directory, *option, code=2)
        assert f"{option[0]} does not go with --continue, which takes RUN's" in text
    text = train("--continue", directory, "--set", "backbone.frozen=stm", code=2)
    assert "backbone.frozen is not 'stm' (did you mean 'stem'?)" in text


# --- freezing -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("backbone", "stem"),
    [("tiny", ("stages.0.",)), ("resnet18", ("pyramid.conv1.", "pyramid.bn1."))],
)
def test_what_is_frozen_learns_no_more(start, backbone, stem):
    for frozen in (None, "stem", "all"):
        arguments = {} if frozen is None else {"frozen": frozen}
        cell = replace(start, backbone=backbone, backbone_args=arguments)
        CELLS.check([cell])
        model = build(cell, Compute(CPU))[0]
        model.train()
        own = dict(model.net.backbone.named_parameters())
        still = {name for name, parameter in own.items() if not parameter.requires_grad}
        expected = {name for name in own if name.startswith(stem)} if frozen == "stem" else set()
        assert still == (set(own) if frozen == "all" else expected)
        for name, module in model.net.backbone.named_modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                learns = any(f"{name}.{p}" not in still for p in ("weight", "bias"))
                assert module.training == learns, name
        assert all(parameter.requires_grad for parameter in model.net.heads.parameters())


def test_freezing_makes_another_cell_and_nothing_else_does(start):
    assert replace(start, backbone_args={"frozen": "all"}).id != start.id
    assert "continues" in to_dict(start)
    with pytest.raises(ValueError, match="backbone 'tiny' has no 'frosen'"):
        CELLS.check([replace(start, backbone_args={"frosen": "all"})])
