"""The table of a grid of latencies as CSV, Markdown, LaTeX and a page."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mtl_bench.report import formats, page
from mtl_bench.report.columns import Column, flatten
from mtl_bench.report.groups import SMOKE, text
from mtl_bench.report.latency_table import (
    COLUMNS,
    IDENTITY,
    REFERENCE,
    SHORT,
    WORDS,
    LatencyTable,
    Line,
    notes,
    without_numbers,
)
from mtl_bench.report.tables import published

TEMPLATE = "latency.html.j2"
SCIENTIFIC = ("depth_rel", "logits_max")  # differences over many orders of magnitude
LEFT = range(len(IDENTITY))  # columns of words
AXIS = "latency"  # of the published lists that stand beside it
PUBLISHED = {
    "name": "published",
    "backbone": "backbone",
    "tasks": "tasks",
    "size": "size",
    "engine": "engine",
    "gpu": "GPU",
    "ms": "ms",
    "fps": "FPS",
}
NAMES = range(6)  # its columns of words
SAME = ("argv", "threads", "device", "cpu")  # of the environment: said elsewhere, or no fact
FACTS = ("device", "threads", "passes", "warmup", "images", "throughput_batch", "clock")
PEAKS = {"peak_gflops": "GFLOP/s", "peak_gbs": "GB/s"}


def write(
    grid: Any,
    table: LatencyTable,
    figures: Sequence[page.Figure],
    out_dir: Path,
    command: str,
) -> Path:
    """Write `table.{csv,md,tex}`, `readme.md` and `index.html`; returns the page's path."""
    files = {
        "table.csv": csv(table),
        "table.md": markdown(table),
        "readme.md": readme(table),
        "table.tex": latex(table),
        "index.html": html(grid, table, figures, out_dir, command),
    }
    for name, content in files.items():
        (out_dir / name).write_text(content, encoding="utf-8", newline="\n")
    return out_dir / "index.html"


def csv(table: LatencyTable) -> str:
    """One line per timing, with all that is known of it, then the published ones."""
    lines: list[dict[str, Any]] = []
    for line in table.lines:
        values: dict[str, Any] = {"kind": "measured", "status": line.status, "mark": line.mark}
        values |= dict(zip(IDENTITY, line.names, strict=True)) | {"size": line.size}
        values |= {column.name: line.values[column.name] for column in COLUMNS}
        metric = line.row["metric"] if line.shown else {}
        others = {key.partition(".")[2]: value for key, value in metric.items()}
        values |= {key: value for key, value in others.items() if key not in values}
        lines.append(values | {"weights": line.row.get("weights", ""), "why": line.why})
    for source in published(AXIS, ()):
        for row in source["rows"]:
            named = {key: text(value) for key, value in row.items() if key not in ("ms", "fps")}
            values = {"kind": "published", "mark": source["mark"], **named}
            lines.append(values | {"mean_ms": row.get("ms"), "fps": row.get("fps")})
    return pd.DataFrame(lines).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def markdown(table: LatencyTable) -> str:
    """A table for each size, what has no numbers, what others published, and the notes."""
    parts = [f"**{SMOKE.capitalize()}.**"] * table.smoke
    for size in table.sizes:
        parts.append(f"**{size}**\n\n{_grid(table.of(size), table.columns())}")
    lacking = [list(line) for line in without_numbers(table)]
    if lacking:
        head = ["status", "engine", "timings", "why"]
        parts.append(f"**Without numbers**\n\n{formats.pipe_table(head, lacking, range(4))}")
    for source in published(AXIS, ()):
        shown = formats.pipe_table(list(PUBLISHED.values()), published_lines(source), NAMES)
        parts.append(f"**{source['mark']}**, not comparable with the lines above\n\n{shown}")
        parts.append(f"{source['source']}: {', '.join(formats.about(source))}.")
    parts.append("\n".join(f"- {note}" for note in notes(table)))
    return "\n\n".join(part for part in parts if part) + "\n"


def readme(table: LatencyTable) -> str:
    """The main columns of the largest size that was measured, all tasks: of each backbone the
    reference and the fastest engine of each precision."""
    shown = table.measured or list(table.lines)
    size = max((line.size for line in shown), key=_pixels)
    tasks = max((line.row["tasks"] for line in shown), key=len)
    lines = [line for line in table.of(size) if line.row["tasks"] == tasks]
    columns = [column for column in table.columns() if column.name in SHORT]
    parts = [f"**{SMOKE.capitalize()}.**"] * table.smoke
    what = f"{REFERENCE} and the fastest engine of each precision"
    parts += [f"{size}, {text(tasks)}, batch 1; {what}:", _grid(_fastest(lines), columns)]
    lacking = [*_lacking(line for line in lines if not line.shown)]
    parts.append("\n".join(f"- {words}" for words in [*lacking, *notes(table)[:1]]))
    return "\n\n".join(parts) + "\n"


def latex(table: LatencyTable) -> str:
    """Tables for a paper: `\\input` it where booktabs and graphicx are loaded."""
    parts = ["% needs \\usepackage{booktabs,graphicx}"]
    columns = table.columns()
    head = [formats.tex(c.title) + _arrow(c, formats.ARROWS_TEX) for c in columns]
    heads = [[*IDENTITY, *head], [*[""] * len(IDENTITY), *(formats.tex(c.note) for c in columns)]]
    for index, size in enumerate(table.sizes):
        lines = [[*map(formats.tex, names_of(li)), *numbers(li, columns)] for li in table.of(size)]
        said = " ".join(notes(table)) if index == 0 else ""
        smoke = f"{SMOKE.capitalize()}. " * table.smoke
        caption = f"{smoke}Latency at {size}. {said}".strip()
        parts.append(formats.floating(heads, lines, LEFT, caption, fit=True))
    for source in published(AXIS, ()):
        lines = [list(map(formats.tex, line)) for line in published_lines(source)]
        caption = f"{source['mark']}. {source['source']}. {formats.sentence(source['note'])}."
        parts.append(formats.floating([list(PUBLISHED.values())], lines, NAMES, caption, fit=True))
    return "\n\n".join(parts) + "\n"


def html(
    grid: Any,
    table: LatencyTable,
    figures: Sequence[page.Figure],
    out_dir: Path,
    command: str,
) -> str:
    """The page; the figures' files are read from `out_dir`."""
    states = [line.status for line in table.lines]
    rendered = page.template(TEMPLATE).render(
        grid=grid,
        table=table,
        states=", ".join(f"{states.count(s)} {s}" for s in dict.fromkeys(states)),
        skips=_skips(grid),
        quality_grid=getattr(grid, "quality", {}).get("grid"),
        figures=[(figure, page.inline(out_dir, figure)) for figure in figures],
        lacking=without_numbers(table),
        notes=notes(table),
        published=published(AXIS, ()),
        published_head=list(PUBLISHED.values()),
        published_lines=published_lines,
        identity=IDENTITY,
        numbers=numbers,
        title=title,
        protocol=protocol(table),
        command=command,
        smoke=SMOKE,
        f=formats,
    )
    return rendered + "\n"


# --- parts ----------------------------------------------------------------------------------------


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


def _fastest(lines: Sequence[Line]) -> list[Line]:
    """Of each backbone's lines the reference's, and the least mean of each precision."""
    best: dict[tuple[str, str], Line] = {}
    for line in filter(lambda line: line.shown, lines):
        key = (line.names[0], line.names[3])
        if key not in best or line.values["mean_ms"] < best[key].values["mean_ms"]:
            best[key] = line
    chosen = [line for line in lines if line.engine == REFERENCE or line in best.values()]
    return chosen or list(lines)


def names_of(line: Line) -> list[str]:
    """The words of a line, with its mark beside the engine."""
    backbone, tasks, engine, precision = line.names
    return [backbone, tasks, engine + (f" ({line.mark})" if line.mark else ""), precision]


def title(column: Column) -> str:
    return column.title + _arrow(column, formats.ARROWS, "\u00a0")  # kept on one line


def _arrow(column: Column, arrows: Mapping[int, str], blank: str = " ") -> str:
    """Which way is better; more passes are no better result."""
    return "" if column.name == "passes" else blank + arrows[column.better]


def numbers(line: Line, columns: Sequence[Column]) -> list[str]:
    return [_number(line.values[column.name], column) for column in columns]


def _number(value: float, column: Column) -> str:
    if column.name in SCIENTIFIC and value > 0:
        return f"{value:.0e}"
    return formats.number(value, column)


def published_lines(source: Mapping[str, Any]) -> list[list[str]]:
    """Its rows; of ms and FPS only what is printed, and nothing made of the other."""
    return [[text(row.get(key, formats.NOTHING)) for key in PUBLISHED] for row in source["rows"]]


def protocol(table: LatencyTable) -> list[tuple[str, list[tuple[str, str, bool]]]]:
    """How the numbers were made: sections of (name, value, whether the lines differ in it)."""
    flats = [flatten(line.row) for line in table.measured]
    facts = {f"metric.latency.{name}": name for name in FACTS} | {"weights": "weights"}
    facts |= {"trained.slug": "trained by", "timing.recipe": "recipe of the network"}
    costs = {f"metric.roofline.{name}": f"peak, {unit}" for name, unit in PEAKS.items()}
    environment = {
        key: key.removeprefix("env.")
        for flat in flats
        for key in flat
        if key.startswith("env.") and key.removeprefix("env.") not in SAME
    }
    sections = [("Timing", facts), ("Machine's measured peak", costs), ("Environment", environment)]
    return [(title, found) for title, keys in sections if (found := _settings(flats, keys))]


def _settings(
    flats: Sequence[Mapping[str, Any]], names: Mapping[str, str]
) -> list[tuple[str, str, bool]]:
    settings = []
    for key, name in names.items():
        values = list(dict.fromkeys(text(flat[key]) for flat in flats if flat.get(key) is not None))
        if values:
            settings.append((name, " | ".join(values), len(values) > 1))
    return settings


def _grid(lines: Sequence[Line], columns: Sequence[Column]) -> str:
    titles = [title(c) + (f"<br>{c.note}" if c.note else "") for c in columns]
    shown = [[*names_of(line), *numbers(line, columns)] for line in lines]
    return formats.pipe_table([*IDENTITY, *titles], shown, LEFT)


def _skips(grid: Any) -> list[tuple[int, str]]:
    """How many timings each reason leaves out."""
    reasons = [skip.why for skip in getattr(grid, "skips", ())]
    return [(reasons.count(why), why) for why in dict.fromkeys(reasons)]


def _pixels(size: str) -> int:
    height, _, width = size.partition("x")
    return int(height) * int(width)
