"""A comparison table as CSV, Markdown, LaTeX and a page: the same numbers in four spellings."""

import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mtl_bench.report import formats
from mtl_bench.report.comparison import Comparison
from mtl_bench.report.groups import Entry
from mtl_bench.report.lines import NOTHING, Line
from mtl_bench.report.page import template
from mtl_bench.report.published import NUMBERS, TEXTS

LONG = 46  # characters of a method with its details: longer ones are broken in LaTeX
TEMPLATE = "comparison.html.j2"
TITLES_TEX = {f"delta{i}": rf"$\delta_{i}$" for i in (1, 2, 3)}
SQUARES_TEX = {"1.25^2": "$1.25^2$", "1.25^3": "$1.25^3$"}


def write(table: Comparison, out_dir: Path, command: str) -> Path:
    """Write `table.{csv,md,tex}` and `index.html`; the same rows give the same bytes.

    Returns:
        The page's path.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    files = {
        "table.csv": csv(table),
        "table.md": markdown(table),
        "table.tex": latex(table),
        "index.html": page(table, command),
    }
    for name, content in files.items():
        temporary = out_dir / f".{name}.tmp"
        temporary.write_text(content, encoding="utf-8", newline="\n")
        temporary.replace(out_dir / name)
    return out_dir / "index.html"


def csv(table: Comparison) -> str:
    """One line per row: its section, kind and marks, words, mean and deviation of every number."""
    lines = []
    for section in table.sections:
        for line in section.lines:
            values: dict[str, Any] = {"kind": line.kind, "mark": "; ".join(line.marks)}
            values |= {"section": section.heading, "method": line.texts["method"]}
            values |= {"symbols": line.symbols, "details": line.details}
            for name in columns(table):
                if name in TEXTS:
                    values[name] = line.texts.get(name, "")
                else:
                    entry = line.entries.get(name, Entry())
                    values |= {name: entry.mean, f"{name}_std": entry.std}
            lines.append(values | {"n": line.count, "note": line.note, "source": line.source})
    return pd.DataFrame(lines).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def markdown(table: Comparison) -> str:
    """A table per section, what must be said, and the sources."""
    parts = [f"# {table.literature.title}"]
    units = [f"<br>{unit}" if unit else "" for unit in map(note, columns(table))]
    titles = [title(table, name) for name in columns(table)]
    head = ["Method", "Origin", *(t + u for t, u in zip(titles, units, strict=True)), "n"]
    for section in table.sections:
        lines = []
        for line in section.lines:
            name = f"{line.texts['method']}{_starred(line.symbols)} ({line.details})"
            shown = [" ".join(filter(None, halves(line, name))) for name in columns(table)]
            lines.append([name, line.what, *shown, line.seeds])
        grid = formats.pipe_table(head, lines, words_at(columns(table)))
        parts.append(f"**{section.heading}**\n\n{grid}")
    parts.append("\n".join(f"- {_starred(formats.pretty(words))}" for words in table.notes))
    parts.append("**Sources**\n\n" + "\n".join(f"- {words}" for words in sources(table)))
    return "\n\n".join(parts) + "\n"


def latex(table: Comparison) -> str:
    """One table with a heading per section: `\\input` it where booktabs and graphicx are loaded.

    It has the page's width, so fewer columns; marks are letters that are explained below it.
    """
    names = [name for name in columns(table) if name in table.literature.narrow]
    letters = _letters(table, names)
    head = ["Method", "Origin", *(_tex_title(table, name) for name in names), "n"]
    units = ["", "", *map(_tex_unit, names), ""]
    lines: list[list[str]] = []
    for section in table.sections:
        heading = rf"\multicolumn{{{len(head)}}}{{l}}{{\emph{{{formats.tex(section.heading)}}}}}"
        lines.append([(r"\midrule" if lines else "") + heading])
        for line in section.lines:
            marks = ",".join(sorted(letters[words] for words in _explained(line, names)))
            origin = line.kind + (f"$^{{{marks}}}$" if marks else "")
            values = [_tex_value(line, name) for name in names]
            lines.append([_tex_method(line), origin, *values, line.seeds])
    below = [*(f"$^{{{x}}}$ {formats.tex(words)}." for words, x in letters.items())]
    below += [formats.tex(note) for note in table.notes]
    title, left = f"{table.literature.title}.", words_at(names)
    return "\n".join(
        [
            r"% needs \usepackage{booktabs,graphicx}",
            *(f"% {words}" for words in sources(table)),
            formats.floating([head, units], lines, left, title, fit=True, below=" ".join(below)),
            "",
        ]
    )


def page(table: Comparison, command: str) -> str:
    """One HTML file that needs nothing but itself, in the style of a grid's page."""
    names = columns(table)
    heads = [(title(table, name), note(name), name in TEXTS) for name in names]
    values = {"names": names, "heads": heads, "sources": sources(table), "texts": TEXTS}
    return template(TEMPLATE).render(
        table=table, command=command, halves=halves, f=formats, **values
    )


# --- parts ----------------------------------------------------------------------------------------


def columns(table: Comparison) -> list[str]:
    """Those behind the method, in the table's order."""
    return [name for name in table.literature.columns if name != "method"]


def words_at(names: Sequence[str]) -> set[int]:
    """Indices of words among all columns: method, origin, and those of `names`."""
    return {0, 1, *(2 + i for i, name in enumerate(names) if name in TEXTS)}


def title(table: Comparison, name: str) -> str:
    if name in NUMBERS:
        return formats.title(NUMBERS[name])
    return table.literature.titles.get(name, TEXTS[name])


def note(name: str) -> str:
    return NUMBERS[name].note if name in NUMBERS else ""


def halves(line: Line, name: str) -> tuple[str, str]:
    """A column's words, or its number with its spread; a published number is as printed."""
    if name in TEXTS:
        return line.texts.get(name, NOTHING), ""
    if line.kind == "published":
        return line.printed.get(name, NOTHING), ""
    return formats.halves(line.entries[name], NUMBERS[name], line.count)


def sources(table: Comparison) -> list[str]:
    """Where the published rows come from, in the paper's order, each once."""
    rows = table.literature.row
    return list(dict.fromkeys(f"{row['method']}: {row['source']}." for row in rows))


def _starred(words: str) -> str:
    return words.replace("*", r"\*")


def _tex_title(table: Comparison, name: str) -> str:
    if name in TEXTS:
        return formats.tex(title(table, name))
    column = NUMBERS[name]
    words = TITLES_TEX.get(name, formats.tex(column.title))
    return f"{words} {formats.ARROWS_TEX[column.better]}"


def _tex_unit(name: str) -> str:
    first, _, last = note(name).rpartition(" ")
    return formats.tex(f"{first} ".lstrip()) + SQUARES_TEX.get(last, formats.tex(last))


def _tex_value(line: Line, name: str) -> str:
    mean, spread = halves(line, name)
    spread = spread.replace(formats.PLUS_MINUS, r"$\pm$")
    return formats.tex(mean) + (rf"{{\scriptsize\,{spread}}}" if spread else "")


def _tex_method(line: Line) -> str:
    """In two lines or more where it is long."""
    name = formats.tex(line.texts["method"]) + formats.tex(line.symbols)
    words = rf"{name} {{\scriptsize {formats.tex(line.details)}}}"
    if len(line.texts["method"] + line.details) <= LONG:
        return words
    return rf"\parbox[t]{{17em}}{{\raggedright {words}\strut}}"


def _explained(line: Line, names: Sequence[str]) -> list[str]:
    """What a row's letters stand for: its marks, and the device where that is no column."""
    device = line.texts.get("device", NOTHING)
    timed = "device" not in names and device != NOTHING
    return [*line.marks, *[f"on {device}"] * timed]


def _letters(table: Comparison, names: Sequence[str]) -> dict[str, str]:
    """A letter for everything that needs one, in the order of the lines."""
    every = dict.fromkeys(words for line in table.lines for words in _explained(line, names))
    return {words: string.ascii_lowercase[i] for i, words in enumerate(every)}
