import json
from dataclasses import replace

import pytest

from mtl_bench.core import config
from mtl_bench.core.config import Cell, Optim, Recipe, from_dict, override, to_dict

CELL = Cell(Recipe(), "a_backbone", "a_method")


def test_id_is_of_the_values_not_of_names_and_prose():
    same = replace(CELL, recipe=replace(CELL.recipe, name="other", about="words"))
    assert same.id == CELL.id
    assert len(CELL.id) == 12
    assert int(CELL.id, 16) >= 0
    assert CELL.slug == f"a_method-a_backbone-s0-{CELL.id}"


@pytest.mark.parametrize(
    "setting",
    [
        "seed=1",
        "video=true",
        'tasks=["depth"]',
        "backbone=b",
        "method=b",
        "method.alpha=0.5",
        "backbone.width=4",
        "recipe.optim.lr=1e-3",
        "recipe.data.height=128",
        "recipe.optim.clip=none",
    ],
)
def test_every_value_that_changes_numbers_changes_the_id(setting):
    assert override(CELL, [setting]).id != CELL.id


@pytest.mark.parametrize(
    "setting",
    ["recipe.optim.checkpoint_every=7", "recipe.data.workers=2", "recipe.data.cache=false"],
)
def test_what_changes_no_number_leaves_the_id(setting):
    changed = override(CELL, [setting])
    assert changed != CELL
    assert changed.id == CELL.id


def test_cell_survives_json():
    cell = override(CELL, ["method.alpha=0.5", "recipe.augment.crop=[32, 64]", "seed=3"])
    assert from_dict(Cell, json.loads(json.dumps(to_dict(cell)))) == cell


def test_pretrained_file_counts_by_its_content(tmp_path):
    first, second, other = (tmp_path / name for name in ("a.pth", "b.pth", "c.pth"))
    first.write_bytes(b"weights")
    second.write_bytes(b"weights")
    other.write_bytes(b"others")
    ids = [replace(CELL, pretrained=str(path)).id for path in (first, second, other)]
    assert ids[0] == ids[1] != ids[2]
    with pytest.raises(ValueError, match=r"no weights file '.*gone.pth'"):
        _ = replace(CELL, pretrained=str(tmp_path / "gone.pth")).id


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("recipe.optim.lrr=1", r"unknown key 'recipe.optim.lrr' \(did you mean 'lr'\?\)"),
        ("recipe.optm.lr=1", r"unknown key 'recipe.optm.lr' \(did you mean 'optim'\?\)"),
        ("sed=1", r"did you mean 'seed'"),
        ("seed", "is not key=value"),
        ("seed=one", r"'seed' must be int, not 'one'"),
        ("seed=1.5", r"'seed' must be int, not 1.5"),
        ("recipe.optim.steps=true", "'recipe.optim.steps' must be int"),
        ("recipe.augment.crop=[1, 2, 3]", "'recipe.augment.crop'"),
        ("recipe.optim=3", "is a section"),
    ],
)
def test_wrong_settings_are_named(setting, message):
    with pytest.raises(ValueError, match=message):
        override(CELL, [setting])


def test_settings_apply_in_order_and_to_plugin_arguments():
    cell = override(CELL, ["seed=1", "seed=2", "method.init=1", "backbone.width=16"])
    assert (cell.seed, cell.method_args["init"], cell.backbone_args["width"]) == (2, 1, 16)


def test_integer_is_a_float_where_one_is_due():
    cell = override(CELL, ["recipe.optim.lr=1"])
    assert type(cell.recipe.optim.lr) is float
    assert cell.id == override(CELL, ["recipe.optim.lr=1.0"]).id


def test_recipes_load_and_differ():
    names = config.recipe_names()
    assert {"smoke", "small", "medium", "cityscapes"} <= set(names)
    recipes = [config.load_recipe(name) for name in names]
    assert (
        len({replace(CELL, recipe=recipe).id for recipe in recipes}) == len(names) - 1
    )  # cityscapes-video: its second stage
    assert [recipe.name for recipe in recipes if recipe.smoke] == [
        *("cost", "dense-smoke", "kitti-smoke", "smoke")
    ]
    assert all(recipe.about for recipe in recipes)


def test_recipe_of_ones_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[optim]\nsteps = 3\n")
    recipe = config.load_recipe(str(path))
    assert (recipe.name, recipe.optim.steps, recipe.optim.lr) == ("mine", 3, Optim().lr)
    path.write_text("[optim]\nstep = 3\n")
    with pytest.raises(ValueError, match=r"mine.toml: .*'optim.step' \(did you mean 'steps'\?\)"):
        config.load_recipe(str(path))
    with pytest.raises(ValueError, match=r"no recipe called 'smal' \(did you mean 'small'\?\)"):
        config.load_recipe("smal")
