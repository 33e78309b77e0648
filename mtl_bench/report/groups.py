"""Lines of a table: cells that differ only in their seed, with mean, spread and who leads."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from mtl_bench.report.columns import BY_NAME, COLUMNS, RELATIVE, Row, flatten, measured

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
    *("pretrained", "recipe.name"),
)
DELTAS = ("delta_flat", "delta_task")
ALL = (*COLUMNS, *RELATIVE)


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
    def names(self) -> tuple[str, ...]:
        """The identity with the mark beside it."""
        return (self.identity[0] + (f" ({self.mark})" if self.mark else ""), *self.identity[1:])

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


def grouped(
    rows: Sequence[Row],
    shown: Sequence[str],
    axes: tuple[str, ...],
    trivial: Group | None = None,
    reference: str | None = None,
) -> list[Group]:
    """The lines, in the order in which their first cells come, with numbers or without.

    Args:
        shown: statuses that have numbers.
        trivial: what a leader has to beat, too.
        reference: value of the first axis whose line the RELATIVE columns are relative to.
    """
    order: dict[str, int] = {}
    members: dict[tuple[str, str, bool], list[Row]] = {}
    for i, row in enumerate(rows):
        key = json.dumps(cell_of(row), sort_keys=True)
        order.setdefault(key, i)
        status = row.get("status", "done")
        if status in shown:
            members.setdefault((key, status, bool(row.get("smoke"))), []).append(row)
    groups = [
        Group(
            identity=tuple(text(cell_of(several[0]).get(axis)) for axis in axes),
            status=status,
            smoke=smoke,
            rows=tuple(several),
            entries=_entries(several),
        )
        for (_, status, smoke), several in sorted(members.items(), key=lambda m: order[m[0][0]])
    ]
    groups = [_with_leaders(group, groups, trivial) for group in groups]
    return [_with_relative(group, groups, reference) for group in groups]


def trivial_group(baseline: Row, axes: tuple[str, ...]) -> Group:
    entries = {c.name: Entry(measured(baseline, c), count=1) for c in ALL}
    entries = {k: Entry() if math.isnan(e.mean) else e for k, e in entries.items()}
    return Group(("trivial predictor", *("" for _ in axes[1:])), "trivial", False, (), entries)


def text(value: Any) -> str:
    """A setting as a reader writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(text(item) for item in value) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else str(value)


# --- parts ----------------------------------------------------------------------------------------


def _varies(cells: list[dict[str, Any]], key: str) -> bool:
    having = [cell for cell in cells if key in cell or not key.startswith(PSEUDO)]
    return len({json.dumps(cell.get(key)) for cell in having}) > 1


def _entries(rows: Sequence[Row]) -> dict[str, Entry]:
    values = pd.DataFrame({c.name: [measured(row, c) for row in rows] for c in ALL})
    summary = zip(values.mean(), values.std(), values.count(), strict=True)
    return {
        str(name): Entry(float(mean), float(std), int(count))
        for name, (mean, std, count) in zip(values.columns, summary, strict=True)
    }


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


def _with_leaders(group: Group, groups: list[Group], trivial: Group | None) -> Group:
    entries = {
        name: Entry(e.mean, e.std, e.count, _leads(group, name, groups, trivial))
        for name, e in group.entries.items()
    }
    return replace(group, entries=entries)


def _leads(group: Group, name: str, groups: list[Group], trivial: Group | None) -> bool:
    """Whether it is ahead of every other by more than its own and the other's spread."""
    rivals = [other for other in groups if other is not group and not other.mark]
    own = group.entries[name]
    if group.mark or not rivals or own.count < 2:
        return False
    better = BY_NAME[name].better
    for rival in rivals:
        other = rival.entries[name]
        if other.count == 1:
            return False  # its spread is not known
        if other.count and better * (own.mean - other.mean) <= max(own.std, other.std):
            return False
    floor = trivial.entries[name] if trivial else Entry()
    if name in DELTAS:
        floor = Entry(0.0, count=1)  # the baseline's
    return not floor.count or better * (own.mean - floor.mean) > own.std
