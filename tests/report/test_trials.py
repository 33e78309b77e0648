"""Budget curves, trade-offs and distances, of trials made up."""

import csv
import io
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from fake_suite import CONTROL, PROBLEMS, fail, suite_grid, suite_rows, suite_trials

from mtl_bench.bench import tuning
from mtl_bench.bench.space import Tune
from mtl_bench.core import style
from mtl_bench.report import grid as report
from mtl_bench.report import trials
from mtl_bench.report.verdicts import judge, protocol

LINES = {"ahead": 3.0, "same": 0.0, "behind": -3.0}
NAN = math.nan


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Small pictures: drawing is most of a report's time."""
    monkeypatch.setitem(style.SETTINGS, "savefig.dpi", 25)


@pytest.fixture(scope="module")
def found():
    return judge(suite_rows(LINES, seeds=3), "method", CONTROL)


@pytest.fixture(scope="module")
def tried():
    return suite_trials(LINES, failed={("same", 2)})


def of(tried, line, problem):
    return [t for t in tried if (t.trial.line, t.trial.problem) == (line, problem)]


def test_a_curve_is_the_mean_over_all_draws_and_problems(tried):
    """Brute force over every draw of two trials; a failed one is the worst of its problem."""
    curve, seconds = trials._curve(CONTROL, "same", list(PROBLEMS), tuning.ended(tried), 6)
    expected = []
    for problem in PROBLEMS:
        every = [t.score for t in tried if t.trial.problem == problem]
        worst = min(score for score in every if score > -math.inf)
        base = max(t.score for t in of(tried, CONTROL, problem))
        own = [max(t.score, worst) for t in of(tried, "same", problem)]
        assert own[2] == worst
        expected.append(np.mean([max(pair) for pair in itertools.product(own, repeat=2)]) - base)
    assert curve[1] == pytest.approx(np.mean(expected))
    assert seconds == pytest.approx(10 * len(PROBLEMS))  # the failed one has none to tell


def test_trials_of_several_seeds_are_one_setting():
    (one,) = suite_trials({}, 1, {"digits": PROBLEMS["digits"]})
    other = replace(one, score=one.score + 2, task_scores=dict.fromkeys(one.task_scores, 1.0))
    (setting,) = tuning.ended([one, other])[CONTROL, "digits"]
    assert setting.score == one.score + 1
    assert setting.seconds == 20
    assert setting.task_scores == {k: (v + 1) / 2 for k, v in one.task_scores.items()}
    bad = replace(one, score=-math.inf, task_scores={}, seconds=0.0)
    (setting,) = tuning.ended([one, bad])[CONTROL, "digits"]
    assert (setting.score, setting.task_scores) == (-math.inf, {})
    assert tuning.ended([one, replace(one, score=NAN)]) == {}


def test_distances_are_the_least_steps_that_end_being_dominated(found, tried):
    settings = tuning.ended(tried)
    section = trials.distances(found, settings)
    shown = {line.cells[0].text: [c.value for c in line.cells[1:]] for line in section.lines}
    assert list(shown) == ["ahead", "same", "behind"]
    for line, values in shown.items():
        assert values[-1] == pytest.approx(np.mean(values[:-1]))
        for problem, value in zip(PROBLEMS, values, strict=False):
            best = max(of(tried, line, problem), key=lambda t: t.score).task_scores
            front = [list(t.task_scores.values()) for t in of(tried, CONTROL, problem)]
            point = np.array(list(best.values()))
            for step, dominated in ((-1e-6, True), (1e-6, False)):
                ahead = (np.array(front) > point + value + step).all(1).any()
                assert ahead == dominated
    bold = {line.cells[0].text: line.cells[-1].bold for line in section.lines}
    assert (bold["ahead"], bold["behind"]) == (True, False)


def test_a_line_without_a_finished_trial_has_no_distance(found, tried):
    left = [t for t in tried if t.trial.line != "same"]
    bad = [replace(t, score=-math.inf, task_scores={}) for t in tried if t.trial.line == "same"]
    for several in (left, left + bad):
        section = trials.distances(found, tuning.ended(several))
        row = next(line for line in section.lines if line.cells[0].text == "same")
        assert {cell.text for cell in row.cells[1:]} == {"-"}
    assert row is section.lines[-1]


def test_nothing_is_drawn_without_what_it_needs(found, tried, tmp_path):
    settings = tuning.ended(tried)
    others = {key: value for key, value in settings.items() if key[0] != CONTROL}
    one = {key: value[:1] for key, value in settings.items()}
    for lacking in ({}, others, one):
        assert trials.budgets(found, lacking, tmp_path, "x") is None
        assert trials.tradeoff(found, lacking, "digits", tmp_path, "x") is None
        assert trials.distances(found, lacking) is None
    assert list(tmp_path.iterdir()) == []


def test_problems_that_have_not_ended_are_left_out_of_the_curves(found, tried, tmp_path):
    waiting = [replace(t, score=NAN) if t.trial.problem == "dense" else t for t in tried]
    caption = trials.budgets(found, tuning.ended(waiting), tmp_path, "x")
    assert "mean over 2 problems" in caption


def test_the_pairs_are_those_that_trade_most():
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(0, 1, (3, 50))
    scores = np.stack([a, a + 0.1 * b, -a + 0.1 * c, c], 1)
    pairs = trials._pairs(list("abcd"), scores)
    assert set(pairs[:2]) == {(0, 2), (1, 2)}
    assert len(pairs) == trials.PAIRS
    assert trials._pairs(list("ab"), scores[:, :2]) == [(0, 1)]


def test_the_report_of_a_tuned_suite(tried, tmp_path):
    rows = suite_rows(LINES, seeds=3)
    fail(next(row for row in rows if row["method"] == "behind"))
    for row in rows:
        problem = row["cell"]["recipe"]["name"]
        row["tuned"] = {"line": row["method"], "problem": problem, "trial": 1, "failed": False}
        row["tuned"]["values"] = {"recipe.optim.lr": 0.05}
    grid = suite_grid()
    grid.tune = Tune()
    page = report.build(grid, rows, tmp_path, tried=tried).read_text()
    for said in ("tuned on every problem by 6 trials", "n = 9 blocks; family: 3 lines against"):
        assert said in page
        assert said in (tmp_path / "readme.md").read_text()
        assert said in (tmp_path / "table.tex").read_text()
    names = {path.name for path in tmp_path.iterdir()}
    drawn = {"budgets.svg", *(f"{problem}-tradeoff.png" for problem in PROBLEMS)}
    assert drawn | {"trials.csv"} <= names
    assert "Distance to the front of scalarised" in page
    lines = list(csv.DictReader(io.StringIO((tmp_path / "trials.csv").read_text())))
    assert len(lines) == len(tried)
    assert {line["score"] for line in lines if line["trial"] == "2" and line["line"] == "same"} == {
        "-inf"
    }
    assert lines[1]["settings"] == '{"recipe.optim.lr": 0.05}'


def test_an_untuned_comparison_says_so(found):
    assert protocol(found).startswith("Untuned: every line has the settings that the grid gives")
    assert "seeds 0, 1, 2 x 3 problems, n = 9 blocks" in protocol(found)
