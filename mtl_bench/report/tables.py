"""What stands in a report's table: one line per group of cells that differ only in their seed.

Nothing is drawn or formatted here. Cells of different status never share a line, and neither do
measured, trivial and published values.
"""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mtl_bench.report.columns import COLUMNS, ONLY, RELATIVE, Column, Row
from mtl_bench.report.groups import Group, axes_of, cell_of, grouped, text, trivial_group
from mtl_bench.report.layout import Layout

LITERATURE = Path(__file__).parent / "literature.toml"
SHOWN = ("done", "stale")  # statuses that have numbers


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
    all_columns: tuple[Column, ...] = COLUMNS
    reference: str | None = None  # the line that some columns are relative to

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
            for column in self.all_columns
            if part in (None, column.part)
            and any(g.entries[column.name].count for g in self.groups)
        ]


def tabulate(
    rows: Sequence[Row], layout: Layout | None = None, baseline: Row | None = None
) -> Table:
    """Group rows by everything but the seed, and say which group leads each column.

    Args:
        rows: as `row.json` holds them, with a status; rows without numbers have an error at most.
        layout: which field of a cell names a line (others join it where they differ), which
            columns there are and how they are ordered.
        baseline: metrics of the trivial predictor.
    """
    layout = layout or Layout()
    axes = axes_of([row for row in rows if row.get("status", "done") in SHOWN], layout.rows)
    trivial = None if baseline is None or layout.only else trivial_group(baseline, axes)
    return Table(
        axes=axes,
        groups=tuple(grouped(rows, SHOWN, axes, trivial, layout.reference)),
        baseline=trivial,
        unfinished=tuple(
            _unfinished(r, axes) for r in rows if r.get("status", "done") not in SHOWN
        ),
        published=published(layout.rows, {text(cell_of(row).get(layout.rows)) for row in rows}),
        all_columns=_columns(layout),
        reference=layout.reference,
    )


def published(axis: str, names: Iterable[str]) -> tuple[Mapping[str, Any], ...]:
    """The lists of published rows that belong to this row axis.

    A list of named rows belongs to the grid that has at least two of its names.
    """
    lists = tomllib.loads(LITERATURE.read_text(encoding="utf-8"))["published"]
    return tuple(
        entry
        for entry in lists
        if entry["axis"] == axis
        and (axis != "name" or len({row["name"] for row in entry["rows"]} & set(names)) > 1)
    )


def _columns(layout: Layout) -> tuple[Column, ...]:
    """All that a table of this layout may show, in its order."""
    columns = list(COLUMNS)
    if layout.reference is not None:
        for column in RELATIVE:  # each behind the one that it is made of
            at = next(i for i, other in enumerate(columns) if other.name == column.key)
            columns.insert(at + 1, replace(column, note=f"x of {layout.reference}"))
    if layout.only is not None:
        columns = [column for column in columns if column.name in ONLY[layout.only]]
    return tuple(sorted(columns, key=lambda column: _rank(column.name, layout.first)))


def _rank(name: str, first: tuple[str, ...]) -> int:
    return first.index(name) if name in first else len(first)


def _unfinished(row: Row, axes: tuple[str, ...]) -> Unfinished:
    cell = cell_of(row)
    label = ", ".join(text(cell[axis]) for axis in axes if axis in cell)
    lines = [line.strip() for line in str(row.get("error") or "").splitlines() if line.strip()]
    seed = f", seed {row['seed']}" if "seed" in row else ""
    return Unfinished(
        label=(label or str(row.get("slug", ""))) + seed,
        slug=str(row.get("slug", "")),
        status=str(row["status"]),
        reason=lines[-1] if lines else "no numbers yet",
    )
