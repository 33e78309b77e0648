"""Grid files as editors and scripts write them: encodings, sizes and names, each told in a line."""

import pytest
from typer.testing import CliRunner

from mtl_bench.bench import grid as grids
from mtl_bench.bench.grid import load_grid
from mtl_bench.cli.app import app
from mtl_bench.core import config

GRID = """question = "Größe?"
recipe = "smoke"

[axes]
backbone = ["tiny"]
method = ["fixed"]
seed = [0]
"""


def write(path, text=GRID, encoding="utf-8"):
    path.write_bytes(text.encode(encoding))
    return str(path)


def run(*words):
    return CliRunner().invoke(app, list(words))


def test_a_byte_order_mark_and_windows_lines_are_read(tmp_path):
    name = write(tmp_path / "mine.toml", GRID.replace("\n", "\r\n"), "utf-8-sig")
    assert load_grid(name).question == "Größe?"
    recipe = write(tmp_path / "own.toml", "[optim]\nsteps = 3\n", "utf-8-sig")
    assert config.load_recipe(recipe).optim.steps == 3


def test_another_encoding_is_told_with_file_and_line(tmp_path):
    name = write(tmp_path / "mine.toml", "# a line\n" + GRID, "latin-1")
    with pytest.raises(ValueError, match=r"mine.toml, line 2: not UTF-8; save it in that"):
        load_grid(name)
    recipe = write(tmp_path / "own.toml", 'about = "größer"\n', "latin-1")
    with pytest.raises(ValueError, match=r"own.toml, line 1: not UTF-8"):
        config.load_recipe(recipe)


def test_a_grid_that_is_too_large_is_refused_at_once_with_its_number(tmp_path):
    seeds = f"seed = {list(range(100))}\n"
    lrs = f'"recipe.optim.lr" = {[n / 1000 for n in range(1000)]}\n'
    name = write(tmp_path / "mine.toml", GRID.replace("seed = [0]\n", seeds + lrs))
    found = run("ablate", "--grid", name, "--dry-run")
    assert found.exit_code == 2
    assert "mine.toml: 100000 cells, and a grid may have 10000; take values out" in found.output


def test_the_number_of_a_large_grids_cells_is_said_first(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(grids, "MANY", 3)
    name = write(tmp_path / "mine.toml", GRID.replace("[0]", "[0, 1, 2, 3]"))
    assert len(load_grid(name, say=said.append).cells) == 4
    assert said == ["mine: 4 cells"]


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('["fixed"]', '["../fixed"]', "line 6: 'method' must be a name"),
        ('["tiny"]', '["../../tiny"]', "line 5: 'backbone' must be a name"),
        ("seed = [0]", 'seed = [0]\ntasks = [["../depth"]]', "line 8: 'tasks' must be a name"),
    ],
)
def test_a_name_leads_out_of_no_folder(tmp_path, old, new, line):
    name = write(tmp_path / "mine.toml", GRID.replace(old, new))
    for command in (["status"], ["ablate", "--dry-run"]):
        found = run(*command, "--grid", name, "--runs", str(tmp_path / "runs"))
        assert found.exit_code == 2, found.output
        assert line in found.output


def test_spellings_of_one_cell_are_one_cell_of_a_grid(tmp_path):
    axis = 'seed = [0]\n"method.prior" = ["paper"]\ntasks = [["depth", "panoptic"]]\n'
    name = write(tmp_path / "mine.toml", GRID.replace("seed = [0]\n", axis))
    plain = write(tmp_path / "plain.toml")
    assert [c.id for c in load_grid(name).cells] == [c.id for c in load_grid(plain).cells]


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ('[report]\nrow = "name"\n', "unknown key 'report.row'"),
        ('[report]\nrows = "backbne"\n', r"[report] rows: no 'backbne' (did you mean 'backbone'?)"),
        ('[report]\nrows = "name"\n', "[report] rows: no 'name'"),
        ('[report]\nfirst = ["pqq"]\n', "[report] names no column 'pqq'"),
    ],
)
def test_a_report_that_cannot_be_is_told_before_anything_runs(tmp_path, section, message):
    name = write(tmp_path / "mine.toml", GRID + section)
    found = run("ablate", "--grid", name, "--runs", str(tmp_path / "runs"), "--quiet")
    assert found.exit_code == 2, found.output
    assert message in found.output
    assert not (tmp_path / "runs").exists()


def test_a_grid_of_timings_has_no_section_report(tmp_path):
    text = (
        'kind = "latency"\n[axes]\nbackbone = ["tiny"]\nengine = ["eager"]\n[report]\nrows = "x"\n'
    )
    with pytest.raises(ValueError, match="unknown key 'report'"):
        load_grid(write(tmp_path / "mine.toml", text))
