"""The report of a grid of latencies: a line per timing, with what it lacks or doubts."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.quality import agreement, words
from mtl_bench.core.text import in_a_line
from mtl_bench.report import latency_plots, protocol
from mtl_bench.report.columns import Row, against, different, headlines, measured, text
from mtl_bench.report.grid import published
from mtl_bench.report.page import PAGE, Page, beside, figures_of, render
from mtl_bench.report.statistics import SHOWN, SMOKE, entry_of
from mtl_bench.report.table import (
    NOTHING,
    WRAP,
    Cell,
    Head,
    Section,
    Table,
    TableRow,
    markdown,
    number,
    write,
)

AXIS = "latency"  # of the published lists that stand beside it
REFERENCE = "plain"  # the engine that speed-ups are over
WORDS = {"missing": "not run"}  # a status as a reader says it
PASSES = 500  # the paper's
MEAN = Column("mean_ms", "latency.mean_ms", "mean", -1, 1, "ms", short=True)
TIMES = (
    MEAN,
    Column("p50_ms", "latency.p50_ms", "p50", -1, 1, "ms"),
    Column("p95_ms", "latency.p95_ms", "p95", -1, 1, "ms", short=True),
    Column("p99_ms", "latency.p99_ms", "p99", -1, 1, "ms"),
    replace(FPS, digits=2, short=True),
    Column("speedup", "latency.speedup", "speedup", +1, 2, f"x of {REFERENCE}", short=True),
    Column("transfer_ms", "latency.transfer_ms", "transfer", -1, 1, "ms"),
    Column("network_ms", "latency.network_ms", "network", -1, 1, "ms", short=True),
    Column("postprocess_ms", "latency.postprocess_ms", "postproc", -1, 1, "ms", short=True),
    Column("throughput_fps", "latency.throughput_fps", "batched", +1, 2, "FPS"),
)
MORE = (
    Column("roofline", "roofline.share", "roofline", +1, 0, "% reached", scale=100),
    Column("passes", "latency.passes", "passes", 0, 0),
)


def columns() -> tuple[Column, ...]:
    """Of numbers; those of a task say how near an engine's results are."""
    return (*TIMES, *agreement(), *MORE)


IDENTITY = ("backbone", "tasks", "engine", "precision")  # columns of words, beside the size
PUBLISHED = {  # columns of a published list: words, then numbers
    **{name: name for name in ("name", "backbone", "tasks", "size", "engine", "gpu")},
    **{"name": "published", "gpu": "GPU", "ms": "ms", "fps": "FPS"},
}
NUMBERS = ("ms", "fps")


@dataclass(frozen=True)
class Line:
    """One timing."""

    row: Row
    size: str  # height x width
    names: tuple[str, ...]  # one per IDENTITY
    status: str  # done | stale | wrong | failed | unavailable | missing
    why: str
    values: Mapping[str, float]  # column -> number; NaN where there is none

    @property
    def shown(self) -> bool:
        return self.status in SHOWN

    @property
    def engine(self) -> str:
        return self.names[2]

    @property
    def tasks(self) -> frozenset[str]:
        return frozenset(self.row["tasks"])

    @property
    def label(self) -> str:
        return " ".join([*self.names, self.size])

    @property
    def mark(self) -> str:
        """What a reader must know before reading the numbers; empty for a plain result."""
        noisy = self.shown and bool(self.row["metric"].get("latency.noisy"))
        marks = ["" if self.status == "done" else WORDS.get(self.status, self.status)]
        return "; ".join(filter(None, [*marks, "noisy" * noisy, SMOKE * self.smoke]))

    @property
    def smoke(self) -> bool:
        return bool(self.row.get("smoke"))


@dataclass(frozen=True)
class Quality:
    """What a backbone reached where it was trained: means over seeds."""

    backbone: str
    values: Mapping[str, float]  # headline -> number
    seeds: int
    recipe: Mapping[str, Any]

    @property
    def size(self) -> str:
        return f"{self.recipe['data']['height']}x{self.recipe['data']['width']}"


@dataclass(frozen=True)
class Timings:
    """A grid's timings; nothing is drawn or written yet."""

    lines: tuple[Line, ...]
    quality: tuple[Quality, ...] = ()

    @property
    def sizes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(line.size for line in self.lines))

    @property
    def smoke(self) -> bool:
        return any(line.smoke for line in self.lines)

    @property
    def measured(self) -> list[Line]:
        return [line for line in self.lines if line.shown]

    @property
    def tasks(self) -> list[str]:
        """The most that are timed together: what quality and speed are compared for."""
        rows = [line.row for line in self.measured or self.lines]
        return max((list(row["tasks"]) for row in rows), key=len)

    @property
    def whole(self) -> list[Line]:
        """The timings with numbers and all these tasks."""
        return [line for line in self.measured if line.tasks == set(self.tasks)]

    def of(self, size: str) -> list[Line]:
        return [line for line in self.lines if line.size == size]

    def columns(self) -> list[Column]:
        """Those that some line has."""
        return [c for c in columns() if any(not math.isnan(v.values[c.name]) for v in self.lines)]

    def facts(self, key: str) -> list[str]:
        """Different values of a measured fact, such as `latency.device`."""
        found = (line.row["metric"].get(f"latency.{key}") for line in self.measured)
        return different(value for value in found if value is not None)


def tabulate(rows: Sequence[Row], quality: Sequence[Row] = ()) -> Timings:
    """A line per timing, in the rows' order.

    Args:
        rows: as `store.rows` gives them.
        quality: done rows of trained cells, whose headlines the plots set beside the speed.
    """
    references = {_alike(row): row for row in rows if _is_reference(row)}
    timings = Timings(tuple(_line(row, references.get(_alike(row))) for row in rows))
    return replace(timings, quality=tuple(_qualities(quality, set(timings.tasks))))


def _is_reference(row: Row) -> bool:
    return row["engine"] == REFERENCE and row["status"] in SHOWN


def _alike(row: Row) -> str:
    """What a timing and its reference share: all but engine and precision."""
    timing = {k: v for k, v in row["timing"].items() if k not in ("engine", "precision")}
    return json.dumps(timing, sort_keys=True)


def _line(row: Row, reference: Row | None) -> Line:
    arguments = row["timing"].get("backbone_args", {})
    backbone = " ".join([row["backbone"], *(f"{k}={text(v)}" for k, v in arguments.items())])
    values = {c.name: measured(row, c) if _tells(row, c) else math.nan for c in columns()}
    if row["status"] in SHOWN and reference is not None:
        values["speedup"] = measured(reference, MEAN) / values[MEAN.name]
    return Line(
        row=row,
        size=f"{row['height']}x{row['width']}",
        names=(backbone, text(row["tasks"]), row["engine"], row["precision"]),
        status=row["status"],
        why=in_a_line(str(row.get("why") or "")),
        values=values,
    )


def _tells(row: Row, column: Column) -> bool:
    """Whether a row may show a number: a wrong one how wrong it is, and no time."""
    return row["status"] in SHOWN or (row["status"] == "wrong" and bool(column.task))


def _qualities(rows: Sequence[Row], tasks: set[str]) -> Iterator[Quality]:
    """Of the networks with just these tasks, by backbone."""
    whole = [row for row in rows if set(row["tasks"]) == tasks]
    for backbone in dict.fromkeys(row["backbone"] for row in whole):
        own = [row for row in whole if row["backbone"] == backbone]
        yield Quality(
            backbone=backbone,
            values={c.name: sum(measured(r, c) for r in own) / len(own) for c in headlines()},
            seeds=len(own),
            recipe=own[0]["cell"]["recipe"],
        )


# --- the table ------------------------------------------------------------------------------------


def fill(timings: Timings) -> Table:
    """A section for each size, what has no numbers, what others published, and the notes."""
    said = tuple(notes(timings))
    banner = f"{SMOKE.capitalize()}." if timings.smoke else ""
    captions = [f"{banner} Latency at {size}." for size in timings.sizes]
    captions[0] += f" {' '.join(said)}"
    lacking = [TableRow.of(*cells) for cells in without_numbers(timings)]
    heads = (*Head.words("status", "engine", "timings"), Head("why", left=True, css=WRAP))
    return Table(
        sections=tuple(
            _section(timings.of(size), timings.columns(), size, caption.strip())
            for size, caption in zip(timings.sizes, captions, strict=True)
        ),
        notes=said,
        records=tuple(_records(timings)),
        lacking=Section.lacking("Timings", heads, lacking),
        published=tuple(_published(source) for source in published(AXIS, ())),
        banner=banner,
    )


def readme(timings: Timings) -> Table:
    """The main columns of the largest size that was measured, all tasks: of each backbone the
    reference and the fastest engine of each precision."""
    size = max((line.size for line in timings.measured or timings.lines), key=_pixels)
    lines = [line for line in timings.of(size) if line.tasks == set(timings.tasks)]
    columns = [column for column in timings.columns() if column.short]
    what = f"{REFERENCE} and the fastest engine of each precision"
    lead = f"{size}, {text(timings.tasks)}, batch 1; {what}:"
    lacking = _lacking(line for line in lines if not line.shown)
    return Table(
        sections=(replace(_section(_fastest(lines), columns, ""), remark=lead),),
        notes=(*lacking, *islice(notes(timings), 1)),
        banner=f"{SMOKE.capitalize()}." if timings.smoke else "",
    )


def _section(
    lines: Sequence[Line], columns: Sequence[Column], heading: str, caption: str = ""
) -> Section:
    spelt = []
    for index, line in enumerate(lines):
        first = index > 0 and line.names[:2] != lines[index - 1].names[:2]
        backbone, tasks, engine, precision = line.names
        marked = Cell.marked(engine, line.mark)
        values = [Cell.of(entry_of([line.values[c.name]]), c) for c in columns]
        css = line.status + " smoke" * line.smoke + " first" * first
        spelt.append(TableRow.of(backbone, tasks, marked, precision, *values, css=css))
    heads = (*Head.words(*IDENTITY), *map(Head.of, columns))
    return Section(heading, heads, tuple(spelt), caption=caption)


def _published(source: Mapping[str, Any]) -> Section:
    """Its rows; of ms and FPS only what is printed, and nothing made of the other."""
    heads = tuple(Head(title, left=key not in NUMBERS) for key, title in PUBLISHED.items())
    rows = [[text(row.get(key, NOTHING)) for key in PUBLISHED] for row in source["rows"]]
    why = "another machine, trained on other images"
    return Section.published(source, heads, rows, "lines", why)


def _records(timings: Timings) -> Iterator[dict[str, Any]]:
    """One line per timing, with all that is known of it, then the published ones."""
    for line in timings.lines:
        values: dict[str, Any] = {"kind": "measured", "status": line.status, "mark": line.mark}
        values |= dict(zip(IDENTITY, line.names, strict=True)) | {"size": line.size}
        values |= {column.name: line.values[column.name] for column in columns()}
        metric = line.row["metric"] if line.shown else {}
        others = {key.partition(".")[2]: value for key, value in metric.items()}
        values |= {key: value for key, value in others.items() if key not in values}
        yield values | {"weights": line.row.get("weights", ""), "why": line.why}
    for source in published(AXIS, ()):
        for row in source["rows"]:
            named = {key: text(value) for key, value in row.items() if key not in NUMBERS}
            values = {"kind": "published", "mark": source["mark"], **named}
            yield values | {MEAN.name: row.get("ms"), FPS.name: row.get("fps")}


def _fastest(lines: Sequence[Line]) -> list[Line]:
    """Of each backbone's lines the reference's, and the least mean of each precision."""
    best: dict[tuple[str, str], Line] = {}
    for line in filter(lambda line: line.shown, lines):
        key = (line.names[0], line.names[3])
        if key not in best or line.values[MEAN.name] < best[key].values[MEAN.name]:
            best[key] = line
    chosen = [line for line in lines if line.engine == REFERENCE or line in best.values()]
    return chosen or list(lines)


def _pixels(size: str) -> int:
    height, _, width = size.partition("x")
    return int(height) * int(width)


# --- what must be said ----------------------------------------------------------------------------


def without_numbers(timings: Timings) -> list[tuple[str, str, str, str]]:
    """Status, engine, which timings and why: a line for each engine and reason."""
    found: dict[tuple[str, str, str], list[Line]] = {}
    for line in timings.lines:
        if not line.shown:
            found.setdefault((line.status, line.engine, line.why), []).append(line)
    return [
        (WORDS.get(status, status), engine, _which(lines), why or "mtl-bench ablate takes it")
        for (status, engine, why), lines in found.items()
    ]


def _which(lines: Sequence[Line]) -> str:
    return lines[0].label if len(lines) == 1 else f"{len(lines)} timings"


def _lacking(lines: Iterable[Line]) -> Iterator[str]:
    """A sentence for each status and its reason; wrong results share one."""
    found: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        backbone, _, engine, precision = line.names
        about = "not timed, as the result differs too much from plain's"
        why = about if line.status == "wrong" else line.why
        which = engine if line.status == "unavailable" else f"{backbone} {engine} {precision}"
        found.setdefault((WORDS.get(line.status, line.status), why), []).append(which)
    for (status, why), all_named in found.items():
        named = f"{status.capitalize()}: {', '.join(dict.fromkeys(all_named))}"
        yield f"{named} ({why})" if why else named


def notes(timings: Timings) -> Iterator[str]:
    """One sentence or two for each thing that occurs in the table."""
    lines = timings.measured
    if not lines:
        return
    where = ", ".join(timings.facts("device"))
    threads = " or ".join(timings.facts("threads"))
    made = " and ".join(words("timed", timings.tasks))
    yield (
        f"Measured on {where}, {threads} thread{'s' * (threads != '1')}, batch 1: from the 8-bit "
        f"image in host memory to {made}, transfer and post-processing in. "
        "FPS is 1000 / mean; the three stages add up to the mean."
    )
    if len(timings.facts("device")) > 1:
        yield "Several devices: lines of different devices do not compare."
    if any(not math.isnan(line.values["speedup"]) for line in lines):
        yield (
            f"Speed-up: mean of '{REFERENCE}' (eager torch as the network is trained, nothing "
            "folded) over a line's mean, same backbone, tasks and size."
        )
    batches = " or ".join(timings.facts("throughput_batch"))
    if batches:
        yield f"Batched: throughput in images a second, {batches} at a time."
    yield (
        f"Agreement: output compared with that of '{REFERENCE}' on the same images before anything "
        f"is timed: {', '.join(c.in_words for c in agreement())}. A line that "
        "differs too much is marked wrong and has no time."
    )
    if any(line.row.get("weights") == "random" for line in lines):
        but = "".join(f", but {said}" for said in words("random", timings.tasks))
        yield f"Random weights: a convolution takes as long as with trained ones{but}."
    yield from _doubts(timings)


def _doubts(timings: Timings) -> Iterator[str]:
    lines = timings.measured
    if any("noisy" in line.mark for line in lines):
        yield "Noisy: the passes spread or drift too much, as on a busy machine: --rerun all."
    fewest = min(line.values["passes"] for line in lines)
    if fewest < PASSES:
        yield (
            f"As few as {fewest:.0f} passes, where the paper has {PASSES}: "
            f"p99 is {'the slowest one' if fewest <= 100 else 'of few'}."
        )
    stale = list(dict.fromkeys(line.why for line in lines if line.status == "stale"))
    if stale:
        yield f"Stale: code changed after the time was taken ({', '.join(stale)}): --rerun stale."
    if timings.smoke:
        yield "Smoke: a few passes of a tiny network that show that all runs. Not a result."


# --- the report -----------------------------------------------------------------------------------


def figures() -> dict[str, str]:
    """Stems of the figures that the report may have -> their headings, in the page's order."""
    return {
        **{f"{column.name}_{FPS.name}": against(column, FPS) for column in headlines()},
        "stages": "Where the time of a frame goes",
        "roofline": "Roofline",
    }


def build(
    grid: Any,
    rows: Sequence[Row],
    out_dir: Path,
    quality: Sequence[Row] = (),
    command: str = "",
) -> Path:
    """Write the page, the tables and the figures; the same rows give the same bytes.

    Args:
        grid: its name, question, recipe and skips.
        rows: one per timing in the grid's order, as `store.rows` gives them.
        out_dir: created where absent; what an earlier build left is replaced.
        quality: done rows of trained cells of the same backbones.
        command: what reproduces the report.

    Returns:
        The page's path.
    """
    timings = tabulate(rows, quality)
    with beside(out_dir, figures()) as folder:
        _write(grid, timings, folder, command)
    return out_dir / PAGE


def _write(grid: Any, timings: Timings, folder: Path, command: str) -> None:
    captions = {
        f"{column.name}_{FPS.name}": latency_plots.against_quality(timings, column, folder)
        for column in headlines()
    }
    captions["stages"] = latency_plots.stages(timings, folder)
    captions["roofline"] = latency_plots.roofline(timings, folder)
    table = fill(timings)
    states = [line.status for line in timings.lines]
    counted = ", ".join(f"{states.count(s)} {s}" for s in dict.fromkeys(states))
    brief = "A few passes of a tiny network that show that all runs."
    page = Page(
        kind="latency",
        title=f"{grid.name}: mtl-bench report",
        heading=grid.question or grid.name,
        about=Markup("Grid <b>{}</b>, network of recipe <b>{}</b>. Timings: {}.").format(
            grid.name, grid.recipe, counted or "none"
        ),
        command=command,
        banner=timings.smoke * f"{table.banner} {brief}",
        figures=[replace(figure, wide=True) for figure in figures_of(figures(), captions)],
        aside=_beside(grid, timings),
        protocol=protocol.of_timings([line.row for line in timings.measured]),
        same="The same numbers, and more of each timing",
    )
    on_page = replace(table, notes=(*table.notes, *_left_out(grid)))
    more = {
        "readme.md": markdown(readme(timings)),
        PAGE: render(page, on_page, folder),
    }
    write(table, folder, more)


def _left_out(grid: Any) -> list[str]:
    """How many timings each reason leaves out."""
    reasons = [skip.why for skip in getattr(grid, "skips", ())]
    return [f"{reasons.count(why)} timings left out: {why}." for why in dict.fromkeys(reasons)]


def _beside(grid: Any, timings: Timings) -> str | Section:
    """The quality beside the speed, or why there is none."""
    if not timings.quality:
        name = getattr(grid, "quality", {}).get("grid")
        lack = Markup(
            "No plot of quality over speed: no cell of grid <b>{0}</b> is done "
            "(mtl-bench ablate --grid {0})."
        )
        return lack.format(name) if name else ""
    first, lines = timings.quality[0].values, []
    columns = [column for column in headlines() if not math.isnan(first[column.name])]
    for quality in timings.quality:
        values = [number(quality.values[column.name], column) for column in columns]
        trained = str(quality.seeds), str(quality.recipe["name"]), quality.size
        lines.append(TableRow.of(quality.backbone, *values, *trained))
    titles = (Head(column.title, column.about) for column in columns)
    heads = (*Head.words("backbone"), *titles, Head("n"), *Head.words("trained by recipe", "at"))
    return Section("Quality beside the speed", heads, tuple(lines))
