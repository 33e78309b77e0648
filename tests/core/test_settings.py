"""Every value that can be set has bounds, one spelling, and a line in `list settings`."""

import json
import re
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import config, plugins
from mtl_bench.core.config import (
    Cell,
    Recipe,
    check_cells,
    from_dict,
    override,
    set_values,
    to_dict,
)
from mtl_bench.core.plain import settings_of

CELL = Cell(Recipe(), "tiny", "famo")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("recipe.optim.lr=-1", r"'recipe.optim.lr' must be >= 0, not -1"),
        ("recipe.optim.lr=nan", r"'recipe.optim.lr' must be a number, not nan"),
        ("recipe.optim.lr=inf", "'recipe.optim.lr' must be finite, not inf"),
        ("recipe.optim.clip=-1", r"'recipe.optim.clip' must be > 0, not -1"),
        ("recipe.optim.steps=0", r"'recipe.optim.steps' must be >= 1, not 0"),
        ("recipe.optim.micro_batch=0", "must be >= 2, not 0"),
        ("recipe.optim.micro_batch=5", "micro_batch = 5 does not divide a batch of 12"),
        ("recipe.optim.batch=1", "must be >= 2, not 1"),
        ("recipe.optim.checkpoint_every=0", "must be >= 1, not 0"),
        ("recipe.optim.precision=fp8", "must be fp32 or bf16 or fp16, not 'fp8'"),
        ("recipe.network.channels=0", "'recipe.network.channels' must be >= 1, not 0"),
        ("recipe.network.strides=[16,8,4]", "must be ascending"),
        ("recipe.augment.scales=[]", "must be non-empty"),
        ("recipe.augment.scales=[1, -1]", "must be > 0, not -1"),
        ("recipe.loss.top_fraction=0", "must be > 0, not 0"),
        ("recipe.loss.scales=[]", "must be non-empty"),
        ("recipe.pseudo.scales=[0.0]", "must be > 0"),
        ("recipe.pseudo.min_confidence=2", "must be <= 1, not 2"),
        ("recipe.evaluate.nms_kernel=4", "'recipe.evaluate.nms_kernel' must be odd, not 4"),
        ("recipe.evaluate.top_k=0", "must be >= 1, not 0"),
        ("recipe.evaluate.top_k=1000", "must be <= 999, not 1000"),
        ("recipe.evaluate.min_depth_m=90", "must be below max_depth_m"),
        ("recipe.latency.passes=-1", "'recipe.latency.passes' must be >= 0, not -1"),
        ("recipe.data.train_frames=most", "must be published or all, not 'most'"),
        ("seed=-1", "'seed' must be >= 0, not -1"),
        ('tasks=["depth", "depth"]', "'tasks' must be without repetitions"),
        ("recipe.tasks=depth", "'recipe.tasks' cannot be set: a cell has its own, tasks"),
        ("method.lr=nan", "'method.lr' must be a number, not nan"),
        ("method.lr=much", "'method.lr' must be float, not 'much'"),
        ("backbone.width=1.5", "'backbone.width' must be int, not 1.5"),
    ],
)
def test_a_value_out_of_bounds_is_told_when_it_is_set(setting, message):
    with pytest.raises(ValueError, match=message):
        override(CELL, [setting])


def test_bounds_hold_for_what_is_built_in_python_too():
    with pytest.raises(ValueError, match="'seed' must be >= 0, not -1"):
        replace(CELL, seed=-1)
    with pytest.raises(ValueError, match="'lr' must be >= 0, not -1"):
        config.Optim(lr=-1)
    assert config.Optim(lr=1).lr == 1.0
    assert type(config.Optim(lr=1).lr) is float


def test_weights_of_a_method_are_a_table_of_numbers():
    fixed = replace(CELL, method="fixed")
    with pytest.raises(ValueError, match=r"'method.weights' must be table of float, not 3"):
        override(fixed, ["method.weights=3"])
    one, other = (override(fixed, [f"method.weights.center={n}"]) for n in ("100", "100.0"))
    assert one.id == other.id
    assert override(fixed, ["method.weights={}"]) == fixed


@pytest.mark.parametrize(
    "settings",
    [
        ["method.lr=0.025"],
        ["method.lr=25e-3", "method.decay=0.001"],
        ["backbone.width=8"],
        ['tasks=["depth", "panoptic"]'],
        ["recipe.data.dataset=synthetic"],
        ["recipe.optim.lr=0.0001"],
    ],
)
def test_a_default_that_is_given_and_the_order_of_tasks_make_no_cell_of_their_own(settings):
    assert override(CELL, settings).id == CELL.id


def test_tasks_stand_in_the_recipes_order_then_by_name():
    assert replace(CELL, tasks=("b", "depth", "a", "panoptic")).tasks == (
        *("panoptic", "depth", "a", "b"),
    )
    assert replace(CELL, tasks=()).tasks == Recipe().tasks


def test_infinity_is_a_plug_ins_own_affair():
    nash = override(replace(CELL, method="nash"), ["method.max_norm=inf"])
    assert nash.method_args == {"max_norm": float("inf")}


def test_one_number_has_one_id_however_it_is_written():
    ids = {override(CELL, [f"method.lr={text}"]).id for text in ("1", "1.0", "1e0")}
    assert len(ids) == 1
    assert ids != {CELL.id}
    composed = replace(CELL, method="famo+cagrad")
    assert override(composed, ["method.famo.lr=0.025", "method.cagrad.c=0.4"]) == composed
    once, again = (override(composed, [f"method.cagrad.c={c}"]) for c in ("1", "1.0"))
    assert once.id == again.id != composed.id
    hyphen = override(CELL, ["recipe.data.dataset=synthetic-kitti"])
    assert override(CELL, ["recipe.data.dataset=synthetic_kitti"]).id == hyphen.id


def test_a_cell_of_an_unknown_plug_in_keeps_its_settings_as_they_are():
    cell = Cell(Recipe(), "tiny", "nobodys", method_args={"lr": 1})
    assert cell.method_args == {"lr": 1}
    assert from_dict(Cell, json.loads(json.dumps(to_dict(cell)))) == cell
    with pytest.raises(ValueError, match="no method called 'nobodys'"):
        check_cells([cell])


TYPED = '''"""Mine: typed in every way."""
from collections.abc import Mapping
from mtl_bench.core.method import LossMethod
LEVEL = 3
class Mine(LossMethod):
    def __init__(self, terms, seed=0, plain=2, rate: float = 1, maybe: float | None = None,
                 pair: tuple[float, float] = (0.9, 0.99), some: tuple[int, ...] = (),
                 table: Mapping[str, float] = {}, other: "set[int]" = LEVEL, *, word: str = "a"):
        super().__init__(terms, seed)
'''


def test_types_and_defaults_are_read_from_the_file_alone(tmp_path, monkeypatch):
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "mine.py").write_text(TYPED)
    monkeypatch.setenv(plugins.VARIABLE, str(tmp_path))
    known = plugins.arguments("methods", "mine")
    assert list(known) == ["plain", "rate", "maybe", "pair", "some", "table", "other", "word"]
    assert (known["plain"].kind, known["plain"].default) == (int, 2)
    assert (known["other"].text, known["other"].default) == ("LEVEL", ...)
    start = Cell(Recipe(), "tiny", "mine")
    values = {"rate": 2, "maybe": 1, "pair": [1, 0], "some": [1], "table": {"x": 1}, "other": 1}
    given = replace(start, method_args=values).method_args
    assert json.dumps(to_dict(given), sort_keys=True) == (
        '{"maybe": 1.0, "other": 1, "pair": [1.0, 0.0], "rate": 2.0, "some": [1], '
        '"table": {"x": 1.0}}'
    )
    same = {"rate": 1, "maybe": None, "pair": [0.9, 0.99], "some": [], "table": {}, "word": "a"}
    assert replace(start, method_args=same) == start


def test_list_settings_has_every_key_with_type_bounds_default_and_meaning():
    text = CliRunner().invoke(app, ["list", "settings"]).output
    for line in (
        r"recipe.optim.steps +int, >= 1 +60000 +of the optimiser",
        r"recipe.evaluate.nms_kernel +int, >= 1, odd +7 +pixels",
        r"recipe.optim.clip +float or none, > 0, finite +0.01 +total gradient norm",
        r"recipe.network.strides +list of int, .* +\[8, 16, 32\] +pyramid levels",
        r"seed +int, >= 0 +0 +of initial weights, data order and method",
        r"method.lr +float +0.025 +famo: of the Adam that moves xi",
        r"method.weights +table of float +\{\} +fixed: replace single ones",
        r"backbone.width +int +8 +tiny",
        r"passes +int, >= 1 +500",
    ):
        assert re.search(line, text), line
    for kind in ("methods", "backbones"):
        for name in plugins.readable(kind):
            for key in plugins.arguments(kind, name):
                assert re.search(rf"{kind[:-1]}.{key} .* {name}", text)


def test_what_is_listed_can_be_set_and_what_is_not_cannot():
    values, listed = to_dict(CELL), {}
    for setting in settings_of(Cell):
        listed[setting.key] = setting.default
        if setting.key not in ("backbone", "method", "tasks"):
            assert set_values(CELL, {setting.key: setting.default}).id == CELL.id
    leaves = {key for key in values if key != "recipe"}
    for key, value in values["recipe"].items():
        inner = [f".{name}" for name in value] if isinstance(value, dict) else [""]
        leaves |= {f"recipe.{key}{name}" for name in inner}
    assert leaves - listed.keys() == set(config.NOT_SET)
    for key in config.NOT_SET:
        with pytest.raises(ValueError, match="cannot be set"):
            set_values(CELL, {key: "x"})
