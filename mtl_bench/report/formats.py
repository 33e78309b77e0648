"""The table as CSV, Markdown, LaTeX and on a terminal: the same numbers in four spellings."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from mtl_bench.report.columns import BY_NAME, COLUMNS, RELATIVE, Column, Row, measured
from mtl_bench.report.groups import SMOKE, Entry, Group
from mtl_bench.report.layout import Layout
from mtl_bench.report.notes import footnotes
from mtl_bench.report.tables import Table, tabulate

if TYPE_CHECKING:
    import rich.table

PLUS_MINUS = "\u00b1"
ARROWS = {+1: "\u2191", -1: "\u2193"}
NOTHING = "-"
AXES = {"recipe.name": "recipe", "name": "configuration", "single_task": "single-task"}
PUBLISHED = {"pq": ("PQ", +1), "rmse": ("RMSE (m)", -1), "fps": ("FPS", +1)}
TEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\u2020": r"$\dagger$",
}
ARROWS_TEX = {+1: r"$\uparrow$", -1: r"$\downarrow$"}
IN_SUMMARY = ("pq", "abs_rel", "rmse", "fps")
IN_README = ("pq", "miou", "abs_rel", "rmse", "rmse_dgc", "delta_task", "fps", "params_m")
TITLES_TEX = {
    "delta1": r"$\delta_1$",
    "delta_flat": r"$\Delta$ flat",
    "delta_task": r"$\Delta$ task",
}


def number(value: float, column: Column) -> str:
    return NOTHING if math.isnan(value) else f"{value:z.{column.digits}f}"


def halves(value: Entry, column: Column, seeds: int) -> tuple[str, str]:
    """`33.1` and `+- 0.4`, with an n of its own where fewer seeds than the line's have a value.

    What is the same for all seeds, such as a count of parameters, has no spread.
    """
    same = math.isnan(value.std) or value.std < 1e-9 * abs(value.mean)
    spread = "" if same else f"{PLUS_MINUS} {number(value.std, column)}"
    own = f"(n={value.count})" if 0 < value.count < seeds else ""
    return number(value.mean, column), " ".join(filter(None, (spread, own)))


def entry(value: Entry, column: Column, seeds: int) -> str:
    return " ".join(filter(None, halves(value, column, seeds)))


def single(row: Row, name: str) -> str:
    """One cell's value of a column."""
    column = BY_NAME[name]
    return number(measured(row, column), column)


def title(column: Column, arrows: dict[int, str] = ARROWS) -> str:
    return f"{column.title}\u00a0{arrows[column.better]}"  # kept on one line


def axis_title(axis: str) -> str:
    return AXES.get(axis, axis.removeprefix("recipe."))


def seeds(group: Group) -> str:
    return NOTHING if group.status == "trivial" else str(len(group.rows))


# --- files ----------------------------------------------------------------------------------------


def csv(table: Table) -> str:
    """One line per group: identity, kind, n, then mean and standard deviation of every column."""
    lines: list[dict[str, Any]] = []
    for group in table.lines:
        line: dict[str, Any] = dict(zip(table.axes, group.identity, strict=True))
        kind = "trivial" if group.status == "trivial" else "measured"
        line |= {"kind": kind, "mark": group.mark, "n": len(group.rows)}
        for column in COLUMNS:
            value = group.entries[column.name]
            line |= {column.name: value.mean, f"{column.name}_std": value.std}
        if table.reference is not None:
            line |= {column.name: group.entries[column.name].mean for column in RELATIVE}
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


def markdown(table: Table, short: bool = False) -> str:
    """Quality and cost, then what has no numbers, what others published, and the notes.

    Args:
        short: one table of the main columns in place of quality and cost, as for a README.
    """
    parts = []
    if table.smoke:
        parts.append(f"**{SMOKE.capitalize()}.**")
    main = [column for column in table.columns() if column.name in IN_README]
    for heading, columns in [("", main)] if short and main else parts_of(table):
        head = [f"{title(c)}<br>{c.note}" if c.note else title(c) for c in columns]
        lines = []
        for group in with_any(table, columns):
            values = [(group.entries[c.name], c) for c in columns]
            shown = [(entry(v, c, len(group.rows)), v.bold) for v, c in values]
            lines.append([*group.names, seeds(group), *(f"**{t}**" if b else t for t, b in shown)])
        names = [axis_title(axis) for axis in table.axes]
        parts += [f"**{heading}**"] * bool(heading)
        parts.append(pipe_table([*names, "n", *head], lines, range(len(names))))
    if table.unfinished:
        lines = [[cell.label, cell.status, cell.reason] for cell in table.unfinished]
        parts.append(
            f"**Without numbers**\n\n{pipe_table(['cell', 'status', 'why'], lines, range(3))}"
        )
    for source in table.published:
        head = [axis_title(table.axes[0]), *(f"{name} {a}" for name, a in published_head(source))]
        lines = [[row["name"], *published_values(row, source)] for row in source["rows"]]
        grid = pipe_table(head, lines, range(1))
        parts.append(f"**{source['mark']}**, not comparable with the rows above\n\n{grid}")
        parts.append(f"{source['source']}: {', '.join(about(source))}.")
    parts.append("\n".join(f"- {pretty(note)}" for note in footnotes(table)))
    return "\n\n".join(part for part in parts if part) + "\n"


def latex(table: Table) -> str:
    """Tables for a paper: `\\input` it where booktabs and graphicx are loaded."""
    parts = ["% needs \\usepackage{booktabs,graphicx}"]
    notes = " ".join(footnotes(table))
    for heading, columns in parts_of(table):
        head = [f"{TITLES_TEX.get(c.name, tex(c.title))} {ARROWS_TEX[c.better]}" for c in columns]
        units = [tex(column.note) for column in columns]
        lines = []
        for group in with_any(table, columns):
            values = [_latex_entry(group.entries[c.name], c, len(group.rows)) for c in columns]
            lines.append([*map(tex, group.names), seeds(group), *values])
        blank = [""] * len(table.axes)
        heads = [[*(tex(axis_title(a)) for a in table.axes), "n", *head], [*blank, "", *units]]
        caption = f"{SMOKE.capitalize()}. " if table.smoke else ""
        caption = f"{caption}{heading}. {notes}" if heading == "Quality" else f"{caption}{heading}."
        parts.append(floating(heads, lines, range(len(table.axes)), caption, fit=True))
    for source in table.published:
        head = [f"{name} {a}" for name, a in published_head(source, ARROWS_TEX)]
        lines = [[tex(row["name"]), *published_values(row, source)] for row in source["rows"]]
        caption = f"{source['mark']}. {source['source']}. {sentence(source['note'])}."
        parts.append(
            floating([[axis_title(table.axes[0]), *head]], lines, range(1), caption, fit=False)
        )
    return "\n\n".join(parts) + "\n"


def tex(value: str) -> str:
    """Text with LaTeX's special characters escaped, in ASCII."""
    escaped = "".join(TEX.get(character, character) for character in value)
    return escaped.replace("+-", r"$\pm$").encode("ascii", "replace").decode()


def summary_table(rows: Sequence[Row], axis: str = "backbone") -> "rich.table.Table":
    """The main columns for a terminal."""
    import rich.box
    import rich.table

    table = tabulate(rows, Layout(rows=axis))
    columns = [column for column in table.columns() if column.name in IN_SUMMARY]
    shown = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, caption="depth is median-scaled; spread over n seeds"
    )
    for name in (*map(axis_title, table.axes), "status"):
        shown.add_column(name, overflow="fold")
    for name in ("n", *(f"{title(column)}\n{_unit(column)}" for column in columns)):
        shown.add_column(name, justify="right", no_wrap=True)
    for group in table.lines:
        values = [(group.entries[c.name], c) for c in columns]
        texts = [(entry(v, c, len(group.rows)).replace(" ", ""), v.bold) for v, c in values]
        styled = [f"[bold]{t}[/bold]" if bold else t for t, bold in texts]
        shown.add_row(*group.identity, group.mark or "done", seeds(group), *styled)
    for cell in table.unfinished:
        blank = [""] * (len(table.axes) - 1)
        shown.add_row(cell.label, *blank, cell.status, *[NOTHING] * (len(columns) + 1))
    return shown


def _unit(column: Column) -> str:
    """The note without what the table's caption says."""
    return column.note.replace("median-scaled", "").strip(", ")


# --- parts ----------------------------------------------------------------------------------------


def parts_of(table: Table) -> list[tuple[str, list[Column]]]:
    """Quality with the speed that pays for it, and the cost."""
    speed = [column for column in table.columns() if column.name == "fps"]
    quality = table.columns("quality")
    parts = [("Quality", quality and quality + speed), ("Cost", table.columns("cost"))]
    return [(heading, columns) for heading, columns in parts if columns]


def with_any(table: Table, columns: Sequence[Column]) -> list[Group]:
    """The lines that have a value in one of these columns."""
    return [g for g in table.lines if any(g.entries[column.name].count for column in columns)]


def sentence(words: str) -> str:
    return words[:1].upper() + words[1:]


def pretty(note: str) -> str:
    return note.replace("+-", PLUS_MINUS)


def published_head(
    source: Mapping[str, Any], arrows: dict[int, str] = ARROWS
) -> list[tuple[str, str]]:
    """Titles and arrows of what a published list has."""
    return [(PUBLISHED[name][0], arrows[PUBLISHED[name][1]]) for name in _metrics(source)]


def published_values(row: Row, source: Mapping[str, Any]) -> list[str]:
    return [f"{row[name]:.1f}" if name in row else NOTHING for name in _metrics(source)]


def about(source: Mapping[str, Any]) -> list[str]:
    """How published numbers were made."""
    return [source[key] for key in ("dataset", "gpu", "note") if key in source]


def _metrics(source: Mapping[str, Any]) -> list[str]:
    return [name for name in PUBLISHED if any(name in row for row in source["rows"])]


def pipe_table(head: Sequence[str], lines: Sequence[Sequence[str]], left: Collection[int]) -> str:
    """A Markdown table; columns whose index is in `left` are text."""
    rule = ["---" if i in left else "---:" for i in range(len(head))]
    escaped = [[cell.replace("|", r"\|") for cell in line] for line in (head, rule, *lines)]
    return "\n".join(f"| {' | '.join(line)} |" for line in escaped)


def _latex_entry(value: Entry, column: Column, count: int) -> str:
    mean, spread = halves(value, column, count)
    mean = rf"\textbf{{{mean}}}" if value.bold else mean
    spread = spread.replace(PLUS_MINUS, r"$\pm$")
    return mean + (rf"{{\scriptsize\,{spread}}}" if spread else "")


def floating(
    heads: Sequence[Sequence[str]],
    lines: Sequence[Sequence[str]],
    left: Collection[int],
    caption: str,
    fit: bool,
    below: str = "",
) -> str:
    """A LaTeX table; `fit` shrinks it to the width of the text.

    Args:
        left: indices of the columns of text.
        below: LaTeX that stands in small print below the caption.
    """
    columns = "".join("l" if i in left else "r" for i in range(len(heads[0])))
    notes = [rf"\par\smallskip\raggedright\scriptsize {below}"] if below else []
    body = [" & ".join(line) + r" \\" for line in lines]
    tabular = [
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *(" & ".join(line) + r" \\" for line in heads),
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}",
    ]
    if fit:
        tabular = [r"\resizebox{\textwidth}{!}{%", *tabular[:-1], tabular[-1] + "}"]
    return "\n".join(
        [
            *(r"\begin{table}", r"\centering", *tabular),
            *(rf"\caption{{{tex(caption)}}}", *notes, r"\end{table}"),
        ]
    )
