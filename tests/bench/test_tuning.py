"""Trials of a tuned grid: how many, how judged, what they choose, what is run and reported."""

import math

import pytest
from support.tuned import GRID, fail, finish, grid_file
from typer.testing import CliRunner

from mtl_bench.bench import store, tuning
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.jobs import with_parents
from mtl_bench.cli import grid as commands
from mtl_bench.cli.app import app
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, load_recipe


@pytest.fixture
def grid(tmp_path):
    return load_grid(grid_file(tmp_path))


def of(grid, line):
    return [trial for trial in tuning.trials(grid) if trial.line == line]


# --- trials and choice ----------------------------------------------------------------------------


def test_every_line_has_as_many_trials_judged_on_val_with_seeds_of_their_own(grid):
    lines = [trial.line for trial in tuning.trials(grid)]
    assert {line: lines.count(line) for line in lines} == dict.fromkeys(
        ["fixed", "scalarised", "cagrad", "single-task"], 3
    )
    assert all(trial.cell.recipe.evaluate.split == "val" for trial in tuning.trials(grid))
    assert all(trial.cell.recipe.latency.passes == 0 for trial in tuning.trials(grid))
    assert {trial.cell.seed for trial in tuning.trials(grid)} == {100}
    assert {trial.problem for trial in tuning.trials(grid)} == {"conflict"}
    assert len({trial.cell.id for trial in tuning.trials(grid)}) == 12


def test_the_best_trial_is_chosen_and_ties_go_to_the_lower_number(grid, tmp_path):
    for trial, error in zip(of(grid, "cagrad"), (0.5, 0.25, 0.25), strict=True):
        finish(trial.cell, tmp_path, error)
    found = tuning.chosen(grid, tmp_path)
    assert set(found) == {("cagrad", "conflict")}  # the others are not tried yet
    choice = found["cagrad", "conflict"]
    assert choice.trial.number == 1
    assert choice.score == pytest.approx(100 * math.log(4))
    scores = {t.trial.number: t for t in tuning.tried(grid, tmp_path) if t.trial.line == "cagrad"}
    assert scores[0].score == pytest.approx(100 * math.log(2))
    assert scores[0].task_scores["regress:c2"] == pytest.approx(100 * math.log(2))
    assert scores[0].seconds == 36.0
    assert all(math.isnan(t.score) for t in tuning.tried(grid, tmp_path) if t.trial.line == "fixed")


def test_a_failed_trial_is_the_worst_and_where_all_failed_the_published_setting_stands(
    grid, tmp_path
):
    first, second, third = (trial.cell for trial in of(grid, "cagrad"))
    fail(first, tmp_path)
    finish(second, tmp_path, 100.0)
    fail(third, tmp_path)
    assert tuning.chosen(grid, tmp_path)["cagrad", "conflict"].trial.number == 1
    for trial in of(grid, "fixed"):
        fail(trial.cell, tmp_path)
    choice = tuning.chosen(grid, tmp_path)["fixed", "conflict"]
    assert (choice.trial.number, choice.score) == (0, -math.inf)


def test_a_single_task_trial_fails_with_one_of_its_networks(grid, tmp_path):
    single = of(grid, "single-task")
    for trial in single[1:]:
        finish(trial.cell, tmp_path, 2.0)
    assert ("single-task", "conflict") not in tuning.chosen(grid, tmp_path)
    fail(single[0].cell.parents[2], tmp_path)
    assert tuning.chosen(grid, tmp_path)["single-task", "conflict"].trial.number == 1


def test_a_score_is_the_mean_over_the_seeds_of_the_trials(tmp_path):
    grid = load_grid(grid_file(tmp_path, GRID.replace("[100]", "[100, 101]")))
    trials = of(grid, "cagrad")
    assert [trial.number for trial in trials] == [0, 0, 1, 1, 2, 2]
    for trial, error in zip(trials, (1, 1, 0.5, 3, 0.9, 0.9), strict=True):
        finish(trial.cell, tmp_path, error)
    choice = tuning.chosen(grid, tmp_path)["cagrad", "conflict"]
    assert choice.trial.number == 2
    assert choice.score == pytest.approx(-100 * math.log(0.9))


def test_a_metric_that_a_trial_lacks_or_that_is_no_number_makes_it_the_worst(grid, tmp_path):
    for trial, error in zip(of(grid, "cagrad"), (5.0, 4.0, math.nan), strict=True):
        finish(trial.cell, tmp_path, error)
    assert tuning.chosen(grid, tmp_path)["cagrad", "conflict"].trial.number == 1


def test_where_no_trial_of_a_problem_has_a_number_the_published_settings_stand(grid, tmp_path):
    for trial in tuning.trials(grid):
        finish(trial.cell, tmp_path, math.nan)
    choices = tuning.chosen(grid, tmp_path).values()
    assert {(choice.trial.number, choice.score) for choice in choices} == {(0, -math.inf)}


def test_results_have_the_chosen_settings_the_grids_seeds_and_the_recipes_split(grid, tmp_path):
    for trial, error in zip(of(grid, "cagrad"), (1.0, 2.0, 0.5), strict=True):
        finish(trial.cell, tmp_path, error)
    found = tuning.finals(grid, tmp_path)
    assert [(final.line, final.cell.seed) for final in found] == [("cagrad", 0), ("cagrad", 1)]
    values = of(grid, "cagrad")[2].values
    for final in found:
        assert final.cell.recipe.evaluate.split == "test"
        assert final.cell.recipe.optim.lr == values["recipe.optim.lr"]
        assert final.cell.method_args == {"c": values["method.c"]}
        assert final.base in grid.cells
    read = [c.recipe.evaluate.split for c in with_parents([t.cell for t in tuning.trials(grid)])]
    assert set(read) == {"val"}  # nothing but results reads the split test


# --- suites ---------------------------------------------------------------------------------------

SUITE = GRID.replace('recipe = "conflict"', 'suite = ["scales", "conflict"]').replace(
    'backbone = ["mlp"]\n', ""
)


def test_a_suites_recipes_bring_their_backbones_and_the_first_axis_is_the_recipe(tmp_path):
    text = SUITE.replace('"scales"', '{ recipe = "digits", "recipe.optim.steps" = 7 }')
    grid = load_grid(grid_file(tmp_path, text))
    assert [(c.recipe.name, c.backbone) for c in grid.cells[::6]] == [
        ("digits", "lenet"),
        ("conflict", "mlp"),
    ]
    assert {c.recipe.optim.steps for c in grid.cells if c.recipe.name == "digits"} == {7}
    assert tuning.problems(grid) == ("digits", "conflict")
    assert len(tuning.trials(grid)) == 24


def test_recipe_takes_one_problem_of_a_suite_as_the_suite_has_it(tmp_path):
    text = SUITE.replace('"scales"', '{ recipe = "digits", "recipe.optim.steps" = 7 }')
    file = grid_file(tmp_path, text)
    whole, part = load_grid(file), load_grid(file, recipe="digits")
    assert [c.id for c in part.cells] == [c.id for c in whole.cells[:6]]


@pytest.mark.parametrize(("text", "cells"), [(SUITE, 6), (GRID, 3)], ids=["suite", "recipe"])
def test_a_smoke_run_is_short(tmp_path, text, cells):
    grid = load_grid(grid_file(tmp_path, text), smoke=True)
    assert grid.name == "mine-smoke"
    assert {c.recipe.name for c in grid.cells} <= {"scales", "conflict"}
    assert all(c.recipe.smoke and c.recipe.optim.steps == 6 for c in grid.cells)
    assert (len(grid.cells), grid.tune.trials) == (cells, 2)


@pytest.mark.parametrize(
    ("suite", "said"),
    [
        ('["small"]', 'recipe small names no backbone: { recipe = "small", backbone = "NAME" }'),
        ('["smal"]', "no recipe called 'smal'"),
        ("[3]", "a suite lists recipes"),
        ('[{ backbone = "mlp" }]', "a suite lists recipes"),
        ('[{ recipe = "scales", "recipe.optim.rate" = 1 }]', "unknown key"),
        ("[]", 'line 2: a suite needs a recipe: suite = ["NAME", ...]'),
        ('["scales", { recipe = "scales", seed = 4 }]', "'scales' stands twice in the suite"),
        ('["scales"]\nrecipe = "conflict"', "line 3: leave out 'recipe': the suite names"),
        ('["scales"]\nsmoke_recipe = "smoke"', "line 3: leave out 'smoke_recipe': the suite"),
        ('["scales"]\n[[row]]\nname = "a"\nrecipe = "digits"', "line 5: leave out 'recipe'"),
    ],
)
def test_a_wrong_suite_is_told_with_its_line(tmp_path, suite, said):
    file = grid_file(tmp_path, SUITE.replace('["scales", "conflict"]', suite))
    with pytest.raises(ValueError) as caught:
        load_grid(file)
    assert said in str(caught.value)


def test_the_leaderboard_has_every_method_on_five_problems_and_one_budget():
    grid = load_grid("leaderboard", seeds=1)
    assert tuning.problems(grid) == ("scales", "conflict", "digits", "dense-small", "small")
    assert len(grid.cells) == 5 * len(plugins.files("methods"))
    assert all(cell.recipe.evaluate.split == "test" for cell in grid.cells)
    trials = tuning.trials(load_grid("leaderboard", recipe="digits", seeds=1))
    lines = [trial.line for trial in trials]
    assert set(map(lines.count, lines)) == {6}
    assert set(lines) == {*plugins.files("methods"), "single-task"}


# --- the commands ---------------------------------------------------------------------------------

BETTER = {"fixed": 1.0, "scalarised": 0.98, "cagrad": 0.9, "rlw": 1.1}


def error_of(cell: Cell):
    """Of made-up results: better by method, worse far from a rate, and a little by chance."""
    rate = abs(math.log10(cell.recipe.optim.lr / 1e-3))
    chance = 0.002 * (int(cell.id, 16) % 7)
    return (BETTER[cell.method] + 0.1 * cell.single_task) * (1 + 0.2 * rate) + chance


@pytest.fixture
def ran(monkeypatch):
    """Cells in place of whose training a row is made up; and how many before Ctrl-C."""
    cells, stop = [], [10**6]

    def run(grid, todo, runs, *given):
        for cell in todo:
            if len(cells) == stop[0]:
                raise KeyboardInterrupt
            cells.append(cell)
            finish(cell, runs, error_of(cell))

    monkeypatch.setattr(commands, "_run", run)
    monkeypatch.setattr("mtl_bench.bench.references.measure_trivial", lambda *a, **k: None)
    return cells, stop


def call(word, file, folder, *more):
    where = ["--runs", str(folder / "runs")]
    where += ["--reports", str(folder / "reports")] if word == "ablate" else []
    return CliRunner().invoke(app, [word, "--grid", file, *where, *more])


def test_ablate_tries_chooses_and_reports_and_a_second_start_goes_on(tmp_path, ran):
    cells, stop = ran
    seeds = GRID.replace("[0, 1]", "[0, 1, 2, 3, 4, 5, 6]")
    file = grid_file(tmp_path, seeds)
    said = call("ablate", file, tmp_path, "--dry-run").output
    assert "21 results" in said
    assert "before them 12 trials" in said
    assert "conflict: trials: missing 12; results: 28 after their trials; hours left: not" in said

    stop[0] = 20
    assert isinstance(call("ablate", file, tmp_path).exception, (KeyboardInterrupt, SystemExit))
    said = call("status", file, tmp_path).output
    assert "cagrad on conflict, trial 1" in said
    assert "hours left, one after another" in said

    stop[0] = 10**6
    result = call("ablate", file, tmp_path)
    assert result.exit_code == 0, result.output
    assert len(cells) == len({cell.id for cell in cells}) == 4 * 3 + 3 * 8 + 7 * 3 + 7 * 9
    out = tmp_path / "reports" / "mine"
    table = (out / "table.md").read_text()
    assert "Chosen settings" in table
    assert "tuned on every problem by 3 trials" in table
    chosen = load_grid(file)
    number = tuning.chosen(chosen, tmp_path / "runs")["cagrad", "conflict"].trial.number
    assert f"| cagrad | conflict | {number} |" in table
    (verdict,) = [x for x in table.splitlines() if x.startswith("| cagrad") and "better" in x]
    assert "| 7 |" in verdict
    assert "7 seeds" in table
    assert (out / "forest.png").is_file()
    cells.clear()
    assert call("ablate", file, tmp_path).exit_code == 0
    assert cells == []


def test_a_setting_that_a_line_cannot_have_is_told_before_a_trial_runs(tmp_path, ran):
    space = GRID + '[tune.space]\n"method.c" = [0.1]\n'
    result = call("ablate", grid_file(tmp_path, space), tmp_path)
    assert "method 'fixed' has no 'c'" in result.output
    assert ran[0] == []


def test_a_result_is_against_the_tuned_baseline_of_its_seed_and_a_failure_stands(tmp_path, ran):
    file, runs = grid_file(tmp_path, GRID.replace('"cagrad"]', '"rlw"]')), tmp_path / "runs"
    grid = load_grid(file)
    failed = of(grid, "rlw")[1].cell
    fail(failed, runs)
    assert call("ablate", file, tmp_path).exit_code == 0
    assert failed.id not in {cell.id for cell in ran[0]}  # --rerun failed tries it again
    rows, against = tuning.results(grid, runs)
    single = tuning.chosen(grid, runs)["single-task", "conflict"].trial
    assert single.number != 0
    for row in rows:
        baseline = against[row["cell_id"]]
        assert (baseline["seed"], baseline["single_task"]) == (row["seed"], True)
        assert baseline["slug"] in {
            final.cell.slug for final in tuning.finals(grid, runs) if final.line == "single-task"
        }
        assert store.load_row(runs / baseline["slug"]) is not None
        published = load_recipe("conflict").optim.lr
        assert row["cell"]["recipe"]["optim"]["lr"] == published  # the grid's: lines are its own
