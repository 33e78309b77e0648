"""What trials may set, and what is drawn."""

import math
from dataclasses import replace

import pytest
from support.tuned import GRID, grid_file

from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.space import Tune, draws
from mtl_bench.core.config import Cell, load_recipe

CELL = Cell(load_recipe("conflict"), "mlp", "cagrad", granularity="tasks")


def test_the_first_trial_is_the_published_setting_and_the_others_lie_in_the_space():
    first, *others = draws(Tune(trials=30), CELL)
    assert first == {}
    rates = [values["recipe.optim.lr"] / CELL.recipe.optim.lr for values in others]
    assert all(0.056 < rate < 17.9 for rate in rates)
    assert max(rates) / min(rates) > 100  # of 316
    assert {v["recipe.optim.weight_decay"] for v in others} == {0.0, 1e-5, 1e-4}
    assert all(0.1 <= values["method.c"] <= 0.9 for values in others)


def test_what_lines_share_is_drawn_alike_in_every_line_and_for_any_number_of_trials():
    def shared(tune, **changes):
        found = draws(tune, replace(CELL, **changes))[1:]
        return [{k: v for k, v in values.items() if k in tune.space} for values in found]

    six = shared(Tune())
    assert len(six) == 5
    for changes in ({"method": "fixed"}, {"method": "scalarised"}, {"single_task": True}):
        assert shared(Tune(), **changes) == six
    assert shared(Tune(trials=9))[:5] == six


def test_shares_are_of_the_tasks_and_add_up_to_one():
    drawn = [
        v["method.shares"] for v in draws(Tune(trials=40), replace(CELL, method="scalarised"))[1:]
    ]
    assert all(set(shares) == set(CELL.tasks) for shares in drawn)
    assert all(sum(shares.values()) == pytest.approx(1, abs=0.01) for shares in drawn)
    mean = sum(shares["regress:c0"] for shares in drawn) / len(drawn)
    assert mean == pytest.approx(1 / 8, abs=0.05)


def test_what_a_line_sets_itself_is_not_tuned_and_parts_are_set_by_part():
    own = replace(CELL, method_args={"c": 0.2})
    assert "method.c" not in draws(Tune(), own)[1]
    both = draws(Tune(), replace(CELL, method="uncertainty+cagrad"))[1]
    assert {"method.uncertainty.init", "method.cagrad.c"} < set(both)


def test_bounds_may_be_times_the_recipes_number_and_whole():
    space = {"recipe.optim.steps": {"log": ["0.5x", "2x"]}, "recipe.optim.warmup_steps": [10]}
    drawn = draws(Tune(trials=8, space=space), CELL)[1:]
    assert all(type(v["recipe.optim.steps"]) is int for v in drawn)
    steps = CELL.recipe.optim.steps
    assert all(steps / 2 <= v["recipe.optim.steps"] <= 2 * steps for v in drawn)
    logs = [math.log(v["recipe.optim.steps"]) for v in drawn]
    assert min(logs) < math.log(steps) < max(logs)


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ('"recipe.optim.lr" = { log = [1e-3] }', "is a list of values"),
        ('"recipe.optim.lr" = { log = [0.0, 1.0] }', "is a list of values"),
        ('"recipe.optim.lr" = { uniform = [2.0, 1.0] }', "is a list of values"),
        ('"recipe.optim.lr" = []', "is a list of values"),
        ('"recipe.optim.lr" = { about = [1, 2] }', "is a list of values"),
        ("recipe.optim.lr = [1e-3]", "is a list of values"),
        ('"recipe.optim.rate" = [1e-3]', "unknown key"),
        ('"recipe.optim.lr" = ["high"]', "must be float"),
        ('"recipe.optim.clip" = { log = ["0.1x", "2x"] }', "no number"),
    ],
)
def test_a_wrong_space_is_told_with_its_line(tmp_path, where, said):
    file = grid_file(tmp_path, f"{GRID}[tune.space]\n{where}\n")
    with pytest.raises(ValueError, match=said) as caught:
        load_grid(file)
    assert "line 22" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("trials = 3", "trials = 0", "trials' must be >= 1"),
        ("trials = 3", "trial = 3", "unknown key 'tune.trial' .did you mean 'trials'"),
        ("seeds = [100]", "seeds = []", "seeds' must be non-empty"),
        ("seeds = [100]", "seeds = [100, 1]", "seed 1 is a result's, too"),
    ],
)
def test_a_wrong_section_is_told_with_its_line(tmp_path, old, new, said):
    with pytest.raises(ValueError, match=said) as caught:
        load_grid(grid_file(tmp_path, GRID.replace(old, new)))
    assert f"line {GRID[: GRID.index(old)].count(chr(10)) + 1}" in str(caught.value)


def test_a_recipe_that_reports_the_split_of_the_trials_is_refused(tmp_path):
    file = grid_file(tmp_path, GRID.replace('"conflict"', '"small"').replace('"mlp"', '"resnet18"'))
    with pytest.raises(ValueError, match="recipe small reports its split val: set "):
        load_grid(file)
    assert load_grid(file, settings=["recipe.evaluate.split=test"]).tune is not None
