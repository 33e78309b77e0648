"""What trials may set, and what is drawn."""

import math
from dataclasses import replace

import pytest
from support.tuned import GRID, grid_file

from mtl_bench.bench.check import check
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.space import Tune, draws
from mtl_bench.core import plugins
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
        ('"recipe.evaluate.split" = ["test"]', "cannot set 'recipe.evaluate.split', only what"),
        ('"recipe.data.val_scenes" = [3, 4]', "cannot set 'recipe.data.val_scenes', only what"),
        ("seed = [0, 1]", "cannot set 'seed', only what begins with recipe.augment., "),
        ('method = ["rlw"]', "cannot set 'method', only what begins with "),
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
        ("trials = 3", "space = 3", "write it as .tune.space., a section, not 3"),
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


# --- what a method declares -----------------------------------------------------------------------

BASE = """
from mtl_bench.core.method import LossMethod

LOW = 1.0


class Power(LossMethod):
    space = {}

    def __init__(self, terms, seed=0, power=2.0):
        super().__init__(terms, seed)
        self.power = power

    def total(self, step):
        return step.loss_K.pow(self.power).sum()
"""
HEIR = (
    '"""Powers.\n\nSource: a test.\n"""\n\nfrom ._power import Power\n\n\nclass Heir(Power):\n    '
)
SPACE = '{"power": {"uniform": [1.0, 4.0]}}'


@pytest.fixture
def heir_of(tmp_path, monkeypatch):
    """A method `heir` whose base, a helper beside it, has a space; what is in its own body."""
    monkeypatch.setenv(plugins.VARIABLE, "")

    def write(space, body="pass"):
        folder = tmp_path / "mine" / "methods"
        folder.mkdir(parents=True)
        (folder / "_power.py").write_text(BASE.replace("space = {}", f"space = {space}"))
        (folder / "heir.py").write_text(f"{HEIR}{body}\n")
        plugins.add_folder(tmp_path / "mine")
        return folder / "heir.py"

    return write


def test_a_subclass_has_the_space_of_its_base_unless_it_has_its_own(heir_of):
    path = heir_of(SPACE)
    cell = replace(CELL, method="heir")
    assert all(1.0 <= values["method.power"] <= 4.0 for values in draws(Tune(), cell)[1:])
    assert [result.detail for result in check("methods", "heir") if not result.ok] == []
    path.write_text(f"{HEIR}space = {{'power': [3.0]}}\n")
    plugins.fingerprint("methods", "heir")  # an open session sees an edited file
    assert {values["method.power"] for values in draws(Tune(), cell)[1:]} == {3.0}


@pytest.mark.parametrize("where", ["base", "heir"])
@pytest.mark.parametrize(
    ("space", "said"),
    [
        ("{'power': {'uniform': [LOW, 4.0]}}", "cannot be read without running it; write its"),
        ("['power']", "space is {HYPER-PARAMETER: VALUES, ...}, not ['power']"),
        ("{'powr': [1.0]}", "'powr', no argument of the constructor (did you mean 'power'?)"),
        ("{'power': []}", 'in space, "power" is a list of values'),
    ],
)
def test_a_space_that_trials_cannot_draw_from_is_refused(heir_of, tmp_path, where, space, said):
    own = "from ._power import LOW\n    "
    path = heir_of(*((space,) if where == "base" else (SPACE, f"{own}space = {space}")))
    with pytest.raises(ValueError) as caught:
        load_grid(grid_file(tmp_path, GRID.replace('"cagrad"', '"heir"')))
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)
    (failed,) = [result for result in check("methods", "heir") if not result.ok]
    assert failed.name == "space of hyper-parameters"
    assert said in failed.detail


def test_check_tells_a_space_that_the_file_does_not_show(heir_of):
    heir_of(SPACE, "locals()['space'] = {'power': [9.0]}")
    (failed,) = [result for result in check("methods", "heir") if not result.ok]
    assert "and the class has {'power': [9.0]}" in failed.detail
