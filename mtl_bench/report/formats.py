"""The table as CSV, Markdown, LaTeX and on a terminal: the same numbers in four spellings."""

import math
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from mtl_bench.report.tables import COLUMNS, Column, Entry, Group, Row, Table, tabulate, text

if TYPE_CHECKING:
    import rich.table

PLUS_MINUS = "\u00b1"
ARROWS = {+1: "\u2191", -1: "\u2193"}
NOTHING = "-"
AXES = {"recipe.name": "recipe"}
TEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}
TITLES_TEX = {"delta1": r"$\delta_1$"}


def number(value: float, column: Column) -> str:
    return NOTHING if math.isnan(value) else f"{value:.{column.digits}f}"


def entry(value: Entry, column: Column, seeds: int, plus_minus: str = f" {PLUS_MINUS} ") -> str:
    """`33.1 +- 0.4`; with its own n where fewer seeds have the value than the line has."""
    shown = number(value.mean, column)
    if not math.isnan(value.std):
        shown += plus_minus + number(value.std, column)
    return shown + (f" (n={value.count})" if 0 < value.count < seeds else "")


def title(column: Column, arrows: dict[int, str] = ARROWS) -> str:
    return f"{column.title} {arrows[column.better]}"


def axis_title(axis: str) -> str:
    return AXES.get(axis, axis.removeprefix("recipe."))


def seeds(group: Group) -> str:
    return NOTHING if group.status == "trivial" else str(len(group.rows))


# --- files ----------------------------------------------------------------------------------------


def csv(table: Table) -> str:
    """One line per group: identity, kind, n, then mean and standard deviation of every column."""
    lines: list[dict[str, Any]] = []
    for group in table.lines:
        line = dict(zip(table.axes, group.identity, strict=True))
        kind = "trivial" if group.status == "trivial" else "measured"
        line |= {"kind": kind, "mark": group.mark, "n": len(group.rows)}
        for column in COLUMNS:
            value = group.entries[column.name]
            line |= {column.name: value.mean, f"{column.name}_std": value.std}
        lines.append(line)
    for source in table.published:
        for row in source["rows"]:
            values = {name: row[name] for name in ("pq", "fps") if name in row}
            rmse = {"rmse_published": row["rmse"]} if "rmse" in row else {}
            identity = {table.axes[0]: row["name"]}
            lines.append(identity | {"kind": "published", "mark": source["mark"]} | values | rmse)
    for cell in table.unfinished:
        lines.append({table.axes[0]: cell.label, "kind": cell.status, "mark": cell.reason, "n": 0})
    return pd.DataFrame(lines).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def markdown(table: Table) -> str:
    """Quality and cost side by side in two tables, then what failed, what is published, the notes."""
    parts = []
    if table.smoke:
        parts.append("**Smoke: not a result.** These cells were trained for a few steps only.\n")
    for heading, columns in _parts(table):
        lines = [
            [*group.identity, *_marked(group), seeds(group)]
            + [_markdown_entry(group, column) for column in columns]
            for group in table.lines
        ]
        notes = [f"{title(c)}<br>{c.note}" if c.note else title(c) for c in columns]
        head = [*map(axis_title, table.axes), *_marked_title(table), "n", *notes]
        parts.append(f"**{heading}**\n\n{_markdown_table(head, lines)}")
    if table.unfinished:
        lines = [[c.label, c.status, c.reason] for c in table.unfinished]
        parts.append(f"**Without numbers**\n\n{_markdown_table(['cell', 'status', 'why'], lines)}")
    for source in table.published:
        head = [axis_title(table.axes[0]), "PQ", "RMSE (m)", "FPS"]
        lines = [[row["name"], *(f"{row[k]:.1f}" for k in ("pq", "rmse", "fps"))] for row in source["rows"]]
        heading = f"**{source['mark']}**: {source['source']}; {source['dataset']}, {source['gpu']}; {source['note']}"
        parts.append(f"{heading}. Not comparable with the rows above.\n\n{_markdown_table(head, lines)}")
    parts.append("\n".join(f"- {_prose(note)}" for note in table.footnotes))
    return "\n".join(part.rstrip("\n") + "\n" for part in parts if part)


def latex(table: Table) -> str:
    """Tables for a paper: `\\input` it where booktabs and graphicx are loaded."""
    parts = [r"% needs \usepackage{booktabs,graphicx}"]
    if table.smoke:
        parts.append("% SMOKE: not a result")
    for heading, columns in _parts(table):
        parts.append(_latex_measured(table, heading, columns))
    for source in table.published:
        lines = [
            f"{tex(row['name'])} & {row['pq']:.1f} & {row['rmse']:.1f} & {row['fps']:.1f} \\\\"
            for row in source["rows"]
        ]
        head = f"{tex(axis_title(table.axes[0]))} & PQ $\\uparrow$ & RMSE $\\downarrow$ & FPS $\\uparrow$ \\\\"
        caption = tex(f"{source['mark']}: {source['source']}. {source['note'].capitalize()}.")
        parts.append(_latex_table("lrrr", [head], [lines], caption, fit=False))
    return "\n\n".join(parts) + "\n"


def tex(value: str) -> str:
    """Text with LaTeX's special characters escaped, in ASCII."""
    escaped = "".join(TEX.get(character, character) for character in value)
    return escaped.replace("+-", r"$\pm$").encode("ascii", "replace").decode()


def summary_table(rows: Sequence[Row], axis: str = "backbone") -> "rich.table.Table":
    """The main columns for a terminal."""
    import rich.table

    table = tabulate(rows, axis)
    columns = [c for c in table.columns() if c.name in ("pq", "miou", "abs_rel", "rmse", "fps", "train_min")]
    shown = rich.table.Table(caption=" ".join(table.footnotes), caption_justify="left")
    for name in (*map(axis_title, table.axes), "status"):
        shown.add_column(name)
    for name in ("n", *(f"{title(c)}{f' {c.note}' if c.note else ''}" for c in columns)):
        shown.add_column(name, justify="right")
    for group in table.lines:
        values = [entry(group.entries[c.name], c, len(group.rows)) for c in columns]
        styled = [
            f"[bold]{v}[/bold]" if group.entries[c.name].bold else v
            for v, c in zip(values, columns, strict=True)
        ]
        shown.add_row(*group.identity, group.mark or "done", seeds(group), *styled)
    for cell in table.unfinished:
        blank = [""] * (len(table.axes) - 1)
        shown.add_row(cell.label, *blank, cell.status, *[NOTHING] * (len(columns) + 1))
    return shown


# --- parts ----------------------------------------------------------------------------------------


def _parts(table: Table) -> list[tuple[str, list[Column]]]:
    """Quality with the speed it is paid with, and all of the cost."""
    speed = [column for column in table.columns() if column.name == "fps"]
    parts = [("Quality", table.columns("quality") + speed), ("Cost", table.columns("cost"))]
    return [(heading, columns) for heading, columns in parts if columns]


def _marked_title(table: Table) -> list[str]:
    return ["mark"] if any(group.mark for group in table.lines) else []


def _marked(group: Group) -> list[str]:
    raise NotImplementedError


def _markdown_entry(group: Group, column: Column) -> str:
    value = group.entries[column.name]
    shown = entry(value, column, len(group.rows))
    return f"**{shown}**" if value.bold else shown
