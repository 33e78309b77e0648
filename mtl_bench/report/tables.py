"""What stands in a report's table: one line per group of cells that differ only in their seed.

Nothing is drawn or formatted here. Cells of different status never share a line, and neither do
measured, trivial and published values.
"""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

LITERATURE = Path(__file__).parent / "literature.toml"
SHOWN = ("done", "stale")  # statuses that have numbers
SMOKE = "smoke: not a result"
NOT_NUMBERS = (  # keys of a cell that change no number
    "seed",  # nor which group it is in
    "recipe.about",
    "recipe.data.cache",
    "recipe.data.workers",
    "recipe.optim.checkpoint_every",
)
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One measured quantity: where a row has it and how it is shown."""

    name: str  # in table.csv
    title: str
    key: str  # dotted key of a row
    better: int  # +1: higher, -1: lower
    digits: int
    scale: float = 1.0
    part: str = "quality"  # quality | cost
    note: str = ""  # said under the title


COLUMNS = (
    Column("pq", "PQ", "panoptic.pq", +1, 1, note="%"),
    Column("pq_things", "PQ things", "panoptic.pq_things", +1, 1, note="%"),
    Column("pq_stuff", "PQ stuff", "panoptic.pq_stuff", +1, 1, note="%"),
    Column("miou", "mIoU", "semantic.miou", +1, 1, note="%"),
    Column("abs_rel", "AbsRel", "depth_median.abs_rel", -1, 3, note="median-scaled"),
    Column("rmse", "RMSE", "depth_median.rmse", -1, 2, note="m, median-scaled"),
    Column("delta1", "delta1", "depth_median.delta1", +1, 3, note="median-scaled"),
    Column("rmse_dgc", "RMSE dgc", "depth_dgc.rmse", -1, 2, note="m, dgc-scaled"),
    Column("fps", "FPS", "latency.fps", +1, 1, part="cost"),
    Column("p50_ms", "p50", "latency.p50_ms", -1, 1, part="cost", note="ms"),
    Column("p95_ms", "p95", "latency.p95_ms", -1, 1, part="cost", note="ms"),
    Column("params_m", "params", "latency.params_m", -1, 2, part="cost", note="M"),
    Column("gmacs", "GMACs", "latency.gmacs", -1, 2, part="cost"),
    Column("peak_mib", "peak", "latency.peak_mib", -1, 1, part="cost", note="MiB"),
    Column("train_min", "train", "time.train_s", -1, 1, 1 / 60, part="cost", note="min"),
)
BY_NAME = {column.name: column for column in COLUMNS}


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


@dataclass(frozen=True)
class Unfinished:
    """A cell without numbers and why."""

    label: str
    slug: str
    status: str  # failed | interrupted | running | missing | skipped
    reason: str


@dataclass(frozen=True)
class Table:
    axes: tuple[str, ...]
    groups: tuple[Group, ...]
    baseline: Group | None
    unfinished: tuple[Unfinished, ...]
    published: tuple[Mapping[str, Any], ...]

    @property
    def lines(self) -> tuple[Group, ...]:
        return self.groups + ((self.baseline,) if self.baseline else ())

    @property
    def smoke(self) -> bool:
        return any(group.smoke for group in self.groups)

    def columns(self, part: str | None = None) -> list[Column]:
        """Those that some group has; of one part, where one is named."""
        return [
            column
            for column in COLUMNS
            if part in (None, column.part)
            and any(g.entries[column.name].count for g in self.groups)
        ]


def tabulate(rows: Sequence[Row], axis: str = "backbone", baseline: Row | None = None) -> Table:
    """Group rows by everything but the seed, and say which group leads each column.

    Args:
        rows: as `row.json` holds them, with a status; rows without numbers have an error at most.
        axis: the field of a cell that names a line; others join it where they differ.
        baseline: metrics of the trivial predictor.
    """
    shown = [row for row in rows if row.get("status", "done") in SHOWN]
    cells = [_cell(row) for row in shown]
    axes = _axes(cells, axis)
    groups = _groups(shown, cells, axes)
    trivial = None
    if baseline is not None:
        entries = {c.name: Entry(measured(baseline, c), count=1) for c in COLUMNS}
        entries = {k: Entry() if math.isnan(e.mean) else e for k, e in entries.items()}
        name = ("trivial predictor", *("" for _ in axes[1:]))
        trivial = Group(name, "trivial", False, (), entries)
    groups = [_with_leaders(group, groups, trivial) for group in groups]
    return Table(
        axes=axes,
        groups=tuple(groups),
        baseline=trivial,
        unfinished=tuple(
            _unfinished(r, axes) for r in rows if r.get("status", "done") not in SHOWN
        ),
        published=published(axis),
    )


def published(axis: str) -> tuple[Mapping[str, Any], ...]:
    """The lists of published rows that belong to this row axis."""
    lists = tomllib.loads(LITERATURE.read_text(encoding="utf-8"))["published"]
    return tuple(entry for entry in lists if entry["axis"] == axis)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def text(value: Any) -> str:
    """A setting as a reader writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(text(item) for item in value) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else str(value)


# --- groups ---------------------------------------------------------------------------------------


def _cell(row: Row) -> dict[str, Any]:
    """What identifies a row's cell, without its seed."""
    flat = flatten(row.get("cell") or {})
    for name in ("backbone", "method", "tasks", "video"):
        if name in row:
            flat.setdefault(name, row[name])
    if "recipe" in row and "recipe.name" not in flat:
        flat["recipe.name"] = row["recipe"]
    return {key: value for key, value in flat.items() if key not in NOT_NUMBERS}


def _axes(cells: list[dict[str, Any]], axis: str) -> tuple[str, ...]:
    """The row axis and whatever else differs between the cells, best known first."""
    known = ("method", "backbone", "tasks", "video", "pretrained", "recipe.name")
    keys = sorted({key for cell in cells for key in cell})
    varying = [k for k in keys if len({json.dumps(cell.get(k)) for cell in cells}) > 1]
    if "recipe.name" in varying:  # two recipes differ in much; their names say it
        varying = [k for k in varying if k == "recipe.name" or not k.startswith("recipe.")]
    rest = [k for k in known if k in varying] + [k for k in varying if k not in known]
    return (axis, *(key for key in rest if key != axis))


def _groups(rows: list[Row], cells: list[dict[str, Any]], axes: tuple[str, ...]) -> list[Group]:
    if not rows:
        return []
    frame = pd.DataFrame(
        {
            "group": [
                json.dumps(
                    [cell, row.get("status", "done"), bool(row.get("smoke"))], sort_keys=True
                )
                for cell, row in zip(cells, rows, strict=True)
            ],
            **{column.name: [measured(row, column) for row in rows] for column in COLUMNS},
        }
    )
    groups = []
    for _, members in frame.groupby("group", sort=False):
        values = members[[column.name for column in COLUMNS]]
        summary = pd.DataFrame(
            {"mean": values.mean(), "std": values.std(), "count": values.count()}
        )
        first = rows[members.index[0]]
        groups.append(
            Group(
                identity=tuple(text(cells[members.index[0]].get(axis)) for axis in axes),
                status=first.get("status", "done"),
                smoke=bool(first.get("smoke")),
                rows=tuple(rows[i] for i in members.index),
                entries={
                    str(name): Entry(float(line["mean"]), float(line["std"]), int(line["count"]))
                    for name, line in summary.iterrows()
                },
            )
        )
    return groups


def measured(row: Row, column: Column) -> float:
    """A row's value in the column's unit; NaN where it has none."""
    value = row.get("metric", {}).get(column.key)
    if value is None:
        value = flatten(row).get(column.key)
    return math.nan if value is None else float(value) * column.scale


def _with_leaders(group: Group, groups: list[Group], trivial: Group | None) -> Group:
    entries = {
        name: Entry(e.mean, e.std, e.count, _leads(group, name, groups, trivial))
        for name, e in group.entries.items()
    }
    return Group(group.identity, group.status, group.smoke, group.rows, entries)


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
    return not floor.count or better * (own.mean - floor.mean) > own.std


def _unfinished(row: Row, axes: tuple[str, ...]) -> Unfinished:
    cell = _cell(row)
    label = ", ".join(text(cell[axis]) for axis in axes if axis in cell)
    lines = [line.strip() for line in str(row.get("error") or "").splitlines() if line.strip()]
    seed = f", seed {row['seed']}" if "seed" in row else ""
    return Unfinished(
        label=label + seed,
        slug=str(row.get("slug", "")),
        status=str(row["status"]),
        reason=lines[-1] if lines else "no numbers yet",
    )
