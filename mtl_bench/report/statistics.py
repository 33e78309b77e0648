"""Lines of a table: cells that differ only in their seed, with mean, spread and who leads."""

import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mtl_bench.core.columns import Column
from mtl_bench.report import evidence
from mtl_bench.report.columns import DELTA, RELATIVE, Row, columns, flatten, measured, text

T = TypeVar("T")
SMOKE = "smoke: not a result"
PSEUDO = "recipe.pseudo."  # the video stage's settings: no number of a cell without it
NOT_NUMBERS = (  # keys of a cell that change no number
    "seed",  # nor which group it is in
    "recipe.about",
    "recipe.data.cache",
    "recipe.data.workers",
    "recipe.optim.checkpoint_every",
    "recipe.optim.cosine_every",
)
KNOWN = (  # axes in the order in which they stand
    *("method", "backbone", "tasks", "single_task", "video", "granularity"),
    *("replay", "pretrained", "recipe.name"),
)
PROBLEM = ("recipe.name", "backbone", "tasks", "pretrained")  # axes that make a problem of its own
FEW = 4  # lines of a table: of more, what is bold leads the control by a test
SHOWN = ("done", "stale")  # statuses that have numbers


@dataclass(frozen=True)
class Entry:
    """A column's mean and sample standard deviation over the seeds that have it."""

    mean: float = math.nan
    std: float = math.nan  # NaN for one seed
    count: int = 0
    bold: bool = False


@dataclass(frozen=True)
class Group:
    """Cells that differ only in their seed, or the trivial predictor."""

    identity: tuple[str, ...]  # one value per Table.axes
    status: str  # done | stale | trivial
    smoke: bool
    rows: tuple[Row, ...]
    entries: Mapping[str, Entry]

    @property
    def mark(self) -> str:
        """What a reader must know before reading the numbers; empty for a plain result."""
        marks = ("stale" if self.status == "stale" else "", SMOKE if self.smoke else "")
        return "; ".join(filter(None, marks))

    @property
    def label(self) -> str:
        """One short text for a legend."""
        short = " (stale)" * (self.status == "stale") + " (smoke)" * self.smoke
        return ", ".join(filter(None, self.identity)) + short


def cell_of(row: Row) -> dict[str, Any]:
    """What identifies a row's cell, without its seed."""
    flat = flatten(row.get("cell") or {})
    for name in ("backbone", "method", "tasks", "video", "name"):
        if name in row:
            flat.setdefault(name, row[name])
    if "recipe" in row and "recipe.name" not in flat:
        flat["recipe.name"] = row["recipe"]
    return {
        key: value
        for key, value in flat.items()
        if key not in NOT_NUMBERS and (flat.get("video") or not key.startswith(PSEUDO))
    }


def recipe_of(row: Row) -> str:
    return str(cell_of(row).get("recipe.name", ""))


def by_recipe(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Recipe's name -> its rows."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(recipe_of(row), []).append(row)
    return found


def axes_of(rows: Sequence[Row], axis: str) -> tuple[str, ...]:
    """The row axis and whatever else differs between the cells, best known first.

    Cells of different names differ by design, and their names say how: what joins the names is
    what differs between cells of one name.
    """
    alike: dict[str, list[dict[str, Any]]] = {}
    for cell in map(cell_of, rows):
        alike.setdefault(str(cell.get("name")) if axis == "name" else "", []).append(cell)
    keys = sorted({key for cells in alike.values() for cell in cells for key in cell})
    varying = [key for key in keys if any(_varies(cells, key) for cells in alike.values())]
    if "recipe.name" in varying:  # two recipes differ in much; their names say it
        varying = [k for k in varying if k == "recipe.name" or not k.startswith("recipe.")]
    rest = [k for k in KNOWN if k in varying] + [k for k in varying if k not in KNOWN]
    return (axis, *(key for key in rest if key != axis))


def own_and_shared(axes: Sequence[str]) -> tuple[list[int], list[int]]:
    """Places of the axes that name a line, and of those that name its problem."""
    own = [i for i, axis in enumerate(axes) if not i or axis not in PROBLEM]
    return own, [i for i in range(len(axes)) if i not in own]


def names_of(identity: Sequence[str], axes: Sequence[str]) -> tuple[str, str]:
    """A line and its problem, of values of the axes."""
    line, problem = (", ".join(identity[i] for i in some) for some in own_and_shared(axes))
    return line, problem


def grouped(
    rows: Sequence[Row],
    axes: tuple[str, ...],
    trivial: Group | None = None,
    reference: str | None = None,
    control: str | None = None,
) -> list[Group]:
    """The lines, in the order in which their first cells come, with numbers or without.

    Args:
        trivial: what a leader has to beat, too.
        reference: value of the first axis whose line the RELATIVE columns are relative to.
        control: the line that a leader has to beat, in a table of more than FEW.
    """
    every = columns()
    order: dict[str, int] = {}
    members: dict[tuple[str, str, bool], list[Row]] = {}
    for i, row in enumerate(rows):
        key = json.dumps(cell_of(row), sort_keys=True)
        order.setdefault(key, i)
        status = row.get("status", "done")
        if status in SHOWN:
            members.setdefault((key, status, bool(row.get("smoke"))), []).append(row)
    groups = [
        Group(
            identity=tuple(text(cell_of(several[0]).get(axis)) for axis in axes),
            status=status,
            smoke=smoke,
            rows=tuple(several),
            entries=_entries(several, (*every, *RELATIVE)),
        )
        for (_, status, smoke), several in sorted(members.items(), key=lambda m: order[m[0][0]])
    ]
    if tested(groups, axes, control):
        leading = _tested(groups, axes, str(control), every)
    else:
        leading = [[c for c in every if _leads(g, c, groups, trivial)] for g in groups]
    groups = [_with_bold(group, bold) for group, bold in zip(groups, leading, strict=True)]
    return [_with_relative(group, groups, reference) for group in groups]


def trivial_group(baseline: Row, axes: tuple[str, ...]) -> Group:
    name = ("trivial predictor", *("" for _ in axes[1:]))
    return Group(name, "trivial", False, (), _entries([baseline], (*columns(), *RELATIVE)))


def entry_of(values: Sequence[float]) -> Entry:
    """Of those that are no NaN."""
    known = np.array([value for value in values if not math.isnan(value)])
    spread = float(known.std(ddof=1)) if len(known) > 1 else math.nan
    return Entry(float(known.mean()), spread, len(known)) if len(known) else Entry()


def kept(group: Group, runs_root: Path, name: str, load: Callable[[Path], T]) -> Iterator[T]:
    """What the group's runs have kept in files of this name; a damaged one is told and left out."""
    for path in (runs_root / str(row.get("slug", "")) / name for row in group.rows):
        if path.is_file():
            try:
                yield load(path)
            except ValueError as error:
                print(f"left out of the figures: {error}", file=sys.stderr)


# --- parts ----------------------------------------------------------------------------------------


def _varies(cells: list[dict[str, Any]], key: str) -> bool:
    having = [cell for cell in cells if key in cell or not key.startswith(PSEUDO)]
    return len({json.dumps(cell.get(key)) for cell in having}) > 1


def _entries(rows: Sequence[Row], every: Sequence[Column]) -> dict[str, Entry]:
    return {c.name: entry_of([measured(row, c) for row in rows]) for c in every}


def _with_relative(group: Group, groups: list[Group], reference: str | None) -> Group:
    """With the columns relative to the line of that name and otherwise the same identity."""
    wanted = ((reference, *group.identity[1:]), "done", group.smoke)
    found = next((g for g in groups if (g.identity, g.status, g.smoke) == wanted), None)
    entries = dict(group.entries)
    for column in RELATIVE:
        own, base = entries[column.key], found.entries[column.key] if found else Entry()
        has = own.count > 0 and base.count > 0
        entries[column.name] = Entry(own.mean / base.mean, count=own.count) if has else Entry()
    return replace(group, entries=entries)


def _with_bold(group: Group, bold: Sequence[Column]) -> Group:
    names = {column.name for column in bold}
    entries = {k: replace(e, bold=k in names) for k, e in group.entries.items()}
    return replace(group, entries=entries)


def tested(groups: Sequence[Group], axes: Sequence[str], control: str | None) -> bool:
    """Whether bold is what leads the control by a test: it is there, and more than FEW lines."""
    names = {names_of(group.identity, axes)[0] for group in groups if not group.mark}
    return control in names and len(names) > FEW


def _tested(
    groups: list[Group], axes: tuple[str, ...], control: str, every: Sequence[Column]
) -> list[list[Column]]:
    """By group, the columns in which it leads the control of its problem."""
    found: list[list[Column]] = [[] for _ in groups]
    places = {names_of(g.identity, axes): i for i, g in enumerate(groups) if not g.mark}
    for problem in dict.fromkeys(problem for _, problem in places):
        at = [i for (line, own), i in places.items() if own == problem and line != control]
        base = places.get((control, problem))
        if base is None:
            continue
        seeds = sorted({row["seed"] for i in (*at, base) for row in groups[i].rows})
        for column in every:
            rivals = [i for i in at if groups[i].entries[column.name].count > 1]
            value_LN = np.array([_by_seed(groups[i], column, seeds) for i in rivals])
            leads = evidence.ahead(value_LN, _by_seed(groups[base], column, seeds))
            for i in itertools.compress(rivals, leads):
                found[i].append(column)
    return found


def _by_seed(group: Group, column: Column, seeds: Sequence[int]) -> evidence.Array:
    """Values, of which more is better."""
    own = {row["seed"]: column.better * measured(row, column) for row in group.rows}
    return np.array([own.get(seed, math.nan) for seed in seeds])


def _leads(group: Group, column: Column, groups: list[Group], trivial: Group | None) -> bool:
    """Whether it is ahead of every other by more than its own and the other's spread."""
    rivals = [other for other in groups if other is not group and not other.mark]
    own = group.entries[column.name]
    if group.mark or not rivals or own.count < 2:
        return False
    for rival in rivals:
        other = rival.entries[column.name]
        if other.count == 1:
            return False  # its spread is not known
        if other.count and column.better * (own.mean - other.mean) <= max(own.std, other.std):
            return False
    floor = trivial.entries[column.name] if trivial else Entry()
    floor = Entry(0.0, count=1) if column in DELTA else floor  # the baseline's own
    return not floor.count or column.better * (own.mean - floor.mean) > own.std
