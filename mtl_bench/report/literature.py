"""Measured rows beside published ones: who stands where, and why.

Where a table has a column to sort by, what was measured on the data set itself, by a protocol of
the table and on all of its frames is sorted among the published rows. In a table without one,
nothing is: published rows stand as in the file, so that two papers that disagree about a method are
neighbours, and measured rows have a section of their own. Rows of other protocols or of fewer
frames, and rows of the built-in data, stand apart and say so.

The tables are `literature/*.toml`: what is printed, and its source. Numbers stay as printed (63.05,
63 and 5.240): `Decimal` keeps their digits. Multi-task deltas are recomputed from them.
"""

import math
import re
import string
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.config import load_recipe, recipe_names, to_dict
from mtl_bench.core.plain import did_you_mean, from_dict
from mtl_bench.evaluate.delta import delta_flat, delta_task
from mtl_bench.report.columns import DELTA, Row, flatten, measured, text
from mtl_bench.report.delta import with_single_task_delta
from mtl_bench.report.page import PAGE, Page, beside, render
from mtl_bench.report.statistics import (
    KNOWN,
    SHOWN,
    SMOKE,
    Entry,
    Group,
    axes_of,
    cell_of,
    entry_of,
    grouped,
)
from mtl_bench.report.table import (
    NOTHING,
    Cell,
    Head,
    Section,
    Table,
    TableRow,
    latex,
    number,
    numbers,
    tex,
)
from mtl_bench.report.table import write as write_files

FOLDER = Path(__file__).parent / "literature"
TEXTS = {  # columns of words: their titles
    "method": "Method",
    "backbone": "Backbone",
    "input": "Input size",
    "data": "DS",
    "device": "Device",
    "protocol": "Protocol",
    "frames": "Frames",
    "printed_in": "Printed in",
    "rerun_by": "Run again by",
}
COST = (Column("runtime_ms", "latency.mean_ms", "Runtime", -1, 1, "ms", part="cost"), FPS)
PRECISE = tuple(replace(column, digits=2) for column in DELTA)
PUBLISHED = -1  # the section of published rows, where measured ones are not sorted among them
LONG = 46  # characters of a method with its details: longer ones are broken in LaTeX
UNNEEDED = re.compile(r"\((R|TM)\)| Processor\b| CPU\b(?= )")  # of a device's name
FULL_FRAME = "full-frame"  # rows from before protocols had names
SAID = {"recipe.data.dataset", "recipe.data.height", "recipe.data.width", *KNOWN} - {"granularity"}


@dataclass(frozen=True)
class Scaling:
    """One way to scale a result before it is compared with the truth."""

    name: str = ""
    place: str = ""  # of its metrics, behind a protocol's prefix
    failed: str = ""  # where the frames are counted that it found no scale for


@dataclass(frozen=True)
class Literature:
    """One table of published rows, and what may stand beside it."""

    name: str  # of the data set, as one writes it
    title: str
    source: str
    datasets: tuple[str, ...]  # of cells measured on it
    built_in: tuple[str, ...]  # of cells measured on rendered scenes in its layout
    split: str
    frames: int  # of the split, as papers report it
    columns: tuple[str, ...]  # of TEXTS, `number`, COST and DELTA, in their order
    narrow: tuple[str, ...]  # those that fit on a page of a paper
    sort: str = ""  # the column; none: published and measured rows stand apart
    label: str = ""  # of the table in the MGNet paper's source
    baseline: str = ""  # method of the row that published deltas are against
    printed_delta: str = ""  # which of DELTA `delta_printed` is
    published: Mapping[str, str] = field(default_factory=dict)  # words of every published row
    papers: Mapping[str, str] = field(default_factory=dict)  # as `printed_in` names them
    data: str = ""  # what the column of training images says of measured rows
    protocols: tuple[str, ...] = ()  # that the table compares; none: no scaling in it
    width_first: bool = False  # how a size is written
    titles: Mapping[str, str] = field(default_factory=dict)  # other than in TEXTS
    notes: tuple[str, ...] = ()
    symbols: Mapping[str, str] = field(default_factory=dict)  # behind a method: what it says
    number: tuple[Column, ...] = ()  # {scaled} in a key is a scaling's place
    scaling: tuple[Scaling, ...] = (Scaling(),)
    # columns, details, source; symbols, note, printed_as; n, se (by column), read_in, and what is
    # wrong with it: differs (the delta from the row's numbers), copied (it is another row's)
    row: tuple[Mapping[str, Any], ...] = ()

    @property
    def numbers(self) -> dict[str, Column]:
        """Those of `columns`, by name, in their order."""
        known = {column.name: column for column in (*self.number, *COST, *PRECISE)}
        return {name: known[name] for name in self.columns if name in known}

    @property
    def has_deltas(self) -> bool:
        return any(column.name in self.columns for column in DELTA)

    @property
    def counted(self) -> list[Column]:
        """Those that deltas are made of."""
        return [column for column in self.number if column.in_delta]


def names() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(name: str) -> Literature:
    """A table by its name.

    Raises:
        ValueError: no such table.
    """
    if name not in names():
        raise ValueError(f"no table called '{name}'{did_you_mean(name, names())}")
    content = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    return from_dict(Literature, tomllib.loads(content, parse_float=Decimal))


# --- who stands where -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A published row, or cells that differ in their seed only, by one protocol."""

    kind: str  # published | measured
    texts: Mapping[str, str]  # columns of words
    entries: Mapping[str, Entry]  # columns of numbers
    details: str  # behind the method: venue, or what else the cells are
    count: int = 0  # seeds
    errors: Mapping[str, str] = field(default_factory=dict)  # a published row's standard errors
    marks: tuple[str, ...] = ()  # what a reader must know before the numbers
    printed: Mapping[str, str] = field(default_factory=dict)  # a published row's numbers
    symbols: str = ""
    source: str = ""
    note: str = ""
    place: int = 0  # index of its heading

    @property
    def what(self) -> str:
        return "; ".join((self.kind, *self.marks))

    @property
    def seeds(self) -> str:
        return str(self.count) if self.count else NOTHING


@dataclass(frozen=True)
class Part:
    heading: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Comparison:
    """Its parts, sorted each, and what must be said below."""

    literature: Literature
    sections: tuple[Part, ...]
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
    own: Sequence[Row] = [
        row for row in rows if dataset_of(row) in wanted and row.get("status") in SHOWN
    ]
    if literature.has_deltas:
        own = with_single_task_delta(own, literature.counted)
    chosen = [row for row in own if bool(row.get("smoke")) is smoke]
    lines = [*_published(literature), *_measured(literature, chosen)]
    name = literature.name
    headings = {
        PUBLISHED: "Published",
        0: f"Published, and measured on {name} by the table's protocol",
        1: f"Measured on {name}, not comparable with the above",
        2: f"Measured on the built-in data, not on {name}",
    }
    if not literature.sort:
        headings[0] = f"Measured on {name}, on the frames of the published rows"
    parts = tuple(
        Part(heading, tuple(_sorted(literature, [l_ for l_ in lines if l_.place == place])))
        for place, heading in headings.items()
    )
    found = Comparison(literature, tuple(part for part in parts if part.lines), ())
    left_out = sum(bool(row.get("smoke")) for row in own) if not smoke else 0
    return replace(found, notes=tuple(_notes(found, left_out)))


def dataset_of(row: Row) -> Any:
    return cell_of(row).get("recipe.data.dataset")


def _sorted(literature: Literature, lines: Sequence[Line]) -> list[Line]:
    """Best first; equals stay in their order, and what has no value comes last."""
    if not literature.sort:
        return list(lines)
    better = literature.numbers[literature.sort].better

    def rank(line: Line) -> tuple[bool, float]:
        value = line.entries.get(literature.sort, Entry()).mean
        return math.isnan(value), 0.0 if math.isnan(value) else -better * value

    return sorted(lines, key=rank)


def _notes(found: Comparison, left_out: int) -> Iterator[str]:
    literature, lines = found.literature, found.lines
    spread = "n and standard errors as far as printed" if literature.papers else "no n, no spread"
    yield f"Published rows as printed in {literature.source}; {spread}."
    yield from literature.notes
    for symbol, meaning in literature.symbols.items():
        yield f"{symbol} {meaning}"
    yield from (f"{line.texts['method']}: {line.note}" for line in lines if line.note)
    if not found.measured:
        yield "No measured row: no finished cell belongs to this table."
    else:
        yield (
            f"Measured rows: mean +- sample standard deviation over n seeds{_speed(literature)}. "
            "Nothing is bold: a published number has no spread to lead by."
        )
    if any(line.place == 2 for line in lines):
        yield f"Built-in data: rendered scenes, whose numbers say nothing of {literature.name}."
    if left_out:
        rows = "smoke row is" if left_out == 1 else "smoke rows are"
        yield f"{left_out} {rows} left out; --smoke shows them, apart and marked."


def _speed(literature: Literature) -> str:
    if not any(column.name in literature.columns for column in COST):
        return ""
    return (
        "; speed at batch 1 with all tasks of the cell, transfer and post-processing, in PyTorch "
        "without an optimizing engine"
    )


def _published(literature: Literature) -> list[Line]:
    known = literature.numbers
    lines = []
    for row in literature.row:
        computed = deltas(literature, row)
        values = {**row, **{k: number(v, known[k]) for k, v in computed.items() if k in known}}
        printed = {k: str(v) for k, v in values.items() if k in known}
        exact = {**{k: float(v) for k, v in row.items() if k in known}, **computed}
        wrong = {"copied": "copy error", "differs": "printed \u0394 is not the row's"}
        marks = [f"{said}: {row[key]}" for key, said in wrong.items() if key in row]
        paper = str(row.get("printed_in", ""))
        read = f" (read in {row['read_in']})" if "read_in" in row else ""
        words = {**literature.published, **row, "printed_in": paper + read}
        lines.append(
            Line(
                kind="published",
                texts={k: str(v) for k, v in words.items() if k in TEXTS},
                entries={k: Entry(exact[k], count=1) for k in printed},
                printed=printed,
                errors={k: str(v) for k, v in row.get("se", {}).items()},
                details=row.get("details", ""),
                count=row.get("n", 0),
                marks=tuple(marks),
                symbols=row.get("symbols", ""),
                source=row.get("source") or literature.papers[paper.split(",")[0]],
                note=row.get("note", ""),
                place=0 if literature.sort else PUBLISHED,
            )
        )
    return lines


def deltas(literature: Literature, row: Mapping[str, Any]) -> dict[str, float]:
    """Both deltas of a published row, from its numbers as printed; {} where it lacks one."""
    columns = literature.counted
    base = next((r for r in literature.row if r["method"] == literature.baseline), row)
    if base["method"] == row["method"] or not all(column.name in row for column in columns):
        return {}
    own, other = ({c.name: float(r[c.name]) for c in columns} for r in (row, base))
    upward = {column.name: column.better > 0 for column in columns}
    return {
        "delta_flat": delta_flat(own, other, upward),
        "delta_task": delta_task(own, other, upward, {c.name: c.task for c in columns}),
    }


# --- what was measured ----------------------------------------------------------------------------


def _measured(literature: Literature, rows: Sequence[Row]) -> Iterator[Line]:
    """One line per group and, where a table compares protocols, per protocol and scaling.

    Groups are made per recipe: within one, what differs is named; a recipe's name says the rest.
    """
    recipes = dict.fromkeys(str(cell_of(row).get("recipe.name")) for row in rows)
    for recipe in recipes:
        own = [row for row in rows if str(cell_of(row).get("recipe.name")) == recipe]
        axes = axes_of(own, "method")
        for group in grouped(own, axes):
            details = _details(group, axes, literature)
            for prefix, about in _protocols(group):
                for scaling in literature.scaling:
                    line = _line(literature, group, prefix, about, scaling)
                    shown = [literature.sort] if literature.sort else line.entries
                    if any(line.entries[name].count for name in shown):
                        yield replace(line, details=details)
                if not literature.protocols:
                    break


def _protocols(group: Group) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Where a protocol's metrics are, and what the row says of it, its name among it."""
    main = group.rows[0].get("protocol", {})
    for name, about in {"": main, **main.get("also", {})}.items():
        yield f"{name}." * bool(name), {"name": name or FULL_FRAME, **about}


def _line(
    literature: Literature, group: Group, prefix: str, about: Mapping[str, Any], scaling: Scaling
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
    # frames of all seeds that no scale was found for: its errors leave them out
    failed = sum(int(row.get("metric", {}).get(prefix + scaling.failed, 0)) for row in group.rows)
    marks += [f"no {scaling.name} scale in {failed} frames"] * bool(failed)
    scaled = prefix + scaling.place
    return Line(
        kind="measured",
        texts={
            **_texts(literature, group.rows),
            "protocol": f"{about['name']}, {scaling.name}"
            if literature.protocols
            else _training(group.rows[0]),
            "frames": _text(frames) if built_in else f"{_text(frames)}/{all_frames}",
        },
        entries={c.name: _entry(group.rows, c, scaled) for c in literature.numbers.values()},
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
    metrics = [row.get("metric", {}) for row in rows]
    devices = dict.fromkeys(
        UNNEEDED.sub("", str(m["latency.device"])) for m in metrics if "latency.device" in m
    )
    elsewhere = [f"at {_size(timed, literature)}"] * (bool(timed) and timed != list(size))
    counts = sorted({m["latency.threads"] for m in metrics if "latency.threads" in m})
    threads = [f"{' or '.join(map(str, counts))} thread{'s' * (counts != [1])}"] if counts else []
    return {
        "method": str(cell.get("method")),
        "backbone": str(cell.get("backbone")),
        "input": _size(size, literature),
        "data": "built-in" if dataset_of(rows[0]) in literature.built_in else literature.data,
        "device": ", ".join([" or ".join(devices), *threads, *elsewhere]) if devices else NOTHING,
    }


def _training(row: Row) -> str:
    cell = cell_of(row)
    return f"{cell.get('recipe.optim.steps')} steps of {cell.get('recipe.optim.batch')}, the last"


def _details(group: Group, axes: Sequence[str], literature: Literature) -> str:
    """What else names the cells: tasks, video stage, weights, recipe, and whatever differs."""
    cell = cell_of(group.rows[0])
    tasks = cell.get("tasks", ())
    said = [str(cell.get("backbone"))] * ("backbone" not in literature.columns)
    said += [f"{tasks[0]} alone"] * (len(tasks) == 1)
    said += ["one network a task"] * bool(cell.get("single_task"))
    said += ["video stage"] * bool(cell.get("video"))
    if cell.get("replay"):
        said.append(f"replay {cell['replay']}")
    if cell.get("pretrained"):
        said.append(f"weights {Path(cell['pretrained']).name}")
    said.append(f"recipe {cell.get('recipe.name')}")
    shipped = _shipped(str(cell.get("recipe.name")))
    for axis in axes:
        if axis in cell and axis not in SAID and text(cell[axis]) != text(shipped.get(axis)):
            name = axis.removeprefix("recipe.").removeprefix("method_args.")
            said.append(f"{name} {text(cell[axis])}")
    return ", ".join(said)


def _shipped(name: str) -> dict[str, Any]:
    """A recipe's values as the package has them: what a line need not say; {} for a user's own."""
    if name not in recipe_names():
        return {}
    return flatten({"recipe": to_dict(load_recipe(name))})


def _entry(rows: Sequence[Row], column: Column, scaled: str) -> Entry:
    column = replace(column, key=column.key.format(scaled=scaled))
    return entry_of([measured(row, column) for row in rows])


def _size(size: Sequence[Any], literature: Literature) -> str:
    return "x".join(map(str, reversed(size) if literature.width_first else size))


def _text(value: Any) -> str:
    return NOTHING if value is None else text(value)


# --- the table ------------------------------------------------------------------------------------


def fill(found: Comparison, narrow: bool = False) -> Table:
    """A section for each part.

    Args:
        narrow: the columns that fit on a page of a paper; marks are letters, explained below.
    """
    literature = found.literature
    every = [name for name in literature.columns if name != "method"]
    shown = [name for name in every if name in literature.narrow] if narrow else every
    letters = _letters(found, shown) if narrow else {}
    heads = [_head(literature, name) for name in shown]
    heads = [*Head.words("Method", "Origin"), *heads, Head("n")]
    return Table(
        sections=tuple(
            Section(part.heading, tuple(heads), _rows(literature, part, shown, letters))
            for part in found.sections
        ),
        notes=found.notes,
        records=tuple(_records(found, every)),
        title=literature.title,
        sources=tuple(f"{name}: {citation}." for name, citation in literature.papers.items())
        or tuple(dict.fromkeys(f"{r['method']}: {r['source']}." for r in literature.row)),
        joined=True,
        letters={letter: meaning for meaning, letter in letters.items()},
    )


def _rows(
    literature: Literature, part: Part, shown: Sequence[str], letters: Mapping[str, str]
) -> tuple[TableRow, ...]:
    rows = []
    for line in part.lines:
        values = [cell(line, name, literature.numbers) for name in shown]
        origin = _origin(line, letters, shown)
        css = line.kind + " marked" * bool(line.marks)
        rows.append(TableRow.of(_method(line), origin, *values, line.seeds, css=css))
    return tuple(rows)


def cell(line: Line, name: str, known: Mapping[str, Column]) -> Cell:
    """A column's words, or its number with its spread; a published number is as printed."""
    if name in TEXTS:
        return Cell(line.texts.get(name, NOTHING))
    if line.kind == "published":
        entry, error = line.entries.get(name), line.errors.get(name)
        spread = f"(SE {error})" if error else ""
        return Cell(line.printed.get(name, NOTHING), spread, value=entry.mean if entry else None)
    return Cell.of(line.entries[name], known[name], line.count)


def _head(literature: Literature, name: str) -> Head:
    if name in literature.numbers:
        return Head.of(literature.numbers[name])
    return Head(literature.titles.get(name, TEXTS[name]), left=True, css=name)


def _method(line: Line) -> Cell:
    """With its details; LaTeX has a long one in two lines or more."""
    name = line.texts["method"] + line.symbols
    small = rf"{tex(name)} {{\scriptsize {tex(line.details)}}}"
    if len(line.texts["method"] + line.details) > LONG:
        small = rf"\parbox[t]{{17em}}{{\raggedright {small}\strut}}"
    html = Markup("{} <small>{}</small>").format(name, line.details)
    return Cell(f"{name} ({line.details})" if line.details else name, html=html, tex=small)


def _origin(line: Line, letters: Mapping[str, str], shown: Sequence[str]) -> Cell:
    """Published or measured, and what must be known before the numbers."""
    marks = (Markup(' <span class="mark">{}</span>').format(mark) for mark in line.marks)
    html = Markup("").join([line.kind, *marks])
    own = ",".join(sorted(letters[said] for said in _explained(line, shown) if letters))
    return Cell(line.what, html=html, tex=line.kind + (f"$^{{{own}}}$" if own else ""))


def _explained(line: Line, shown: Sequence[str]) -> list[str]:
    """What a row's letters stand for: its marks, and the device where that is no column."""
    device = line.texts.get("device", NOTHING)
    timed = "device" not in shown and device != NOTHING
    return [*line.marks, *[f"on {device}"] * timed]


def _letters(found: Comparison, shown: Sequence[str]) -> dict[str, str]:
    """A letter for everything that needs one, in the order of the lines."""
    every = dict.fromkeys(said for line in found.lines for said in _explained(line, shown))
    return dict(zip(every, string.ascii_lowercase, strict=False))


def _records(found: Comparison, shown: Sequence[str]) -> Iterator[dict[str, Any]]:
    """One line per row: its section, kind and marks, words, mean and deviation of every number."""
    for part in found.sections:
        for line in part.lines:
            values: dict[str, Any] = {"kind": line.kind, "mark": "; ".join(line.marks)}
            values |= {"section": part.heading, "method": line.texts["method"]}
            values |= {"symbols": line.symbols, "details": line.details}
            for name in shown:
                if name in TEXTS:
                    values[name] = line.texts.get(name, "")
                else:
                    values |= numbers(line.entries, [found.literature.numbers[name]])
            values |= {f"{name}_se": error for name, error in line.errors.items()}
            yield values | {"n": line.count, "note": line.note, "source": line.source}


def write(found: Comparison, out_dir: Path, command: str) -> Path:
    """Write `table.{csv,md,tex}` and `index.html`; the same rows give the same bytes.

    Returns:
        The page's path.
    """
    table, title = fill(found), found.literature.title
    lack = "" if found.measured else " No finished cell belongs to this table."
    page = Page(
        kind="literature",
        title=f"{title}: mtl-bench",
        heading=title,
        about=Markup("{} published rows, {} measured.{}").format(
            len(found.published), len(found.measured), lack
        ),
        command=command,
    )
    with beside(out_dir) as folder:
        more = {
            "table.tex": latex(fill(found, narrow=True)),
            PAGE: render(page, table, folder),
        }
        write_files(table, folder, more)
    return out_dir / PAGE
