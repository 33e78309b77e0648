"""The small standard problems from cell to report, for a few steps each."""

import pytest

from mtl_bench.bench.data_state import Data
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.launch import Here
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.files import read_json
from mtl_bench.core.plugins import stem_and_field
from mtl_bench.core.quality import columns_of

SMALL = [
    *("recipe.data.train_scenes=64", "recipe.data.val_scenes=16", "recipe.data.test_scenes=16"),
    *("recipe.optim.steps=2", "recipe.optim.batch=8", "recipe.optim.warmup_steps=0"),
    *("recipe.latency.passes=2", "recipe.data.workers=0"),
]


def rows(recipe: str, tmp_path, methods: str, settings=()) -> list[dict]:
    grid = load_grid("methods", recipe=recipe, smoke=True, settings=[*SMALL, methods, *settings])
    kind = dataset_of(grid.recipe)
    root = tmp_path / "data"
    if kind.built_in:
        root = kind.render(grid.recipe.data)
    else:
        kind.example(root, grid.recipe.data)
    here = Here(tmp_path / "runs", root, "cpu", "off", lambda line: None, Data(root))
    for cell in grid.jobs:
        here.run(cell, rerun=False, stale=False)
    return [read_json(tmp_path / "runs" / cell.slug / "row.json") for cell in grid.jobs]


@pytest.mark.parametrize(
    ("recipe", "methods", "settings"),
    [
        ("scales", "method=nash", []),
        ("conflict", "method=mgda_ub", []),
        ("digits", "method=famo", []),
        ("celeba-cnn9", "method=uncertainty", ["recipe.data.height=16", "recipe.data.width=16"]),
    ],
)
def test_a_smoke_cell(tmp_path, recipe, methods, settings):
    (row,) = rows(recipe, tmp_path, methods, settings)
    assert row["smoke"] is True
    assert row["backbone"] == recipe.partition("-")[2] or row["backbone"] in ("mlp", "lenet")
    known = {
        column.key
        for task in {stem_and_field(task)[0] for task in row["tasks"]}
        for column in columns_of(task)
        if column.task in row["tasks"]
    }
    # an attribute that nobody has, found or true, has no F1
    missing = {key for key in known - row["metric"].keys() if not key.endswith(".f1")}
    assert missing == set()
    assert row["metric"]["latency.mean_ms"] > 0


def test_a_cell_without_passes_is_not_timed(tmp_path):
    (row,) = rows("scales", tmp_path, "method=fixed", ["recipe.latency.passes=0"])
    assert "regress.y0.unexplained" in row["metric"]
    assert not [key for key in row["metric"] if key.startswith("latency.")]
    assert row["time"]["latency_s"] == 0


def test_a_report_of_numbers(tmp_path):
    from mtl_bench.report.grid import build

    found = [
        row for name in ("fixed", "rlw") for row in rows("conflict", tmp_path, f"method={name}")
    ]
    grid = load_grid("methods", recipe="conflict", smoke=True, settings=[*SMALL, "method=fixed"])
    page = build(grid, found, tmp_path / "report", runs_root=tmp_path / "runs", command="x")
    table = (page.parent / "table.md").read_text()
    assert "c7 1 - R2" in table
    assert "c8" not in table
    assert "left accuracy" not in page.read_text()
    assert not (page.parent / "samples.png").exists()
