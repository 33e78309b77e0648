"""Measured rows among those that the paper compares itself with: who stands where, and why.

Only what was measured on the data set itself, by a protocol of the table and on all of its frames
is sorted among the published rows. Rows of other protocols or of fewer frames, and rows of the
built-in data, stand in sections of their own and say so.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from mtl_bench.report.columns import Row
from mtl_bench.report.groups import Entry
from mtl_bench.report.lines import Line, dataset_of, measured_lines, published_lines
from mtl_bench.report.published import NUMBERS, Literature
from mtl_bench.report.tables import SHOWN


@dataclass(frozen=True)
class Section:
    heading: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Comparison:
    """A table: its sections, sorted each, and what must be said below."""

    literature: Literature
    sections: tuple[Section, ...]
    notes: tuple[str, ...]

    @property
    def lines(self) -> list[Line]:
        return [line for section in self.sections for line in section.lines]

    @property
    def published(self) -> list[Line]:
        return [line for line in self.lines if line.kind == "published"]

    @property
    def measured(self) -> list[Line]:
        return [line for line in self.lines if line.kind == "measured"]


def compare(literature: Literature, rows: Sequence[Row], smoke: bool = False) -> Comparison:
    """Set rows among the published ones.

    Args:
        rows: as `row.json` holds them, with a status; of any data set.
        smoke: smoke rows alone, in place of all others.
    """
    wanted = (*literature.datasets, *literature.built_in)
    own = [row for row in rows if dataset_of(row) in wanted and row.get("status") in SHOWN]
    chosen = [row for row in own if bool(row.get("smoke")) is smoke]
    lines = [*published_lines(literature), *measured_lines(literature, chosen)]
    name = literature.name
    headings = (
        f"Published, and measured on {name} by the table's protocol",
        f"Measured on {name}, not comparable with the above",
        f"Measured on the built-in data, not on {name}",
    )
    sections = tuple(
        Section(heading, tuple(_sorted(literature, [l_ for l_ in lines if l_.place == place])))
        for place, heading in enumerate(headings)
    )
    found = Comparison(literature, tuple(s for s in sections if s.lines), ())
    left_out = sum(bool(row.get("smoke")) for row in own) if not smoke else 0
    return replace(found, notes=tuple(_notes(found, left_out)))


# --- parts ----------------------------------------------------------------------------------------


def _sorted(literature: Literature, lines: Sequence[Line]) -> list[Line]:
    """Best first; equals stay in their order, and what has no value comes last."""
    better = NUMBERS[literature.sort].better

    def rank(line: Line) -> tuple[bool, float]:
        value = line.entries.get(literature.sort, Entry()).mean
        return math.isnan(value), 0.0 if math.isnan(value) else -better * value

    return sorted(lines, key=rank)


def _notes(table: Comparison, left_out: int) -> Iterator[str]:
    literature, lines = table.literature, table.lines
    yield f"Published rows as printed in {literature.source}; they have no n and no spread."
    yield from literature.notes
    for symbol, meaning in literature.symbols.items():
        yield f"{symbol} {meaning}"
    yield from (f"{line.texts['method']}: {line.note}" for line in lines if line.note)
    if not table.measured:
        yield "No measured row: no finished cell belongs to this table."
    else:
        yield (
            "Measured rows: mean +- sample standard deviation over n seeds; speed at batch 1 with "
            "all tasks of the cell, transfer and post-processing, in PyTorch without an optimizing "
            "engine. Nothing is bold: a published number has no spread to lead by."
        )
    if any(line.place == 2 for line in lines):
        yield f"Built-in data: rendered scenes, whose numbers say nothing of {literature.name}."
    if left_out:
        rows = "smoke row is" if left_out == 1 else "smoke rows are"
        yield f"{left_out} {rows} left out; --smoke shows them, apart and marked."
