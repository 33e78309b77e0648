import dataclasses
import hashlib

import pytest

from mtl_bench.bench import grid as grids
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.jobs import CELLS, with_parents
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, check_cells, load_recipe

GRID = """question = "Does it work?"
recipe = "smoke"

[axes]
backbone = ["a", "b"]
method = ["m"]
seed = [0, 1]
"method.alpha" = [0.5, 1.5]

[[skip]]
backbone = "b"
"method.alpha" = 1.5
why = "too large"

[report]
rows = "backbone"
"""


@pytest.fixture
def write(tmp_path):
    def write(text=GRID):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return str(path)

    return write


def test_shipped_grids_expand_and_name_existing_plugins():
    assert "backbones" in grids.grid_names()
    for name in grids.grid_names():
        if load_grid(name).kind is not CELLS:
            continue
        grid = load_grid(name)
        assert grid.name == name
        assert all(cell.recipe.smoke for cell in load_grid(name, smoke=True).cells)
        assert grid.question.endswith("?")
        assert grids.question_of(name) == grid.question
        assert grid.cells
        check_cells([*grid.cells, *(skip.job for skip in grid.skips)])


def test_a_grid_may_name_its_smoke_recipe(write):
    text = GRID.replace('recipe = "smoke"', 'recipe = "small"\nsmoke_recipe = "kitti-smoke"')
    grid = load_grid(write(text), smoke=True)
    assert (grid.name, grid.recipe.name) == ("mine-smoke", "kitti-smoke")
    assert load_grid(write(text)).recipe.name == "small"


def test_backbones_grid_is_the_papers_method_over_four_backbones():
    grid = load_grid("backbones")
    assert grid.recipe.name == "small"
    assert len({cell.backbone for cell in grid.cells}) == len(grid.cells) == 4
    assert len({(cell.method, cell.seed, cell.recipe) for cell in grid.cells}) == 1
    assert grid.report["rows"] == "backbone"


def test_product_has_the_first_axis_slowest(write):
    grid = load_grid(write())
    points = [(c.backbone, c.seed, c.method_args["alpha"]) for c in grid.cells]
    assert points == [
        ("a", 0, 0.5), ("a", 0, 1.5), ("a", 1, 0.5), ("a", 1, 1.5), ("b", 0, 0.5), ("b", 1, 0.5),
    ]  # fmt: skip
    assert grid.name == "mine"
    assert grid.question == "Does it work?"


def test_skipped_cells_keep_their_reason(write):
    skips = load_grid(write()).skips
    assert [(s.job.backbone, s.job.seed, s.why) for s in skips] == [
        ("b", 0, "too large"),
        ("b", 1, "too large"),
    ]


def test_seeds_replace_the_axis(write):
    grid = load_grid(write(), seeds=3)
    assert [c.seed for c in grid.cells if c.backbone == "b"] == [0, 1, 2]
    assert [c.seed for c in load_grid("backbones", seeds=2).cells] == [0, 1] * 4
    with pytest.raises(ValueError, match="at least 1"):
        load_grid("backbones", seeds=0)


def test_settings_reach_every_cell_and_replace_an_axis(write):
    grid = load_grid(write(), settings=["recipe.optim.lr=0.5", "method.alpha=0.25"])
    assert {cell.recipe.optim.lr for cell in grid.cells} == {0.5}
    assert {cell.method_args["alpha"] for cell in grid.cells} == {0.25}
    assert len(grid.cells) == 4


def test_smoke_is_another_name_and_other_cells():
    smoke, real = load_grid("backbones", smoke=True), load_grid("backbones")
    assert smoke.name == "backbones-smoke"
    assert all(cell.recipe.smoke for cell in smoke.cells)
    assert not {cell.id for cell in smoke.cells} & {cell.id for cell in real.cells}


def test_recipe_in_place_of_the_grids_and_as_an_axis(write):
    assert load_grid("backbones", recipe="medium").recipe.name == "medium"
    path = write(GRID.replace("seed = [0, 1]", 'recipe = ["smoke", "small"]'))
    assert {cell.recipe.name for cell in load_grid(path).cells} == {"smoke", "small"}
    assert {cell.recipe.name for cell in load_grid(path, smoke=True).cells} == {"smoke"}


def test_equal_cells_count_once(write):
    grid = load_grid(write(GRID.replace('backbone = ["a", "b"]', 'backbone = ["a", "a"]')))
    assert len(grid.cells) == len({cell.id for cell in grid.cells}) == 4


def test_all_plugins_of_a_kind(write):
    grid = load_grid(write(GRID.replace('method = ["m"]', 'method = "all"')))
    assert {cell.method for cell in grid.cells} == set(plugins.files("methods"))


def test_lists_and_booleans_as_values(write):
    tasks = 'tasks = [["panoptic"], ["panoptic", "depth"]]'
    grid = load_grid(write(GRID.replace("seed = [0, 1]", f"{tasks}\nvideo = [true]")))
    assert {cell.tasks for cell in grid.cells} == {("panoptic",), ("panoptic", "depth")}
    assert all(cell.video for cell in grid.cells)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("question =", "qestion =", r"mine.toml, line 1: .*'qestion' \(did you mean 'question'"),
        ("[report]", "[reports]", r"line 15: unknown key 'reports' \(did you mean 'report'"),
        ("seed = [", "sed = [", r"line 7: unknown key 'sed' \(did you mean 'seed'"),
        ('"method.alpha" = [', '"recipe.optm.lr" = [', r"line 8: .*did you mean 'optim'"),
        ("seed = [0, 1]", 'seed = ["x"]', r"line 7: 'seed' must be int, not 'x'"),
        ("seed = [0, 1]", "seed = 3", r"line 7: axis 'seed' is a list of values, not 3"),
        ("seed = [0, 1]", "seed = []", r"line 7: axis 'seed' is a list"),
        ('method = ["m"]\n', "", r"line 4: 'method' is missing"),
        ('why = "too large"\n', "", r"line 10: a \[\[skip\]\] needs its reason"),
        ('backbone = "b"', 'bone = "b"', r"line 11: unknown key 'bone'"),
        ("seed = [0, 1]", "seed = [0, 1", r"mine.toml: .*line \d+"),
        ('recipe = "smoke"', 'recipe = "smok"', r"no recipe called 'smok' \(did you mean 'smoke'"),
    ],
)
def test_mistakes_come_with_file_and_line(write, old, new, message):
    assert old in GRID
    with pytest.raises(ValueError, match=message):
        load_grid(write(GRID.replace(old, new, 1)))


# --- rows -----------------------------------------------------------------------------------------

ROWS = """question = "Does it work?"
recipe = "smoke"

[axes]
backbone = ["a", "b"]
seed = [0, 1]

[[row]]
name = "First"
method = "m"
"method.weights" = { center = 2.0 }

[[row]]
name = "Second"
method = "n"  # [[row]]
video = true
"recipe.optim.steps" = "2x"

[[row]]
name = "Third"
method = "m"
single_task = true

[baseline]
method = "k"
single_task = true
"""


def test_rows_are_the_fastest_and_named(write):
    grid = load_grid(write(ROWS))
    points = [(c.backbone, c.seed, grid.names[c.id]) for c in grid.cells]
    names = ("First", "Second", "Third")
    assert points == [(b, s, name) for b in "ab" for s in (0, 1) for name in names]
    first, second, third = grid.cells[:3]
    assert first.method_args == {"weights": {"center": 2.0}}
    assert (second.method, second.video, third.single_task) == ("n", True, True)
    assert first.recipe == third.recipe == grid.recipe


def test_rows_alone_and_all_rows_of_a_seed_first(write):
    rows = ROWS.replace('backbone = ["a", "b"]\n', "").replace(
        "method =", 'backbone = "a"\nmethod ='
    )
    grid = load_grid(write(rows.split("[baseline]")[0]), seeds=2)
    assert [c.seed for c in grid.cells] == [0, 0, 0, 1, 1, 1]
    assert grid.baseline == {}


def test_a_factor_multiplies_the_recipes_number_whatever_it_is(write):
    def steps(**given):
        cells = load_grid(write(ROWS), **given).cells
        return [cell.recipe.optim.steps for cell in cells[:2]]

    smoke, small = (load_recipe(name).optim.steps for name in ("smoke", "small"))
    assert steps() == [smoke, 2 * smoke]
    assert steps(recipe="small") == [small, 2 * small]
    assert steps(settings=["recipe.optim.steps=11"]) == [11, 22]
    text = ROWS.replace('"recipe.optim.steps" = "2x"', '"recipe.optim.lr" = "0.5x"')
    lr = load_recipe("smoke").optim.lr
    assert load_grid(write(text)).cells[1].recipe.optim.lr == lr / 2


def test_a_factor_is_for_numbers_only(write):
    text = ROWS.replace('"recipe.optim.steps"', '"recipe.evaluate.split"')
    assert load_grid(write(text)).cells[1].recipe.evaluate.split == "2x"
    text = ROWS.replace('"recipe.optim.steps"', '"recipe.optim.micro_batch"')
    with pytest.raises(ValueError, match=r"line 17: .*micro_batch' must be int, not '2x'"):
        load_grid(write(text))


def test_recipe_of_a_row_gives_way_to_the_commands(write):
    text = ROWS.replace("video = true", 'recipe = "medium"')
    assert [c.recipe.name for c in load_grid(write(text)).cells[:2]] == ["smoke", "medium"]
    assert {c.recipe.name for c in load_grid(write(text), recipe="small").cells} == {"small"}


def test_baseline_keeps_recipe_backbone_and_seed_only(write):
    grid = load_grid(write(ROWS))
    first, second, _ = grid.cells[:3]
    assert grid.baseline == {"method": "k", "single_task": True}
    base = grids.baseline_cell(first, grid.baseline)
    assert base == Cell(first.recipe, "a", "k", single_task=True)
    weighed = dataclasses.replace(grid.cells[-2], granularity="tasks", tasks=("panoptic",))
    base = grids.baseline_cell(weighed, grid.baseline)
    assert base == Cell(second.recipe, "b", "k", seed=1, single_task=True)


def test_parents_come_first_each_once():
    plain = Cell(load_recipe("smoke"), "b", "m")
    panoptic, depth = (dataclasses.replace(plain, tasks=(task,)) for task in ("panoptic", "depth"))
    apart, video = (dataclasses.replace(plain, **{k: True}) for k in ("single_task", "video"))
    assert with_parents([apart, plain, video]) == (panoptic, depth, apart, plain, video)
    assert with_parents([video, plain, depth]) == (plain, video, depth)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('method = "n"', 'metod = "n"', r"line 14: 'method' is missing"),
        ("video = true", "vido = true", r"line 16: unknown key 'vido' \(did you mean 'video'"),
        ("video = true", "video = 3", r"line 16: 'video' must be bool, not 3"),
        ("video = true", "method_args = 3", r"line 16: 'method_args' cannot be set"),
        ("video = true", "seed = 3", r"line 16: 'seed' is an axis"),
        ("video = true", 'recipe = "smal"', r"line 16: no recipe called 'smal'"),
        ("video = true", "recipe.optim.lr = 1", 'line 16: quote a key with dots: "recipe.optim"'),
        ("seed = [0, 1]", "method.alpha = [1]", 'line 6: quote a key with dots: "method.alpha"'),
        ("single_task = true", "single_task = true\nvideo = true", "line 19: single_task and"),
        ('name = "Second"', 'name = "First"', r"line 14: two rows are called 'First'"),
        ('name = "Second"\n', "", r"line 13: a \[\[row\]\] needs its name"),
        ('name = "Third"', 'name = "Third"\n[base2]', r"line 21: unknown key 'base2'"),
        ('method = "k"', 'metod = "k"', r"line 25: unknown key 'metod' \(did you mean 'method'"),
        ("[baseline]", "[[baseline]]", r"line 24: write it as \[baseline\], a section"),
        ("[axes]", "[[axes]]", r"line 4: write it as \[axes\], a section"),
    ],
)
def test_mistakes_in_rows_come_with_the_line_of_their_own_table(write, old, new, message):
    assert old in ROWS
    with pytest.raises(ValueError, match=message):
        load_grid(write(ROWS.replace(old, new, 1)))


def test_a_single_bracketed_row_is_told(write):
    text = ROWS.split('[[row]]\nname = "Second"')[0].replace("[[row]]", "[row]")
    with pytest.raises(ValueError, match=r"line 8: write it as \[\[row\]\], two brackets"):
        load_grid(write(text))


def test_two_rows_of_the_same_cell_are_an_error_that_names_both(write):
    second = ROWS.split("[[row]]")[2].replace('"2x"', '"1x"').replace("video = true\n", "")
    text = ROWS.split("[[row]]")[0] + "[[row]]\nname = 'First'\nmethod = 'n'\n[[row]]" + second
    with pytest.raises(ValueError, match=r"line 12: rows 'First' and 'Second' are the same cell"):
        load_grid(write(text))
    with pytest.raises(ValueError, match=r"rows 'Multi-Task Baseline' and '\+ Uncertainty' are"):
        load_grid("ablation", settings=["method=m"])


# --- the shipped ones -----------------------------------------------------------------------------


def test_the_ablation_has_the_papers_rows():
    grid = load_grid("ablation")
    names = ["Single-Task Baseline", "Multi-Task Baseline", "+ Uncertainty", "+ Video Sequence"]
    assert [grid.names[cell.id] for cell in grid.cells] == names
    apart, together, uncertainty, video = grid.cells
    assert apart.parents[0].tasks == ("panoptic",)
    assert video.parents == (uncertainty,)
    assert len(with_parents(grid.cells)) == 6
    assert all(grids.baseline_cell(cell, grid.baseline) == apart for cell in grid.cells)
    assert together.method_args == {}


@pytest.mark.parametrize("recipe", ["smoke", "small", "cityscapes"])
def test_the_controls_halve_and_double_under_any_recipe(recipe):
    from mtl_bench.core.task import tasks_of_cell

    grid = load_grid("ablation-controls", recipe=recipe)
    cells = {grid.names[cell.id]: cell for cell in grid.cells}
    terms = [term for task in tasks_of_cell(grid.cells[0]) for term in task.terms]
    halved = cells["Fixed, regression halved"].method_args["weights"]
    assert halved == {t.name: t.fixed_weight / 2 for t in terms if t.kind == "regression"}
    twice = cells["+ Uncertainty, twice the iterations"].recipe.optim.steps
    assert twice == 2 * load_recipe(recipe).optim.steps
    assert cells["Fixed + Video Sequence"].parents == (cells["Multi-Task Baseline"],)


def test_unknown_grid():
    with pytest.raises(ValueError, match=r"'backbone' \(did you mean 'backbones'\?\)"):
        load_grid("backbone")
    with pytest.raises(ValueError, match=r"no grid called 'none/such.toml'"):
        load_grid("none/such.toml")


IDS = [  # digests of all ids of a shipped grid, and of its smoke run: what was run is found by them
    ("ablation", "6535b5af648b", "25ce0926b98a"),
    ("ablation-controls", "a482d5c2ca74", "8ef8a73b2110"),
    ("backbones", "894e450b868b", "aed5ec2cac11"),
    ("kitti", "43149427a83e", "502da380f4d0"),
    ("latency", "538ae995d124", "3ec8f9a10500"),
    ("seeds", "694e6769b028", "9b0f88f5d5f1"),
    ("weighting", "054b497ef58a", "2a5e2efd9ba8"),
]


@pytest.mark.parametrize(("name", "whole", "smoke"), IDS)
def test_no_id_of_a_shipped_grid_changes(name, whole, smoke):
    for digest, brief in ((whole, False), (smoke, True)):
        ids = sorted(job.id for job in load_grid(name, smoke=brief).jobs)
        assert hashlib.sha256(" ".join(ids).encode()).hexdigest()[:12] == digest
