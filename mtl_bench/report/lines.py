"""The lines of a comparison table: published rows, and groups of measured ones by protocol."""

import math
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mtl_bench.core.config import load_recipe, recipe_names, to_dict
from mtl_bench.report.columns import Column, Row, flatten, measured
from mtl_bench.report.groups import KNOWN, SMOKE, Entry, Group, axes_of, cell_of, grouped, text
from mtl_bench.report.published import NUMBERS, TEXTS, Literature
from mtl_bench.report.tables import SHOWN

NOTHING = "-"
UNNEEDED = re.compile(r"\((R|TM)\)| Processor\b| CPU\b(?= )")  # of a device's name
SCALINGS = ("median", "dgc")
FULL_FRAME = "full-frame"  # rows from before protocols had names
SAID = {"recipe.data.dataset", "recipe.data.height", "recipe.data.width", *KNOWN} - {"granularity"}


@dataclass(frozen=True)
class Line:
    """A published row, or cells that differ in their seed only, by one protocol."""

    kind: str  # published | measured
    texts: Mapping[str, str]  # columns of words
    entries: Mapping[str, Entry]  # columns of numbers
    details: str  # behind the method: venue, or what else the cells are
    count: int = 0  # seeds
    marks: tuple[str, ...] = ()  # what a reader must know before the numbers
    printed: Mapping[str, str] = field(default_factory=dict)  # a published row's numbers
    symbols: str = ""
    source: str = ""
    note: str = ""
    place: int = 0  # index into Comparison.sections

    @property
    def what(self) -> str:
        return "; ".join((self.kind, *self.marks))

    @property
    def seeds(self) -> str:
        return str(self.count) if self.count else NOTHING


# --- published ------------------------------------------------------------------------------------


def published_lines(literature: Literature) -> list[Line]:
    return [
        Line(
            kind="published",
            texts={k: str(v) for k, v in row.items() if k in TEXTS},
            entries={k: Entry(float(v), count=1) for k, v in row.items() if k in NUMBERS},
            printed={k: str(v) for k, v in row.items() if k in NUMBERS},
            details=row["details"],
            symbols=row.get("symbols", ""),
            source=row["source"],
            note=row.get("note", ""),
        )
        for row in literature.row
    ]


# --- measured -------------------------------------------------------------------------------------


def measured_lines(literature: Literature, rows: Sequence[Row]) -> Iterator[Line]:
    """One line per group and, in a table of depth, per protocol and scaling.

    Groups are made per recipe: within one, what differs is named; a recipe's name says the rest.
    """
    recipes = dict.fromkeys(str(cell_of(row).get("recipe.name")) for row in rows)
    for recipe in recipes:
        own = [row for row in rows if str(cell_of(row).get("recipe.name")) == recipe]
        axes = axes_of(own, "method")
        for group in grouped(own, SHOWN, axes):
            details = _details(group, axes, literature)
            for protocol, depth, about in _evaluations(literature, group):
                line = _line(literature, group, depth, protocol, about)
                if line.entries[literature.sort].count:
                    yield replace(line, details=details)


def _evaluations(
    literature: Literature, group: Group
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """A protocol's name, where its depth metrics are, and what the row says of it."""
    main = group.rows[0].get("protocol", {})
    every = {"": main, **{f"{name}.": about for name, about in main.get("also", {}).items()}}
    for prefix, about in every.items():
        name = about.get("name", prefix.removesuffix(".") or FULL_FRAME)
        scalings = SCALINGS if literature.protocols else SCALINGS[:1]
        for scaling in scalings:
            yield f"{name}, {scaling}", f"{prefix}depth_{scaling}", {**about, "name": name}
        if not literature.protocols:
            return


def _line(
    literature: Literature, group: Group, depth: str, protocol: str, about: Mapping[str, Any]
) -> Line:
    built_in = dataset_of(group.rows[0]) in literature.built_in
    frames, all_frames = about.get("frames"), about.get("published_frames") or literature.frames
    marks = [f"built-in data, not {literature.name}"] * built_in
    if not built_in:
        split = str(about.get("split"))
        other = bool(literature.protocols) and about["name"] not in literature.protocols
        marks += [f"protocol {about['name']}"] * other
        marks += [f"split {split}"] * (split != literature.split)
        marks += [f"{_text(frames)} of {all_frames} frames"] * (frames != all_frames)
    marks += [SMOKE] * group.smoke
    place = 2 if built_in else int(bool(marks))
    marks += ["stale"] * (group.status == "stale")
    failed = _failed(group.rows, depth)
    marks += [f"no dgc scale in {failed} frames"] * bool(failed)
    return Line(
        kind="measured",
        texts={
            **_texts(literature, group.rows),
            "protocol": protocol,
            "frames": _text(frames) if built_in else f"{_text(frames)}/{all_frames}",
        },
        entries={c.name: _entry(group.rows, c, depth) for c in literature.numbers},
        details="",
        count=len(group.rows),
        marks=tuple(marks),
        place=place,
    )


def _texts(literature: Literature, rows: Sequence[Row]) -> dict[str, str]:
    cell, metric = cell_of(rows[0]), rows[0].get("metric", {})
    size = rows[0].get("protocol", {}).get("input") or [
        cell.get("recipe.data.height"),
        cell.get("recipe.data.width"),
    ]
    timed = [metric[k] for k in ("latency.height", "latency.width") if k in metric]
    devices = dict.fromkeys(
        UNNEEDED.sub("", str(row["metric"]["latency.device"]))
        for row in rows
        if "latency.device" in row.get("metric", {})
    )
    elsewhere = [f"at {_size(timed, literature)}"] * (bool(timed) and timed != list(size))
    threads = [f"{metric['latency.threads']} threads"] * ("latency.threads" in metric)
    return {
        "method": str(cell.get("method")),
        "backbone": str(cell.get("backbone")),
        "input": _size(size, literature),
        "data": "built-in" if dataset_of(rows[0]) in literature.built_in else literature.data,
        "device": ", ".join([" or ".join(devices), *threads, *elsewhere]) if devices else NOTHING,
    }


def _details(group: Group, axes: Sequence[str], literature: Literature) -> str:
    """What else names the cells: tasks, video stage, weights, recipe, and whatever differs."""
    cell = cell_of(group.rows[0])
    tasks = cell.get("tasks", ())
    words = [str(cell.get("backbone"))] * ("backbone" not in literature.columns)
    words += [f"{tasks[0]} alone"] * (len(tasks) == 1)
    words += ["one network a task"] * bool(cell.get("single_task"))
    words += ["video stage"] * bool(cell.get("video"))
    if cell.get("pretrained"):
        words.append(f"weights {Path(cell['pretrained']).name}")
    words.append(f"recipe {cell.get('recipe.name')}")
    shipped = _shipped(str(cell.get("recipe.name")))
    for axis in axes:
        if axis in cell and axis not in SAID and text(cell[axis]) != text(shipped.get(axis)):
            name = axis.removeprefix("recipe.").removeprefix("method_args.")
            words.append(f"{name} {text(cell[axis])}")
    return ", ".join(words)


def _shipped(name: str) -> dict[str, Any]:
    """A recipe's values as the package has them: what a line need not say; {} for a user's own."""
    if name not in recipe_names():
        return {}
    return flatten({"recipe": to_dict(load_recipe(name))})


def _entry(rows: Sequence[Row], column: Column, depth: str) -> Entry:
    column = replace(column, key=column.key.format(depth=depth))
    values = [v for v in (measured(row, column) for row in rows) if not math.isnan(v)]
    if not values:
        return Entry()
    spread = statistics.stdev(values) if len(values) > 1 else math.nan
    return Entry(statistics.fmean(values), spread, len(values))


def _failed(rows: Sequence[Row], depth: str) -> int:
    """Frames of all seeds that dgc found no scale for: its errors leave them out."""
    if not depth.endswith("depth_dgc"):
        return 0
    key = depth.removesuffix("depth_dgc") + "dgc.failed"
    return sum(int(row.get("metric", {}).get(key, 0)) for row in rows)


# --- parts ----------------------------------------------------------------------------------------


def dataset_of(row: Row) -> Any:
    return cell_of(row).get("recipe.data.dataset")


def _size(size: Sequence[Any], literature: Literature) -> str:
    return "x".join(map(str, reversed(size) if literature.width_first else size))


def _text(value: Any) -> str:
    return NOTHING if value is None else text(value)
