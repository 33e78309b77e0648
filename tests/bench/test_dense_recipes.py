"""The dense tasks from a recipe to a report, on the stand-in of NYUv2."""

import csv

import pytest
from typer.testing import CliRunner

from mtl_bench.cli.app import app

GRID = """
question = "Do classes, depth and normals run together?"
recipe = "dense-smoke"

[axes]
method = ["fixed", "pcgrad"]
backbone = ["tiny"]
granularity = ["tasks"]

[baseline]
method = "fixed"
single_task = true

[report]
rows = "method"
"""


@pytest.mark.slow
def test_a_grid_of_the_dense_recipe_runs_to_its_report(tmp_path):
    (tmp_path / "dense.toml").write_text(GRID)
    words = ["ablate", "--grid", tmp_path / "dense.toml", "--runs", tmp_path / "runs",
             "--reports", tmp_path / "reports", "--quiet"]  # fmt: skip
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    out = tmp_path / "reports" / "dense"
    with (out / "table.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    for name in ("seg_miou", "pixel_acc", "abs_err", "rel_err", "abs_err_legacy", "normal_mean",
                 "normal_median", "normal_11", "normal_22", "normal_30"):  # fmt: skip
        assert float(rows["pcgrad"][name]) > 0, name
    assert "most frequent class per pixel" in (out / "table.md").read_text()
    assert (out / "samples.png").is_file()
    assert not (out / "pq_fps.png").exists()
