"""What sections of a grid file of cells say, and what is wrong with them, told with its line."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from mtl_bench.bench.jobs import NOTHING
from mtl_bench.bench.space import DEFAULT, SPLIT, TUNED, Tune, check, draws, of_method
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell
from mtl_bench.core.plain import from_dict
from mtl_bench.core.toml_file import TomlFile

SMOKE_TRIALS = 2


def tune(file: TomlFile, smoke: bool) -> Tune | None:
    """How lines are tuned, in short where it is a smoke run; None where they are not.

    Raises:
        ValueError: what [tune] cannot be, with its line.
    """
    values = file.values.get("tune")
    if values is None:
        return None
    places = (("tune.space", 0), ("tune", 0))
    space = values.get("space", {})
    if not isinstance(space, dict):
        raise file.error(f"write it as [tune.space], a section, not {space!r}", "space", *places)
    for key, where in space.items():
        try:
            check(key, where)
        except ValueError as error:
            raise file.error(str(error), key, *places) from error
        if not key.startswith(TUNED):
            message = f"trials cannot set '{key}', only what begins with {', '.join(TUNED)}"
            raise file.error(message, key, *places)
    try:
        found = from_dict(Tune, {"space": DEFAULT, **values}, "tune.")
    except ValueError as error:
        key = next((key for key in values if f"'{key}'" in str(error).replace("tune.", "")), "")
        raise file.error(str(error), key, ("tune", 0)) from error
    if smoke:
        found = replace(found, trials=min(found.trials, SMOKE_TRIALS), seeds=found.seeds[:1])
    return found


def check_tuned(
    file: TomlFile, cells: Sequence[Cell], tune: Tune, set_values: Callable[..., Cell]
) -> None:
    """Results have other seeds than trials and another split, and a trial can be set.

    Raises:
        ValueError: otherwise, with its line; what a method declares, with its file.
    """
    both = sorted({cell.seed for cell in cells}.intersection(tune.seeds))
    if both:
        message = f"seed {both[0]} is a result's, too: trials have seeds of their own"
        raise file.error(message, "seeds", ("tune", 0))
    for cell in cells:
        if cell.recipe.evaluate.split != "test":
            raise file.error(
                f"trials are judged on the split {SPLIT}, and recipe {cell.recipe.name} reports "
                f"its split {cell.recipe.evaluate.split}: set recipe.evaluate.split to test",
                "trials",
                ("tune", 0),
            )
    for name in sorted({name for cell in cells for name in plugins.part_names(cell.method)}):
        of_method(name)
    places = (("tune.space", 0), ("tune", 0))
    for cell in {cell.recipe.name: cell for cell in reversed(cells)}.values():
        try:
            drawn = draws(tune, cell)[1:]
        except ValueError as error:
            key = next((key for key in tune.space if key in str(error)), "")
            raise file.error(str(error), key, *places) from error
        for values in drawn:
            own = {key: value for key, value in values.items() if key in tune.space}
            set_values(cell, own, *places)


def suite(file: TomlFile, recipe: str | None) -> dict[str, Mapping[str, Any]]:
    """Recipe -> what the suite sets of its cells; of the one that was asked for, where one was.

    Raises:
        ValueError: an entry that is no recipe's name and no table with one, one that stands twice,
            no entry, or a recipe beside the suite.
    """
    if "suite" not in file.values:
        return {}
    found: dict[str, Mapping[str, Any]] = {}
    for entry in file.values["suite"]:
        values = dict(entry) if isinstance(entry, dict) else {"recipe": entry}
        name = values.pop("recipe", None)
        if not isinstance(name, str):
            message = 'a suite lists recipes: "NAME" or { recipe = "NAME", KEY = VALUE }'
            raise file.error(message, "suite", ("", 0))
        if name in found:
            raise file.error(f"recipe '{name}' stands twice in the suite", "suite", ("", 0))
        found[name] = values
    if not found:
        raise file.error('a suite needs a recipe: suite = ["NAME", ...]', "suite", ("", 0))
    tables = [(("", 0), file.values), (("axes", 0), file.values.get("axes", {}))]
    tables += [(("row", index), row) for index, row in enumerate(file.values.get("row", []))]
    for place, table in tables:
        for key in ("recipe", "smoke_recipe"):
            if key in table:
                raise file.error(f"leave out '{key}': the suite names the recipes", key, place)
    return {recipe: found.get(recipe, NOTHING)} if recipe else found


def check_rows(file: TomlFile, axes: Mapping[str, Any], suite: Mapping[str, Any]) -> None:
    """Each has a name of its own and no axis in it; method and backbone are somewhere, the latter
    of a suite in its recipes."""
    rows: list[Mapping[str, Any]] = file.values.get("row", [])
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
        if key not in axes and without and not (suite and key == "backbone"):
            raise file.error(f"'{key}' is missing", "name", ("row", without[0]), ("axes", 0))
