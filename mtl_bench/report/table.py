"""One table in four spellings: CSV, Markdown and LaTeX here, HTML by `page.html.j2`.

Whoever fills a `Table` says what stands in it; how that is written is said here, once.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from mtl_bench.core.columns import Column
from mtl_bench.core.text import in_a_line, in_markdown
from mtl_bench.report.columns import Row, capital, measured
from mtl_bench.report.statistics import Entry

PLUS_MINUS = "\u00b1"
ARROWS = {+1: "\u2191", -1: "\u2193"}
NOTHING = "-"
FEWER = "\u2020"  # behind the n of a line that has fewer seeds than another
WRAP = "wrap"  # class of a column of sentences
TEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\u2020": r"$\dagger$",
    "\u2191": r"$\uparrow$",
    "\u2193": r"$\downarrow$",
    "\u0394": r"$\Delta$",
    "\u00a0": " ",
    PLUS_MINUS: r"$\pm$",
}


@dataclass(frozen=True)
class Head:
    """What stands above a column."""

    title: str
    about: str = ""  # under it: unit and note
    left: bool = False  # a column of words
    tex: str = ""  # the title in LaTeX, where that is another
    css: str = ""  # class of its cells on a page
    page_only: bool = False

    @staticmethod
    def of(column: Column) -> "Head":
        """A number's, with the arrow of what is better on the title's line."""
        arrow = f"\u00a0{ARROWS[column.better]}" if column.better else ""
        own = column.tex + tex(arrow) if column.tex else ""
        return Head(column.title + arrow, column.about, tex=own)

    @staticmethod
    def words(*titles: str) -> "tuple[Head, ...]":
        return tuple(Head(title, left=True) for title in titles)


@dataclass(frozen=True)
class Cell:
    text: str
    spread: str = ""
    bold: bool = False
    value: float | None = None  # what a page sorts by
    html: Markup | None = None  # in place of the text on a page
    tex: str | None = None  # in place of all in LaTeX

    @staticmethod
    def of(value: Entry, column: Column, seeds: int = 1) -> "Cell":
        mean = value.mean if value.count else None
        return Cell(*halves(value, column, seeds), value.bold, mean)

    @staticmethod
    def marked(name: str, mark: str) -> "Cell":
        """A name with what a reader must know before reading its numbers."""
        html = Markup('{} <span class="mark">{}</span>').format(name, mark)
        return Cell(f"{name} ({mark})", html=html) if mark else Cell(name)


@dataclass(frozen=True)
class TableRow:
    cells: tuple[Cell, ...]  # one per head
    css: str = ""

    @staticmethod
    def of(*cells: str | Cell, css: str = "") -> "TableRow":
        return TableRow(tuple(c if isinstance(c, Cell) else Cell(c) for c in cells), css)


@dataclass(frozen=True)
class Section:
    """Lines under one heading that have the same columns."""

    heading: str
    heads: tuple[Head, ...]
    lines: tuple[TableRow, ...]
    remark: str = ""  # behind the heading in Markdown
    source: str = ""  # below it in Markdown, above it on a page
    warning: str = ""  # behind the source on a page
    caption: str = ""  # in LaTeX; without one it does not stand there
    fit: bool = True  # LaTeX shrinks it to the width of the text
    units: bool = True  # LaTeX has them in a line of their own

    @staticmethod
    def lacking(
        what: str, heads: tuple[Head, ...], lines: Sequence[TableRow]
    ) -> "tuple[Section, ...]":
        """What has no numbers, where there is any; the last column says why."""
        caption = f"{what} without numbers."
        made = Section(
            "Without numbers", heads, tuple(lines), caption=caption, fit=False, units=False
        )
        return (made,) if lines else ()

    @staticmethod
    def published(
        source: Mapping[str, Any],
        heads: tuple[Head, ...],
        rows: Iterable[Sequence[str]],
        others: str,
        why: str,
        fit: bool = True,
    ) -> "Section":
        """A list of published rows; on the page each says that it is one.

        Args:
            others: what was measured: rows | lines.
            why: they do not compare.
        """
        mark = source["mark"]
        about = [source[key] for key in ("dataset", "gpu", "note") if key in source]
        lines = (
            TableRow.of(replace(Cell.marked(name, mark), text=name), *rest) for name, *rest in rows
        )
        return Section(
            heading=mark,
            heads=heads,
            lines=tuple(lines),
            remark=f", not comparable with the {others} above",
            source=f"{source['source']}: {', '.join(about)}.",
            warning=f"Not comparable with the measured {others}: {why}.",
            caption=f"{mark}. {source['source']}. {capital(source['note'])}.",
            fit=fit,
            units=False,
        )


@dataclass(frozen=True)
class Table:
    """All that stands in a report's table."""

    sections: tuple[Section, ...]  # what was measured
    notes: tuple[str, ...]  # `+-` stands for the sign
    records: tuple[Mapping[str, Any], ...] = ()  # the lines of table.csv
    lacking: tuple[Section, ...] = ()  # what has no numbers
    published: tuple[Section, ...] = ()
    title: str = ""
    banner: str = ""  # said before everything else
    sources: tuple[str, ...] = ()
    joined: bool = False  # the sections are one float of LaTeX, the notes below it
    letters: Mapping[str, str] = field(default_factory=dict)  # marks in LaTeX: what they say


# --- how a value is written -----------------------------------------------------------------------


def number(value: float, column: Column) -> str:
    if math.isnan(value):
        return NOTHING
    if column.scientific and value > 0:
        return f"{value:.0e}"
    return f"{value:z.{column.digits}f}"


def halves(value: Entry, column: Column, seeds: int) -> tuple[str, str]:
    """`33.1` and `+- 0.4`, with an n of its own where fewer seeds than the line's have a value.

    What is the same for all seeds, such as a count of parameters, has no spread.
    """
    same = math.isnan(value.std) or value.std < 1e-9 * abs(value.mean)
    spread = "" if same else f"{PLUS_MINUS} {number(value.std, column)}"
    own = f"(n={value.count})" if 0 < value.count < seeds else ""
    return number(value.mean, column), " ".join(filter(None, (spread, own)))


def single(row: Row, column: Column) -> str:
    """One row's value of a column."""
    return number(measured(row, column), column)


def numbers(
    entries: Mapping[str, Entry], columns: Iterable[Column], spread: bool = True
) -> dict[str, float]:
    """What table.csv has of a line's numbers."""
    found = {}
    for column in columns:
        entry = entries.get(column.name, Entry())
        found[column.name] = entry.mean
        if spread:
            found[f"{column.name}_std"] = entry.std
    return found


# --- files ----------------------------------------------------------------------------------------


def write(table: Table, folder: Path, more: Mapping[str, str]) -> None:
    """Write `table.{csv,md,tex}` and more files by name."""
    files = {"table.csv": csv(table), "table.md": markdown(table), "table.tex": latex(table)}
    for name, content in {**files, **more}.items():
        (folder / name).write_text(content, encoding="utf-8", newline="\n")


def csv(table: Table) -> str:
    rows = pd.DataFrame(list(table.records))
    return rows.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def markdown(table: Table) -> str:
    """Its sections, what has no numbers, what others published, and the notes."""
    parts = [f"# {table.title}" if table.title else "", f"**{table.banner}**" * bool(table.banner)]
    for section in (*table.sections, *table.lacking, *table.published):
        heading = f"**{in_markdown(section.heading)}**" if section.heading else ""
        parts += [heading + section.remark, _pipes(section), section.source]
    parts.append(_bullets(table.notes))
    if table.sources:
        parts.append(f"**Sources**\n\n{_bullets(table.sources)}")
    return "\n\n".join(part for part in parts if part) + "\n"


def latex(table: Table) -> str:
    """Tables for a paper: `\\input` it where booktabs and graphicx are loaded."""
    needs = r"% needs \usepackage{booktabs,graphicx}; UTF-8: beyond Latin letters LuaLaTeX"
    top = [needs, *(f"% {in_a_line(source)}" for source in table.sources)]
    if table.joined:
        below = [f"$^{{{mark}}}$ {tex(meaning)}." for mark, meaning in table.letters.items()]
        below += map(tex, table.notes)
        return "\n".join([*top, _float(table.sections, f"{table.title}.", " ".join(below)), ""])
    every = (*table.sections, *table.lacking, *table.published)
    floats = [_float([section], section.caption) for section in every if section.caption]
    return "\n\n".join([*top, *floats]) + "\n"


def pretty(note: str) -> str:
    return note.replace("+-", PLUS_MINUS)


def tex(value: str) -> str:
    """Text in a line, LaTeX's special characters escaped; letters stay what they are."""
    escaped = "".join(TEX.get(character, character) for character in in_a_line(value))
    return escaped.replace("+-", r"$\pm$").replace("--", "-{}-")


# --- parts ----------------------------------------------------------------------------------------


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {in_markdown(pretty(line))}" for line in lines)


def _in_files(section: Section) -> tuple[list[Head], list[list[Cell]]]:
    """The columns that stand in more than the page, and their cells line by line."""
    shown = [i for i, head in enumerate(section.heads) if not head.page_only]
    lines = [[line.cells[i] for i in shown] for line in section.lines]
    return [section.heads[i] for i in shown], lines


def _pipes(section: Section) -> str:
    heads, lines = _in_files(section)
    titles = ["<br>".join(map(in_markdown, filter(None, (h.title, h.about)))) for h in heads]
    rule = ["---" if head.left else "---:" for head in heads]
    body = [map(_cell_in_markdown, cells) for cells in lines]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (titles, rule, *body))


def _cell_in_markdown(cell: Cell) -> str:
    value = " ".join(filter(None, (in_markdown(cell.text), cell.spread)))
    return f"**{value}**" if cell.bold else value


def _in_latex(cell: Cell) -> str:
    if cell.tex is not None:
        return cell.tex
    value = rf"\textbf{{{tex(cell.text)}}}" if cell.bold else tex(cell.text)
    return value + (rf"{{\scriptsize\,{tex(cell.spread)}}}" if cell.spread else "")


def _unit(about: str) -> str:
    """A power is set as one: 1.25^2."""
    return " ".join(f"${word}$" if "^" in word else tex(word) for word in about.split(" "))


def _aligned(head: Head) -> str:
    if head.css == WRAP:
        return r"p{0.5\textwidth}"
    return "l" if head.left else "r"


def _float(sections: Sequence[Section], caption: str, below: str = "") -> str:
    """A LaTeX table; with something below, sections have their headings in it.

    Args:
        below: LaTeX that stands in small print below the caption.
    """
    heads, _ = _in_files(sections[0])
    rows = [[head.tex or tex(head.title) for head in heads]]
    rows += [[_unit(head.about) for head in heads]] * sections[0].units
    body: list[str] = []
    for section in sections:
        if below:
            heading = rf"\multicolumn{{{len(heads)}}}{{l}}{{\emph{{{tex(section.heading)}}}}}"
            body.append((r"\midrule" if body else "") + heading)
        body += [" & ".join(map(_in_latex, cells)) for cells in _in_files(section)[1]]
    tabular = [
        rf"\begin{{tabular}}{{{''.join(map(_aligned, heads))}}}",
        r"\toprule",
        *(" & ".join(row) + r" \\" for row in rows),
        r"\midrule",
        *(rf"{line} \\" for line in body),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    if sections[0].fit:
        tabular = [r"\resizebox{\textwidth}{!}{%", *tabular[:-1], tabular[-1] + "}"]
    notes = [rf"\par\smallskip\raggedright\scriptsize {below}"] if below else []
    return "\n".join(
        [
            *(r"\begin{table}", r"\centering", *tabular),
            *(rf"\caption{{{tex(caption)}}}", *notes, r"\end{table}"),
        ]
    )
