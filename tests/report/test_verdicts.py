"""A grid's lines against its control: pairs, verdicts, and what the page says of them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from fake_rows import failed_row, make_row

from mtl_bench.report import grid as report
from mtl_bench.report.verdict_plots import forest
from mtl_bench.report.verdicts import judge, notes, sections, sentence

LINES = {"fixed": 0.0, "ahead": 3.0, "same": 0.0, "behind": -4.0}


def gained(points: float) -> float:
    """The row's percent of a gain in points."""
    return 100 * math.expm1(points / 100)


def suite(seeds=range(6), recipes=("small",), **more):
    """Every line's gain is the seed's own, its shift and a little noise: unpaired, all overlap."""
    rng = np.random.default_rng(1)
    rows = []
    for recipe in recipes:
        for seed in seeds:
            common = rng.normal(0, 8)
            for name, shift in (LINES | more).items():
                row = make_row("resnet18", seed, method=name)
                row["cell"]["recipe"]["name"] = recipe
                row["metric"]["delta.gain"] = gained(common + shift + rng.normal(0, 0.3))
                row["time"]["step_ms"] = 100.0 if name == "fixed" else 250.0
                rows.append(row)
    return rows


def verdict_of(rows, name):
    found = judge(rows, "method", "fixed")
    return next(line.comparison for line in found.lines if line.label == name)


def test_stale_runs_are_compared_with_each_other_and_said():
    rows = suite(range(8))
    whole = judge(rows, "method", "fixed")
    for row in rows:
        row |= {"status": "stale", "env": {"git_commit": "0123456789"}}
    found = judge(rows, "method", "fixed")
    assert sentence(found) == sentence(whole)
    assert "Stale, all runs that are compared: small (commit 0123456)" in " ".join(notes(found))
    assert not [said for said in notes(whole) if "Stale" in said]


def test_a_stale_run_is_not_held_against_a_control_of_today():
    rows = suite(range(8))
    for row in rows:
        row["status"] = "stale" if row["method"] == "ahead" else "done"
    found = judge(rows, "method", "fixed")
    assert [line.label for line in found.lines] == ["same", "behind"]
    assert found.stale == ""


def test_a_busy_machine_makes_no_line_dearer():
    rows = suite(range(8))
    for row in rows[::3]:  # a third of every line's runs, another one each time
        row["time"]["step_ms"] *= 4
    assert judge(rows, "method", "fixed").lines[0].step_x == 2.5


def test_lines_are_told_apart_although_seeds_spread_wider():
    found = judge(suite(range(8)), "method", "fixed")
    verdicts = {line.label: line.comparison.verdict for line in found.lines}
    assert verdicts == {"ahead": "better", "same": "equivalent", "behind": "worse"}
    assert [line.label for line in found.lines] == ["ahead", "same", "behind"]
    assert found.lines[0].comparison.difference.mean == pytest.approx(3, abs=0.4)
    assert found.lines[0].step_x == 2.5
    assert sentence(found) == (
        "1 of 3 lines beat fixed (at 2.50 times its step time), 1 is equivalent within 1 point "
        "(at 2.50 times its step time), 1 is worse, 0 are open."
    )


def test_two_recipes_are_two_problems_of_one_line():
    found = judge(suite(range(4), ("small", "other")), "method", "fixed")
    assert (found.problems, found.scores.seeds) == (("small", "other"), (0, 1, 2, 3))
    assert {line.comparison.blocks for line in found.lines} == {8}


def test_a_line_of_two_settings_is_two_lines():
    rows = suite()
    for row in rows:
        if row["method"] == "ahead":
            row["cell"]["method_args"] = {"alpha": 0.5 if row["seed"] < 3 else 1.5}
    labels = {line.label for line in judge(rows, "method", "fixed, none").lines}
    assert {"ahead, 0.5", "ahead, 1.5", "same, none"} == labels - {"behind, none"}


def test_a_failed_run_is_the_worst_and_a_missing_one_is_none():
    rows = [row for row in suite() if not (row["method"] == "same" and row["seed"] == 2)]
    at = next(i for i, r in enumerate(rows) if r["method"] == "ahead" and r["seed"] == 1)
    rows[at] = {**rows[at], "status": "failed", "metric": {}, "error": "NaN"}
    assert verdict_of(rows, "same").blocks == 5
    ahead = verdict_of(rows, "ahead")
    assert (ahead.blocks, ahead.failed, ahead.verdict) == (6, 1, "open")
    assert any(
        "count as the worst: 1 block of line and control with one." in n
        for n in notes(judge(rows, "method", "fixed"))
    )


def test_few_seeds_are_said_to_be_too_few():
    found = judge(suite(range(3)), "method", "fixed")
    assert {line.comparison.verdict for line in found.lines} <= {"equivalent", "open"}
    assert any(note.startswith("With 3 blocks no line of 3 can be better") for note in notes(found))
    assert judge(suite(range(1)), "method", "fixed") is None
    assert judge(suite(), "method", "absent") is None
    one = suite(range(4)) + suite(range(1), ("other",))
    found = judge(one, "method", "fixed")
    assert math.isnan(found.lines[0].comparison.difference.low)
    assert any(note.startswith("No interval: a single run of a problem") for note in notes(found))
    assert not any("No interval" in note for note in notes(judge(suite(), "method", "fixed")))
    assert judge([failed_row()], "method", "fixed") is None


def grid_of(control):
    return SimpleNamespace(
        name="methods",
        question="Which?",
        recipe=SimpleNamespace(name="small"),
        report={"rows": "method", "control": control},
        cells=(),
        skips=(),
    )


def test_where_nothing_is_tested_the_page_says_why(tmp_path):
    page = report.build(grid_of("fixed"), suite(range(1)), tmp_path).read_text()
    assert "Nothing is tested against &#39;fixed&#39;: it takes two seeds or problems" in page
    page = report.build(grid_of("fixde"), suite(), tmp_path).read_text()
    assert "no such line has numbers (did you mean &#39;fixed&#39;?)" in page
    assert not (tmp_path / "forest.png").exists()


def test_a_failed_run_is_told_in_table_and_picture(tmp_path):
    rows = suite()
    for row in rows:
        if (row["method"], row["seed"]) in {("ahead", 1), ("fixed", 2), ("same", 2)}:
            row |= {"status": "failed", "metric": {}, "error": "NaN"}
    found = judge(rows, "method", "fixed")
    shown = {line.cells[0].text: line.cells[2].text for line in sections(found)[0].lines}
    assert shown == {"ahead": "failed", "same": "failed", "behind": "control failed", "fixed": ""}
    assert forest(found, tmp_path, "forest") is None
    rest = [row for row in rows if row["seed"] != 2]
    caption = forest(judge(rest, "method", "fixed"), tmp_path, "forest")
    assert caption.endswith(
        "0 of 3 lines beat fixed, 1 is equivalent within 1 point (at 2.50 times its step time), "
        "0 are worse, 2 are open."
    )
    assert ">1 failed<" in (tmp_path / "forest.svg").read_text()


def test_the_page_the_tables_and_the_picture_have_it(tmp_path):
    page = report.build(grid_of("fixed"), suite(range(8)), tmp_path).read_text()
    assert "Against fixed" in page
    assert page.count("<p>1 of 3 lines beat fixed") == 1
    assert (tmp_path / "forest.png").stat().st_size > 5000
    tables = {name: (tmp_path / name).read_text() for name in ("table.md", "table.tex")}
    assert "| better |" in tables["table.md"]
    assert r"\caption{Against fixed. 1 of 3 lines beat fixed" in tables["table.tex"]
    head = (tmp_path / "table.csv").read_text().splitlines()[0].split(",")
    assert {"gain", "gain_std"} <= set(head)


def test_the_picture_of_many_lines_is_drawn(tmp_path):
    many = {f"method_{n}": float(n % 7 - 3) for n in range(30)}
    found = judge(suite(range(6), **many), "method", "fixed")
    assert "Paired differences to fixed" in forest(found, tmp_path, "forest")
    (section,) = sections(found)
    assert len(section.lines) == len(found.lines) + 1
