import pytest

from mtl_bench import grids, plugins
from mtl_bench.grids import load_grid

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
        grid = load_grid(name)
        assert grid.name == name
        assert grid.question.endswith("?")
        assert grids.question_of(name) == grid.question
        assert grid.cells
        plugins.check_cells([*grid.cells, *(skip.cell for skip in grid.skips)])


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
    assert [(s.cell.backbone, s.cell.seed, s.why) for s in skips] == [
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
    text = GRID.replace("seed = [0, 1]", 'tasks = [["panoptic"], ["depth"]]\nvideo = [true]')
    grid = load_grid(write(text))
    assert {cell.tasks for cell in grid.cells} == {("panoptic",), ("depth",)}
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
        ('method = ["m"]\n', "", r"line 4: axis 'method' is missing"),
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


def test_unknown_grid():
    with pytest.raises(ValueError, match=r"'backbone' \(did you mean 'backbones'\?\)"):
        load_grid("backbone")
    with pytest.raises(ValueError, match=r"no grid called 'none/such.toml'"):
        load_grid("none/such.toml")
