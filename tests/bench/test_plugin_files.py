"""A plug-in of every kind, each one file in a user's folder, from `check` to a report."""

import csv
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mtl_bench.bench import check
from mtl_bench.cli.app import app
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.quality import columns_of, quality

FOLDER = Path(__file__).parents[1] / "plugins"
PLUGINS = [
    ("tasks", "slopes"),
    ("tasks", "depth_silog"),
    ("datasets", "rooms"),
    ("backbones", "vit"),
    ("engines", "exported"),
]
GRID = """
question = "Do plug-ins of every kind run together?"

[axes]
backbone = ["vit"]

[[row]]
name = "three tasks"
method = "pcgrad"
tasks = ["panoptic", "depth_silog", "slopes"]

[[row]]
name = "apart"
method = "fixed"
tasks = ["panoptic", "slopes"]
single_task = true

[report]
rows = "name"
"""
ROOMS = """
about = "Rooms, in seconds"
smoke = true
tasks = ["panoptic", "slopes"]

[data]
dataset = "rooms"
height = 32
width = 64

[network]
strides = [2, 4, 8]
channels = 8
fused = 8
head = 8

[optim]
steps = 2
batch = 2
lr = 1e-3
warmup_steps = 1

[evaluate]
nms_kernel = 3

[latency]
passes = 2
warmup = 1
"""


@pytest.fixture
def found(monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, str(FOLDER))


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize(("kind", "name"), PLUGINS, ids=lambda value: value)
def test_check(found, kind, name):
    results = check.check(kind, name)
    assert len(results) >= 5
    assert [f"{r.name}: {r.detail}" for r in results if not r.ok] == []
    assert not any("not tried" in r.detail for r in results)


def test_a_task_more_changes_no_id(monkeypatch):
    before = Cell(load_recipe("small"), "resnet18", "fixed").id
    monkeypatch.setenv(plugins.VARIABLE, str(FOLDER))
    assert "slopes" in plugins.files("tasks")
    assert Cell(load_recipe("small"), "resnet18", "fixed").id == before


def test_columns_of_an_heir_come_after_those_of_its_task(found):
    names = [column.name for column in columns_of("depth_silog")]
    assert names == [*(column.name for column in columns_of("depth")), "silog"]
    all_names = [column.name for column in quality()]
    assert len(all_names) == len(set(all_names))
    assert plugins.family("depth_silog") == {"depth_silog", "depth"}


def test_a_grid_of_plug_ins_runs_to_its_report(found, tmp_path):
    grid = tmp_path / "mine.toml"
    grid.write_text(GRID)
    runs, reports = tmp_path / "runs", tmp_path / "reports"
    run("ablate", "--grid", grid, "--smoke", "--runs", runs, "--reports", reports, "--quiet")
    with (reports / "mine-smoke" / "table.csv").open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert float(rows["three tasks"]["mean_angle"]) > 0
    assert float(rows["three tasks"]["silog"]) > 0
    assert float(rows["three tasks"]["rmse"]) > 0
    assert float(rows["apart"]["mean_angle"]) > 0
    assert "angular error" in (reports / "mine-smoke" / "index.html").read_text().lower()


def test_a_data_set_of_ones_own_is_trained_on(found, tmp_path):
    recipe = tmp_path / "rooms-smoke.toml"
    recipe.write_text(ROOMS)
    root = tmp_path / "rooms"
    chosen = load_recipe(str(recipe))
    dataset_of(chosen).example(root, chosen.data)
    words = ["--backbone", "vit", "--method", "fixed", "--recipe", recipe, "--data", root]
    run("train", *words, "--runs", tmp_path / "runs", "--quiet")
    (path,) = (tmp_path / "runs").glob("*/row.json")
    row = json.loads(path.read_text())
    assert row["protocol"]["dataset"] == "rooms"
    assert row["metric"]["slopes.mean_angle"] > 0
    classes = {key.split(".")[2] for key in row["metric"] if key.startswith("semantic.class.")}
    assert {"floor", "wall", "chair"} <= classes <= {"floor", "wall", "chair", "table"}
    assert "rooms" in run("list", "datasets")
    report = run("latency", "--checkpoint", path.parent, "--size", "32x64", "--engine", "exported",
                 "--data", root, "--passes", "2")  # fmt: skip
    assert "against plain" in report
