"""A grid file -> ordered cells: axes, named rows, skips with their reasons, how to tabulate them.

    question = "What does the page answer?"
    recipe = "small"                # by name, or the path of a recipe file

    [axes]                          # their product, the first axis slowest
    backbone = ["a", "b"]           # or "all": every plug-in of the kind
    seed = [0, 1]
    "method.alpha" = [0.5, 1.5]     # any key that --set takes; with a dot in it, it is quoted

    [[row]]                         # each point of the axes gives one cell a row, in this order
    name = "Halved"                 # what the report calls it
    method = "c"                    # any such keys, but none of the axes
    "method.weights" = { center = 100, offset = 0.005 }

    [[row]]
    name = "Continued, and twice as long"
    method = "d"
    video = true
    "recipe.optim.steps" = "2x"     # times the recipe's number, whatever the recipe is

    [[skip]]                        # cells that have all these values
    backbone = "b"
    why = "the reason, shown in the report"

    [baseline]                      # what turns a cell into the one that its delta is against
    method = "c"
    single_task = true

    [report]                        # read by mtl_bench/report
    rows = "name"                   # or an axis

`method` and `backbone` stand in the axes or in every row; a file without [[row]] is the axes alone.
Keys of a row: method, backbone, tasks, seed, video, single_task, granularity, pretrained, recipe,
recipe.SECTION.KEY, method.KEY, backbone.KEY. Under [baseline] a cell keeps recipe, backbone and
seed, and nothing else of its own. A wrong key is told with its line. A file with kind = "latency"
is of another form: see `latency_grid.py`.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from mtl_bench.bench import grid_file
from mtl_bench.bench.grid_file import GRIDS, grid_names, question_of
from mtl_bench.core.config import TASKS, Cell, Recipe, load_recipe, override, set_values, to_dict
from mtl_bench.core.toml_file import Place, TomlFile

__all__ = ["GRIDS", "Grid", "Skip", "baseline_cell", "grid_names", "load_grid", "question_of"]
__all__ += ["with_parents"]

NOTHING: Mapping[str, Any] = MappingProxyType({})
TIMES = re.compile(r"(\d+\.?\d*)x")  # "2x", "0.5x"


@dataclass(frozen=True)
class Skip:
    cell: Cell
    why: str


@dataclass(frozen=True)
class Grid:
    """A named set of cells and how to tabulate them."""

    name: str  # of its folder in reports/; ends in -smoke for a smoke run
    question: str
    recipe: Recipe
    axes: Mapping[str, tuple[Any, ...]]
    cells: tuple[Cell, ...]
    skips: tuple[Skip, ...] = ()
    report: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    names: Mapping[str, str] = field(default_factory=lambda: NOTHING)  # cell id -> its row's
    baseline: Mapping[str, Any] = field(default_factory=lambda: NOTHING)  # see baseline_cell


def with_parents(cells: Iterable[Cell]) -> tuple[Cell, ...]:
    """The cells and all that they need, each once and after what it needs."""
    found: dict[str, Cell] = {}
    for cell in cells:
        for each in (*with_parents(cell.parents), cell):
            found.setdefault(each.id, each)
    return tuple(found.values())


def baseline_cell(cell: Cell, settings: Mapping[str, Any]) -> Cell:
    """What a cell's delta is against: its recipe, backbone and seed under a grid's [baseline]."""
    plain = replace(
        cell, tasks=TASKS, video=False, single_task=False, granularity="terms", method_args=NOTHING
    )
    return set_values(plain, settings)


def load_grid(
    name: str,
    *,
    recipe: str | None = None,
    seeds: int | None = None,
    smoke: bool = False,
    settings: Sequence[str] = (),
    pretrained: str | None = None,
) -> Grid:
    """A shipped grid by name, or a user's by the path of its TOML file.

    Args:
        recipe: in place of the grid's.
        seeds: seeds 0 .. seeds - 1 in place of the grid's.
        smoke: the grid's `smoke_recipe` (without one: `smoke`), under a name that says so.
        settings: `key=value` for every cell; stands in place of an axis or of a row's value, and is
            what a row's "2x" multiplies.
        pretrained: as in `Cell`, for every cell.

    Raises:
        ValueError: no such grid, or a key or value that it cannot have, with file and line.
    """
    file = grid_file.read(name)
    if grid_file.kind_of(file) != grid_file.TRAINING:
        raise ValueError(f"grid '{name}' times networks: it has no cells to train")
    axes = grid_file.axes(file)
    if seeds is not None:
        if seeds < 1:
            raise ValueError(f"{seeds} seeds: at least 1 is needed")
        axes["seed"] = tuple(range(seeds))
    rows = _rows(file, axes)
    given = {setting.partition("=")[0].strip() for setting in settings}
    given |= {"recipe"} if smoke or recipe else set()
    axes = {axis: values for axis, values in axes.items() if axis not in given}
    for row in rows if "recipe" in given else ():
        row.pop("recipe", None)
    key, otherwise = ("smoke_recipe", "smoke") if smoke else ("recipe", "small")
    chosen = (not smoke and recipe) or str(file.values.get(key, otherwise))
    start = Cell(load_recipe(chosen), "", "", pretrained=pretrained)
    cells, skips, names = _expand(file, start, axes, rows, settings)
    baseline = file.values.get("baseline", {})
    _set(file, start, baseline, ("baseline", 0))
    return Grid(
        name=f"{file.path.stem}-smoke" if smoke else file.path.stem,
        question=str(file.values.get("question", "")),
        recipe=start.recipe,
        axes=MappingProxyType(axes),
        cells=cells,
        skips=skips,
        report=MappingProxyType(file.values.get("report", {})),
        names=MappingProxyType(names),
        baseline=MappingProxyType(baseline),
    )


# --- the file -------------------------------------------------------------------------------------


def _rows(file: TomlFile, axes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Each has a name of its own and no axis in it; method and backbone are somewhere."""
    rows: list[dict[str, Any]] = file.values.get("row", [])
    names = [row.get("name") for row in rows]
    for index, (row, name) in enumerate(zip(rows, names, strict=True)):
        place = ("row", index)
        if not isinstance(name, str):
            raise file.error("a [[row]] needs its name: name = '...'", "name", place)
        if name in names[:index]:
            raise file.error(f"two rows are called '{name}'", "name", place)
        for key in row:
            if key in axes:
                raise file.error(f"'{key}' is an axis; it cannot stand in a row, too", key, place)
    for key in ("method", "backbone"):
        without = [index for index, row in enumerate(rows or [{}]) if key not in row]
        if key not in axes and without:
            raise file.error(f"'{key}' is missing", "name", ("row", without[0]), ("axes", 0))
    return rows


# --- cells ----------------------------------------------------------------------------------------


def _expand(
    file: TomlFile,
    start: Cell,
    axes: Mapping[str, tuple[Any, ...]],
    rows: Sequence[Mapping[str, Any]],
    settings: Sequence[str],
) -> tuple[tuple[Cell, ...], tuple[Skip, ...], dict[str, str]]:
    """The product of axes and rows, less the skips; equal cells count once."""
    skip = file.values.get("skip", [])
    for index, rule in enumerate(skip):
        if not isinstance(rule.get("why"), str):
            raise file.error("a [[skip]] needs its reason: why = '...'", "", ("skip", index))
        for key in [key for key in rule if key != "why"]:
            _set(file, start, {key: rule[key]}, ("skip", index))
    kept: dict[str, Cell] = {}
    skipped: dict[str, Skip] = {}
    names: dict[str, str] = {}
    points = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    for point, (index, row) in itertools.product(points, enumerate(rows or [NOTHING])):
        values = {key: value for key, value in {**point, **row}.items() if key != "name"}
        cell = _cell(file, start, values, settings, ("row", index), ("axes", 0))
        why = next((rule["why"] for rule in skip if _matches(rule, cell)), None)
        if why is not None:
            skipped.setdefault(cell.id, Skip(cell, why))
            continue
        kept.setdefault(cell.id, cell)
        if rows and names.setdefault(cell.id, row["name"]) != row["name"]:
            message = f"rows '{names[cell.id]}' and '{row['name']}' are the same cell"
            raise file.error(message, "name", ("row", index))
    return tuple(kept.values()), tuple(skipped.values()), names


def _cell(
    file: TomlFile, start: Cell, values: dict[str, Any], settings: Sequence[str], *places: Place
) -> Cell:
    """One point of the grid: its values, then `--set`, then what multiplies a number."""
    recipe = values.pop("recipe", None)
    if recipe is not None:
        try:
            start = replace(start, recipe=load_recipe(str(recipe)))
        except ValueError as error:
            raise file.error(str(error), "recipe", *places) from error
    factors = {k: v for k, v in values.items() if isinstance(v, str) and TIMES.fullmatch(v)}
    plain = {key: value for key, value in values.items() if key not in factors}
    cell = override(_set(file, start, plain, *places), settings)
    return _set(file, cell, {k: _times(cell, k, v) for k, v in factors.items()}, *places)


def _times(cell: Cell, key: str, factor: str) -> Any:
    """A cell's number times 2 for "2x", whole where it is; the text where there is no number."""
    number = to_dict(cell)
    for part in key.split("."):
        number = number.get(part) if isinstance(number, dict) else None
    if type(number) not in (int, float):
        return factor
    product = float(factor[:-1]) * number
    return round(product) if type(number) is int else product


def _set(file: TomlFile, cell: Cell, values: Mapping[str, Any], *places: Place) -> Cell:
    """Set all at once; a mistake is looked for key by key, and told with its line."""
    try:
        return set_values(cell, values)
    except ValueError as error:
        for key, value in values.items():
            try:
                set_values(cell, {key: value})
            except ValueError as own:
                raise file.error(str(own), key, *places) from own
        raise file.error(str(error), "", *places) from error


def _matches(rule: Mapping[str, Any], cell: Cell) -> bool:
    """Whether a cell already has every value that the rule names."""
    values = {key: value for key, value in rule.items() if key != "why"}
    try:
        return set_values(cell, values).id == cell.id
    except ValueError:  # values that this cell cannot have together with its own
        return False
