"""The field's tables of multi-task methods: their deltas, what papers copied wrongly, and what is
measured beside them."""

import csv
import sys
from collections import Counter

import pytest
from conftest import SHARED
from typer.testing import CliRunner

from mtl_bench.bench import references
from mtl_bench.bench.grid import baseline_cell, load_grid
from mtl_bench.bench.jobs import CELLS
from mtl_bench.cli.app import app
from mtl_bench.core import config
from mtl_bench.report import literature

TABLES = [name for name in literature.names() if literature.load(name).papers]
WITH_METRICS = [name for name in TABLES if literature.load(name).baseline]
OFF = {  # printed deltas that their own rows do not give
    ("nyuv2", "IMTL-G"): (-0.76, -0.60),
    ("nyuv2", "Aligned-MTL"): (-4.93, -4.77),
    ("nyuv2", "IMGrad"): (-4.57, -4.44),
    ("cityscapes2", "Nash-MTL"): (6.82, 6.72),
    ("cityscapes2-deeplab", "MTAdam"): (-2.74, -2.64),
}


def rows_of(name):
    return [
        (row, literature.deltas(literature.load(name), row)) for row in literature.load(name).row
    ]


# --- as printed -----------------------------------------------------------------------------------


def test_the_tables_are_there():
    assert {"nyuv2", "cityscapes2", "celeba"} <= {*TABLES}
    sizes = {name: len(literature.load(name).row) for name in TABLES}
    assert sizes == {
        "nyuv2": 67,
        "cityscapes2": 40,
        "celeba": 23,
        "nyuv2-deeplab": 22,
        "cityscapes2-deeplab": 22,
    }


@pytest.mark.parametrize("name", TABLES)
def test_every_row_says_where_it_is_from(name):
    table = literature.load(name)
    known = {*literature.TEXTS, *table.numbers, "n", "se", "read_in", "note", "differs", "copied"}
    for row in table.row:
        assert {*row} <= known, row
        assert row["printed_in"].split(",")[0] in table.papers
        assert row.get("rerun_by", row["printed_in"].split(",")[0]) in table.papers
        assert {*row.get("se", {})} <= {*table.numbers}
        assert row.get("n", 3) == 3
    assert {*table.columns, *table.narrow} <= {*literature.TEXTS, *table.numbers}


def test_deltas_that_differ_from_print_are_exactly_the_listed_ones():
    found = {}
    for name in WITH_METRICS:
        kind = literature.load(name).printed_delta
        for row, computed in rows_of(name):
            printed = row.get("delta_printed")
            if printed is not None and computed:
                off = abs(computed[kind] - float(printed)) > 0.1
                assert off == ("differs" in row), row
                if off:
                    found[name, row["method"]] = (float(printed), round(computed[kind], 2))
    assert found == OFF


@pytest.mark.skipif(not (SHARED / "facts/published/rows.py").is_file(), reason="no facts")
def test_the_rows_are_those_of_the_transcription(monkeypatch):
    """Every row of `rows.py` stands in the tables with its numbers and the same two deltas."""
    monkeypatch.syspath_prepend(str(SHARED / "facts/published"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    import rows

    for name, theirs, base, up, task in (
        ("nyuv2", rows.NYU, rows.NYU_BASE, rows.NYU_UP, rows.NYU_TASK),
        ("cityscapes2", rows.CITY, rows.CITY_BASE, rows.CITY_UP, rows.CITY_TASK),
    ):
        keys = [column.name for column in literature.load(name).counted]
        ours = {}
        for row, computed in rows_of(name):
            if all(key in row for key in keys) and "copied" not in row:
                ours[tuple(float(row[key]) for key in keys)] = row, computed
        for theirs_row in theirs:
            values = tuple(map(float, theirs_row[1 : 1 + len(keys)]))
            row, computed = ours[values]
            if theirs_row[0] == "STL":
                assert computed == {}
                continue
            flat, per_task, _ = rows.deltas(values, base, up, task)
            assert computed["delta_flat"] == pytest.approx(flat)
            assert computed["delta_task"] == pytest.approx(per_task)
            printed = theirs_row[-2]
            assert (printed is None) == ("delta_printed" not in row)
            assert printed is None or float(row["delta_printed"]) == printed


def test_a_copied_row_is_marked_and_equals_the_one_it_was_copied_from():
    wrong = {}
    for name in TABLES:
        keys = [column.name for column in literature.load(name).counted]
        rows = literature.load(name).row
        for row in (row for row in rows if "copied" in row):
            same = [r for r in rows if r is not row and all(r.get(k) == row[k] for k in keys)]
            wrong[name, row["method"]] = [r["method"] for r in same]
    assert wrong == {("nyuv2", "FAMO"): ["MoCo"], ("cityscapes2", "LS"): ["SI"]}
    lines = literature.compare(literature.load("cityscapes2"), []).published
    (line,) = [line for line in lines if "copy error" in line.what]
    assert "this is SI's row" in line.what


def test_two_papers_that_disagree_have_two_rows_side_by_side():
    for name, method in (("nyuv2", "UW"), ("cityscapes2", "UW"), ("cityscapes2", "MGDA")):
        methods = [row["method"] for row in literature.load(name).row]
        first, count = methods.index(method), Counter(methods)[method]
        assert count > 1
        assert methods[first : first + count] == [method] * count
    mgda = [row for row in literature.load("cityscapes2").row if row["method"] == "MGDA"]
    assert [(str(row["delta_printed"]), row.get("rerun_by")) for row in mgda] == [
        ("44.14", None),
        ("11.02", "MOON"),
    ]


def test_numbers_standard_errors_and_deltas_are_written(tmp_path):
    lines = literature.compare(literature.load("nyuv2"), []).lines
    (famo,) = [line for line in lines if line.errors and line.texts["method"] == "FAMO"]
    known = literature.load("nyuv2").numbers
    cells = {name: literature.cell(famo, name, known) for name in known}
    assert (cells["miou"].text, cells["miou"].spread) == ("38.88", "(SE 0.54)")
    assert (cells["delta_printed"].text, cells["delta_printed"].spread) == ("-4.10", "(SE 0.39)")
    assert (cells["delta_flat"].text, cells["delta_task"].text) == ("-4.10", "6.79")
    assert famo.seeds == "3"
    written = literature.write(literature.compare(literature.load("nyuv2"), []), tmp_path, "it")
    (row,) = [r for r in csv.DictReader((tmp_path / "table.csv").open()) if r["miou_se"] == "0.54"]
    assert row["method"] == "FAMO"
    assert row["source"].startswith("Liu, Feng, Stone, Liu: FAMO")
    assert "printed Δ is not the row&#39;s: its row gives -0.60" in written.read_text()
    assert "MGDA" in (tmp_path / "table.tex").read_text()


# --- measured beside them -------------------------------------------------------------------------

BETTER = {"miou": 50.0, "pix_acc": 70.0, "abs_err": 0.5, "rel_err": 0.2}


def row(method="mine", seed=0, factor=1.0, dataset="cityscapes-mtan", frames=500, **changes):
    """As `row.json` holds it, each metric `factor` times as good as the single-task row's."""
    data = config.Data(dataset=dataset, height=128, width=256)
    recipe = config.Recipe(name="two", data=data)
    cell = config.Cell(recipe, seed=seed, backbone="net", method=method, **changes)
    metric = {}
    for column in literature.load("cityscapes2").counted:
        value = BETTER[column.name]
        metric[column.key] = value * factor if column.better > 0 else value * (2 - factor)
    return {
        "slug": f"{method}-{seed}-{cell.single_task}",
        "status": "done",
        "seed": seed,
        "smoke": False,
        "cell": CELLS.identity(cell)["cell"],
        "metric": metric,
        "protocol": {"split": "test", "frames": frames, "published_frames": 500},
    }


def test_measured_rows_stand_apart_with_deltas_to_their_own_single_task_row():
    rows = [row("fixed", seed, single_task=True) for seed in (0, 1)]
    rows += [row("mine", 0, 1.1), row("mine", 1, 1.2), row("other", 5, 1.1)]
    found = literature.compare(literature.load("cityscapes2"), rows)
    published, measured = found.sections
    assert {line.kind for line in published.lines} == {"published"}
    assert {line.kind for line in measured.lines} == {"measured"}
    assert measured.heading.startswith("Measured on Cityscapes (two tasks)")
    single, mine, other = measured.lines
    assert (single.texts["method"], single.count) == ("fixed", 2)
    assert single.entries["delta_flat"].count == 0
    assert mine.entries["delta_flat"].mean == pytest.approx(-15)
    assert mine.entries["delta_task"].mean == pytest.approx(15)
    assert other.entries["delta_flat"].count == 0  # no single-task row of its seed
    assert mine.entries["delta_printed"].count == 0
    assert mine.texts["frames"] == "500/500"
    assert mine.texts["protocol"].endswith("steps of 12, the last")
    assert "recipe two" in mine.details


def test_built_in_data_and_fewer_frames_stand_further_apart():
    rows = [row(), row("b", dataset="synthetic-cityscapes-mtan", frames=20), row("c", frames=7)]
    found = literature.compare(literature.load("cityscapes2"), rows)
    assert [
        (part.lines[0].texts["method"], part.lines[0].marks) for part in found.sections[1:]
    ] == [
        ("mine", ()),
        ("c", ("7 of 500 frames",)),
        ("b", ("built-in data, not Cityscapes (two tasks)",)),
    ]


@pytest.mark.parametrize("name", TABLES)
def test_the_command_needs_no_measured_row(name, tmp_path):
    options = ["report", "--table", name, "--runs", tmp_path / "no", "--reports", tmp_path]
    result = CliRunner().invoke(app, list(map(str, options)))
    assert result.exit_code == 0, result.output
    assert "published rows only" in result.output
    assert {path.name for path in (tmp_path / f"tables-{name}").iterdir()} >= {
        *("table.csv", "table.md", "table.tex", "index.html")
    }


def test_the_rows_of_a_grid_bring_those_that_their_deltas_are_against(tmp_path):
    grid = load_grid("methods", recipe="smoke")
    single = baseline_cell(grid.cells[0], grid.baseline)
    found = references.baseline_rows(grid, tmp_path)
    assert [row["cell_id"] for row in found] == [single.id]
    assert single.single_task
