"""A grid file -> ordered cells: axes, skips with their reasons, how to tabulate the rows.

    question = "What does the page answer?"
    recipe = "small"                # by name, or the path of a recipe file

    [axes]                          # their product, the first axis slowest
    backbone = ["a", "b"]           # or "all": every plug-in of the kind
    method = ["c"]
    seed = [0, 1]
    "method.alpha" = [0.5, 1.5]     # any key that --set takes

    [[skip]]                        # cells that have all these values
    backbone = "b"
    "method.alpha" = 1.5
    why = "the reason, shown in the report"

    [report]                        # read by mtl_bench/report
    rows = "backbone"

Cells come in the order in which they may run: one that needs another's result stands after it.
"""

import itertools
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mtl_bench import plugins
from mtl_bench.config import (
    Cell,
    Recipe,
    canonical_json,
    did_you_mean,
    load_recipe,
    override,
)

GRIDS = Path(__file__).parent / "grids"
KEYS = ("question", "recipe", "axes", "skip", "report")


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
    report: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def grid_names() -> list[str]:
    return sorted(path.stem for path in GRIDS.glob("*.toml"))


def question_of(name: str) -> str:
    """What a grid asks, without expanding it."""
    return str(_read(_path_of(name))[0].get("question", ""))


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
        smoke: the recipe `smoke`, under a name that says so.
        settings: `key=value` for every cell; replaces an axis of that name.
        pretrained: as in `Cell`, for every cell.

    Raises:
        ValueError: no such grid, or a key or value that it cannot have, with file and line.
    """
    path = _path_of(name)
    values, text = _read(path)
    for key in values:
        if key not in KEYS:
            raise _error(path, text, key, f"unknown key '{key}'{did_you_mean(key, KEYS)}")
    axes = _axes(path, text, values.get("axes", {}))
    if seeds is not None:
        if seeds < 1:
            raise ValueError(f"{seeds} seeds: at least 1 is needed")
        axes["seed"] = tuple(range(seeds))
    for key in [setting.partition("=")[0].strip() for setting in settings]:
        axes.pop(key, None)
    if smoke or recipe:
        axes.pop("recipe", None)
    chosen = "smoke" if smoke else recipe or str(values.get("recipe", "small"))
    kept, skips = _expand(path, text, chosen, axes, values.get("skip", []), settings, pretrained)
    return Grid(
        name=f"{path.stem}-smoke" if smoke else path.stem,
        question=str(values.get("question", "")),
        recipe=load_recipe(chosen),
        axes=MappingProxyType(axes),
        cells=kept,
        skips=skips,
        report=MappingProxyType(values.get("report", {})),
    )


def _path_of(name: str) -> Path:
    path = Path(name) if name.endswith(".toml") else GRIDS / f"{name}.toml"
    if not path.is_file():
        hint = "" if name.endswith(".toml") else did_you_mean(name, grid_names())
        raise ValueError(f"no grid called '{name}'{hint}; a file of your own: --grid PATH.toml")
    return path


def _read(path: Path) -> tuple[dict[str, Any], str]:
    text = path.read_text(encoding="utf-8")
    try:
        return tomllib.loads(text), text
    except tomllib.TOMLDecodeError as error:  # has line and column
        raise ValueError(f"{path}: {error}") from error


def _axes(path: Path, text: str, axes: Any) -> dict[str, tuple[Any, ...]]:
    if not isinstance(axes, dict):
        raise _error(path, text, "axes", "[axes] is a section: axis = [values]")
    found: dict[str, tuple[Any, ...]] = {}
    for axis, values in axes.items():
        if values == "all" and f"{axis}s" in plugins.KINDS:
            values = list(plugins.files(f"{axis}s"))
        if not isinstance(values, list) or not values:
            raise _error(path, text, axis, f"axis '{axis}' is a list of values, not {values!r}")
        found[axis] = tuple(values)
    for axis in ("method", "backbone"):
        if axis not in found:
            raise _error(path, text, "axes", f"axis '{axis}' is missing")
    return found


def _expand(
    path: Path,
    text: str,
    recipe: str,
    axes: Mapping[str, tuple[Any, ...]],
    skip: Sequence[Mapping[str, Any]],
    settings: Sequence[str],
    pretrained: str | None,
) -> tuple[tuple[Cell, ...], tuple[Skip, ...]]:
    """The product of the axes, less the skips; equal cells count once."""
    for rule in skip:
        if not isinstance(rule.get("why"), str):
            raise _error(path, text, "skip", "a [[skip]] needs its reason: why = '...'")
    kept: dict[str, Cell] = {}
    skipped: dict[str, Skip] = {}
    for point in itertools.product(*axes.values()):
        values = dict(zip(axes, point, strict=True))
        blank = Cell(load_recipe(values.pop("recipe", recipe)), "", "", pretrained=pretrained)
        cell = blank
        for axis, value in values.items():
            try:
                cell = override(cell, [f"{axis}={json.dumps(value)}"])  # JSON scalars are TOML's
            except ValueError as error:
                raise _error(path, text, axis, str(error)) from error
        cell = override(cell, settings)
        why = next((rule["why"] for rule in skip if _matches(path, text, rule, cell)), None)
        if why is None:
            kept.setdefault(cell.id, cell)
        else:
            skipped.setdefault(cell.id, Skip(cell, why))
    return tuple(kept.values()), tuple(skipped.values())


def _matches(path: Path, text: str, rule: Mapping[str, Any], cell: Cell) -> bool:
    """Whether a cell already has every value that the rule names."""
    for key, value in rule.items():
        if key == "why":
            continue
        try:
            changed = override(cell, [f"{key}={json.dumps(value)}"])
        except ValueError as error:
            raise _error(path, text, key, str(error)) from error
        if canonical_json(changed) != canonical_json(cell):
            return False
    return True


def _error(path: Path, text: str, key: str, message: str) -> ValueError:
    """With the line on which a key stands; tomllib keeps no positions."""
    pattern = re.compile(rf"""^\s*(\[+\s*)?["']?{re.escape(key)}["']?\s*(=|\]|$)""")
    lines = (i for i, line in enumerate(text.splitlines(), 1) if pattern.match(line))
    line = next(lines, None)
    return ValueError(f"{path}{'' if line is None else f', line {line}'}: {message}")
