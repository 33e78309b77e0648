"""The cells that deltas are against run as parents do, whether they are in a row or not."""

import pytest
from launching import fake, history
from typer.testing import CliRunner

from mtl_bench.bench import jobs, references
from mtl_bench.bench.grid import load_grid
from mtl_bench.cli import options
from mtl_bench.cli.app import app

GRID = """
question = "Does it help?"
recipe = "smoke"

[axes]
backbone = ["tiny"]
method = ["uncertainty"]
seed = [0, 1]

[baseline]
method = "fixed"
single_task = true
"""


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Commands on that grid, with stand-ins for rendering, training and drawing."""
    (tmp_path / "mine.toml").write_text(GRID)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(options, "data_root", lambda *given: tmp_path)
    monkeypatch.setattr("mtl_bench.bench.references.measure_trivial", lambda *given, **named: None)
    page = "mtl_bench.report.grid.build"
    monkeypatch.setattr(page, lambda grid, rows, out, *given: out / "index.html")

    def run(*words, code=0, **behaviour):
        made = fake(tmp_path / "runs", **behaviour)
        monkeypatch.setattr(jobs, "cell_command", lambda cell, *given: made(cell))
        done = CliRunner().invoke(app, [words[0], "--grid", "mine.toml", *words[1:]])
        assert done.exit_code == code, done.output
        return done.output

    return run


def test_it_runs_although_it_is_in_no_row(command, tmp_path):
    grid = load_grid("mine.toml")
    assert [cell.seed for cell in references.baselines(grid)] == [0, 1]
    text = command("ablate", "--dry-run")
    assert "2 cells and 6 that they need" in text  # two baselines, and the two networks of each
    assert "missing 8   to run 8" in text
    assert "2 of 2 cells done" in command("ablate", "--jobs", "2")
    assert len(history(tmp_path / "runs")) == 16
    lines = command("status").splitlines()
    assert sum("(needed by another)" in line for line in lines) == 6
    assert lines[-1] == "done 8"


def test_a_baseline_that_fails_is_told(command):
    cell = references.baselines(load_grid("mine.toml"))[0]
    text = command("ablate", actions={cell.id: "fail"}, code=1)
    assert "FAILED" in text
    assert "2 of 2 cells done" in text


def test_a_baseline_that_the_grid_skips_is_not_run(command, tmp_path):
    skip = '[[skip]]\nsingle_task = true\nwhy = "not here"\n'
    (tmp_path / "mine.toml").write_text(
        GRID.replace('["uncertainty"]', '["uncertainty", "fixed"]').replace(
            "[baseline]",
            f"[[row]]\nname = 'a'\n[[row]]\nname = 'b'\nsingle_task = true\n{skip}[baseline]",
        )
    )
    grid = load_grid("mine.toml")
    assert len(grid.skips) > 0
    assert references.baselines(grid) == ()


def test_the_announcement_says_what_will_run(command):
    text = command("ablate", "--dry-run", "--set", "recipe.optim.steps=12")
    assert "recipe smoke (synthetic, 32x64, 12 steps)" in text
    assert "6 steps" not in text
