"""The report of a suite: verdicts over problems, and quality and figures of each of them."""

import csv
import io
import json
import math
import re

import numpy as np
import pytest
from fake_suite import CONTROL, PROBLEMS, fail, suite_grid, suite_rows
from scipy import stats

from mtl_bench.core import style
from mtl_bench.report import grid as report
from mtl_bench.report import verdict_plots
from mtl_bench.report.grid import Layout, by_problem, fill, tabulate
from mtl_bench.report.page import beside
from mtl_bench.report.statistics import FEW
from mtl_bench.report.verdict_plots import LEADERS, bands, forest, highlighted, profiles
from mtl_bench.report.verdicts import (
    ALL,
    VERDICTS,
    judge,
    notes,
    records,
    sections,
    sentence,
)

LINES = {"ahead": 3.0, "same": 0.0, "behind": -3.0, "far": -60.0, "a_line_with_a_long_name": 0.05}


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Small pictures: drawing is most of a report's time."""
    monkeypatch.setitem(style.SETTINGS, "savefig.dpi", 25)


@pytest.fixture(scope="module")
def rows():
    return suite_rows(LINES)


@pytest.fixture(scope="module")
def found(rows):
    return judge(rows, "method", CONTROL)


def points(rows, line, problem):
    """Gains by seed, from the rows themselves."""
    return np.array(
        [
            100 * math.log1p(row["metric"]["delta.gain"] / 100)
            for row in rows
            if (row["method"], row["cell"]["recipe"]["name"]) == (line, problem)
        ]
    )


def test_every_problem_has_a_gain_by_its_own_metrics(rows):
    for row in rows:
        assert ("delta.gain" in row["metric"]) == (row["method"] != "baseline")


def test_the_whole_is_paired_over_problems_and_each_is_tested_by_its_seeds(rows, found):
    assert found.problems == tuple(PROBLEMS)
    line = next(line for line in found.lines if line.label == "ahead")
    assert line.comparison.blocks == 15
    assert line.comparison.verdict == "better"
    for problem, own in zip(found.problems, line.by_problem, strict=True):
        theirs = stats.ttest_rel(points(rows, "ahead", problem), points(rows, CONTROL, problem))
        assert own.p == pytest.approx(theirs.pvalue)
        assert (own.difference.low, own.difference.high) == pytest.approx(
            tuple(theirs.confidence_interval(0.95))
        )
    assert sentence(found) == (
        "1 of 5 lines beat scalarised over 3 problems (at 1.50 times its step time), 2 are "
        "equivalent within 1 point (at 1.25 times its step time in the median), 2 are worse, 0 are "
        "open."
    )


def test_without_a_problem_only_the_others_count(rows, found):
    kept = [row for row in rows if row["cell"]["recipe"]["name"] != "digits"]
    alone = judge(kept, "method", CONTROL)
    place = found.problems.index("digits")
    ours = {line.label: line.without[place] for line in found.lines}
    assert ours == {line.label: line.comparison for line in alone.lines}


def test_a_verdict_that_hangs_on_one_problem_is_told(rows):
    rows = json.loads(json.dumps(rows))
    for row in rows:
        if (row["method"], row["cell"]["recipe"]["name"]) == ("same", "scales"):
            row["metric"]["delta.gain"] += 8
    _, section = sections(judge(rows, "method", CONTROL))
    told = {line.cells[0].text: line.cells[-1].text for line in section.lines}
    assert told["same"] == "equivalent without scales"
    assert told["ahead"] == "better, whichever"
    scales = {line.cells[0].text: line.cells[1] for line in section.lines}
    assert (scales["same"].bold, scales["same"].text[-1]) == (True, "*")
    assert (scales["behind"].bold, scales["behind"].text[-1]) == (False, "*")
    assert "*" not in scales["a_line_with_a_long_name"].text


def test_a_line_that_lacks_a_problem_has_fewer_blocks_and_no_rank(rows, tmp_path):
    rows = [r for r in rows if (r["method"], r["cell"]["recipe"]["name"]) != ("same", "dense")]
    found = judge(rows, "method", CONTROL)
    line = next(line for line in found.lines if line.label == "same")
    assert line.comparison.blocks == 10
    assert math.isnan(line.rank)
    row = next(x for x in sections(found)[0].lines if x.cells[0].text == "same")
    assert (row.cells[1].text, row.cells[8].text) == ("10\u2020", "-")
    assert "same" not in [line.label for line in found.ranked]
    assert "Absent: 1 line without a run of some problem." in bands(found, tmp_path, "bands")
    assert any("Fewer blocks than another line" in note for note in notes(found))
    assert sentence(found).endswith("0 are open; 1 line lacks runs (\u2020).")


def test_a_problem_without_any_gain_is_none(rows):
    rows = json.loads(json.dumps(rows))
    for row in rows:
        if row["cell"]["recipe"]["name"] == "dense":
            row["metric"].pop("delta.gain", None)
        if row["cell"]["recipe"]["name"] == "digits":
            row.update(status="missing", metric={})
    found = judge(rows, "method", CONTROL)
    assert (found.problems, found.left_out) == (("scales",), ("digits", "dense"))
    said = f"Left out: digits, dense, where {CONTROL} has no log gain: its own numbers or the"
    assert any(note.startswith(said) for note in notes(found))


def test_a_problem_that_the_control_lacks_is_left_out(rows):
    rows = json.loads(json.dumps(rows))
    for row in rows:
        if (row["cell"]["recipe"]["name"], row["method"]) == ("dense", CONTROL):
            row.update(status="missing", metric={})
    found = judge(rows, "method", CONTROL)
    kept = [row for row in rows if row["cell"]["recipe"]["name"] != "dense"]
    assert (found.problems, found.left_out) == (("scales", "digits"), ("dense",))
    assert found.lines == judge(kept, "method", CONTROL).lines
    assert found.control.rank == 3
    rest = [row for row in rows if row["cell"]["recipe"]["name"] == "dense"]
    assert judge(rest, "method", CONTROL) is None


def test_a_failed_baseline_is_no_line(rows):
    rows = json.loads(json.dumps(rows))
    fail(next(row for row in rows if row["method"] == "baseline"))
    assert "baseline" not in judge(rows, "method", CONTROL).scores.labels
    for row in rows:
        if row["method"] == "behind":
            fail(row)
    line = judge(rows, "method", CONTROL).lines[-1]
    assert (line.label, line.comparison.verdict, line.comparison.failed) == ("behind", "worse", 15)


def test_tuned_lines_are_called_as_their_trials(rows):
    rows = json.loads(json.dumps(rows))
    for row in rows:  # as results of trials say it
        tuned = {"line": f"the {row['method']}", "problem": f"{row['cell']['recipe']['name']}, a"}
        row["tuned"] = tuned | {"trial": 1, "values": {"recipe.optim.lr": 0.1}, "failed": False}
    found = judge(rows, "method", f"the {CONTROL}")
    assert {line.label for line in found.lines} == {f"the {line}" for line in LINES}
    assert found.problems == tuple(f"{problem}, a" for problem in PROBLEMS)


def test_bold_leads_the_control_by_a_test(rows):
    layout = Layout(rows="method", control=CONTROL)
    own = by_problem(rows, layout)["digits"]
    results = tabulate(own, layout, problem="digits")
    column = next(c for c in results.columns() if c.key == "classify.left.accuracy")
    values = {
        g.identity[0]: np.array([row["metric"][column.key] for row in g.rows])
        for g in results.groups
    }
    base = values.pop(CONTROL)
    p = {name: stats.ttest_rel(x, base).pvalue for name, x in values.items()}
    order = sorted(p, key=p.get)
    holm = {
        k: max(min(1, (len(p) - j) * p[o]) for j, o in enumerate(order[: i + 1]))
        for i, k in enumerate(order)
    }
    expected = {k for k, x in values.items() if holm[k] <= 0.05 and x.mean() > base.mean()}
    assert {g.identity[0] for g in results.groups if g.entries[column.name].bold} == expected
    assert "ahead" in expected
    assert "Bold: ahead of scalarised" in fill(results).notes[0]


def test_few_lines_keep_their_rule(rows):
    layout = Layout(rows="method", control=CONTROL)
    names = ("baseline", CONTROL, "ahead", "behind")
    assert len(names) == FEW
    results = tabulate([row for row in rows if row["method"] in names], layout)
    assert "Bold: ahead of every other plain line" in fill(results).notes[0]
    results = tabulate([row for row in rows if row["method"] in names], layout, problem="scales")
    assert "Bold in scales, where nothing is tested: ahead" in fill(results).notes[0]


def test_the_report_has_all_of_it(rows, tmp_path):
    page = report.build(suite_grid(), rows, tmp_path).read_text()
    heads = [re.sub("<[^>]+>", "", h) for h in re.findall("<h[23]>(.*?)</h[23]>", page)]
    assert heads[1:5] == [
        "Against scalarised",
        "Difference to scalarised by problem",
        "Scales: quality",
        "Scales: cost",
    ]
    figures = re.findall("<figure[^>]*>\n<h3>(.*?)</h3>", page)
    assert figures[:3] == ["Against the control", "How far ranks go", "Performance profiles"]
    assert all(title.startswith("dense: ") for title in figures[3:])
    assert 'href="verdicts.csv"' in page
    assert len(re.findall("https?://(?!www.w3.org)", page)) == 0
    table = list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))
    assert {line["recipe.name"] for line in table} == set(PROBLEMS)
    for name in ("table.md", "table.tex", "readme.md"):
        assert "1 of 5 lines beat scalarised over 3 problems" in (tmp_path / name).read_text()
    assert "Scales: quality" not in (tmp_path / "readme.md").read_text()
    report.build(suite_grid(control="absent"), rows, tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert not left & {"verdicts.csv", "forest.png", "bands.svg"}
    assert "dense-abs_err_seg_miou.svg" in left


def test_what_an_earlier_report_of_other_problems_drew_goes(tmp_path):
    for name in ("a-b-forest.png", "forest.svg", "verdicts.csv", "mine.csv", "mine-forest.txt"):
        (tmp_path / name).touch()
    with beside(tmp_path, ("forest", "verdicts")) as folder:
        (folder / "forest.svg").touch()
    assert {path.name for path in tmp_path.iterdir()} == {
        *("forest.svg", "mine.csv", "mine-forest.txt")
    }


def test_the_csv_has_every_comparison(found):
    lines = list(csv.DictReader(io.StringIO(records(found))))
    of = [line for line in lines if line["line"] == "ahead"]
    assert [line["problems"] for line in of] == [
        ALL, *PROBLEMS, *(f"without {problem}" for problem in PROBLEMS)
    ]  # fmt: skip
    assert (of[0]["blocks"], of[0]["verdict"], of[0]["rank"]) == ("15", "better", "1")


def test_many_lines_stay_legible(tmp_path):
    rng = np.random.default_rng(0)
    rows = suite_rows({f"method_{i}": float(rng.normal(0, 3)) for i in range(34)}, seeds=2)
    fail(next(row for row in rows if row["method"] == "method_3"))
    found = judge(rows, "method", CONTROL)
    for draw in (forest, bands, profiles):
        assert draw(found, tmp_path, "figure")
        drawing = (tmp_path / "figure.svg").read_text()
        shown = sum(f">method_{i}<" in drawing for i in range(34))
        assert shown == (LEADERS if draw is profiles else 34)
    colors = [look.color for _, look in highlighted(found)]
    assert len(colors) == 35
    assert len(set(colors)) == LEADERS + 2  # and the control's, and gray


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved."""
    kept = []
    monkeypatch.setattr(verdict_plots, "save", lambda figure, *_: kept.append(figure))
    return kept


@pytest.mark.parametrize("draw", [forest, bands, profiles])
def test_a_legend_of_all_verdicts_fits(drawn, tmp_path, draw):
    lines = {f"method_{i}": (3.0, 0.0, -3.0, 0.8)[i % 4] for i in range(12)}
    found = judge(suite_rows(lines, noise=1.5), "method", CONTROL)
    assert {line.comparison.verdict for line in found.lines} == set(VERDICTS)
    assert draw(found, tmp_path, "figure")
    (figure,) = drawn
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert (box.x0, box.y0) >= (0, 0)
    assert box.x1 <= figure.bbox.width
    assert box.y1 <= figure.bbox.height


def test_an_interval_that_goes_on_out_of_view_has_an_arrow(drawn, tmp_path):
    rows = suite_rows({**{f"method_{i}": i / 10 for i in range(12)}, "far": -40.0, "wide": 0.0})
    for row in rows:
        if row["method"] == "wide" and row["seed"] == 0:
            row["metric"]["delta.gain"] -= 8
    assert "an arrow: it goes on further out" in forest(
        judge(rows, "method", CONTROL), tmp_path, "forest"
    )
    (axes,) = (axes for axes in drawn[0].axes if axes.get_title() == ALL)
    marks = {line.get_marker() for line in axes.lines}
    arrows = [line for line in axes.lines if line.get_marker() == "<"]
    assert ({"o", "<"} <= marks, len(arrows)) == (True, 2)
    assert [text.get_text() for text in axes.texts] == ["-40"]


def test_a_mean_without_an_interval_is_hollow(drawn, tmp_path):
    rows = [
        row
        for row in suite_rows({"one": 0.0, "whole": 0.0})
        if row["method"] != "one" or row["seed"] == 0
    ]
    caption = forest(judge(rows, "method", CONTROL), tmp_path, "forest")
    assert "Hollow: a single run of a problem" in caption
    faces = [
        line.get_markerfacecolor() for line in drawn[0].axes[-1].lines if line.get_marker() == "o"
    ]
    assert [face == "white" for face in faces].count(True) == 1
    rows = [row for row in rows if row["method"] != "one"]
    assert "Hollow" not in forest(judge(rows, "method", CONTROL), tmp_path, "forest")


def test_cells_of_a_suite_without_numbers_name_their_problem(rows):
    rows = json.loads(json.dumps(rows))
    fail(rows[0])
    table = fill(tabulate(rows[:1], Layout(rows="method", control=CONTROL), problem="scales"))
    (section,) = table.lacking
    assert section.lines[0].cells[0].text == "scales: baseline, seed 0"


def test_many_cells_that_lack_numbers_for_one_reason_share_a_line(rows):
    rows = json.loads(json.dumps(rows))
    for row in rows[:8]:
        row["status"], row["error"] = "missing", "its trials have not ended"
    fail(rows[8])
    table = fill(tabulate(rows[:9], Layout(rows="method", control=CONTROL), problem="scales"))
    (section,) = table.lacking
    assert [line.cells[1].text for line in section.lines] == ["missing", "failed"]
    assert section.lines[0].cells[0].text.startswith("scales: 8 cells, ")


def test_profiles_say_how_many_runs_are_out_of_view(tmp_path):
    rows = suite_rows({**{f"method_{i}": 0.0 for i in range(4)}, "far": -40.0})
    said = profiles(judge(rows, "method", CONTROL), tmp_path, "profiles")
    assert "Out of view: 15 below of 90 runs." in said
    rows = [row for row in rows if row["method"] != "far"]
    assert "Out of view" not in profiles(judge(rows, "method", CONTROL), tmp_path, "profiles")


def test_no_figure_where_there_is_nothing_to_show(tmp_path):
    rows = suite_rows({"other": 0.0}, seeds=2)
    for row in rows:
        if row["method"] == "other":
            fail(row)
    found = judge(rows, "method", CONTROL)
    assert forest(found, tmp_path, "forest") is None
    assert profiles(found, tmp_path, "profiles")
