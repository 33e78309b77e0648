"""Which lines are better than the control: paired differences of gain, a test, and a verdict.

A grid asks for it by `control` under its [report]: the line (a value of `rows`) that every other
is held against. Runs are paired by problem (recipe, backbone, tasks) and seed; a failed run counts
as the worst, a missing one leaves its block out. The other lines are the family of Holm's test.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mtl_bench.core.plain import did_you_mean
from mtl_bench.core.style import BASELINE, GRAY, PALETTE, save, styled
from mtl_bench.report import evidence
from mtl_bench.report.columns import Row, column, measured, text
from mtl_bench.report.evidence import Array, Comparison, Estimate
from mtl_bench.report.statistics import SMOKE, axes_of, cell_of
from mtl_bench.report.table import PLUS_MINUS, Cell, Head, Section, TableRow

PROBLEM = ("recipe.name", "backbone", "tasks", "pretrained")  # axes that make a problem of its own
COLORS = {"better": PALETTE[2], "worse": PALETTE[1], "equivalent": PALETTE[0], "open": GRAY}


@dataclass(frozen=True)
class Line:
    """A line's case against the control."""

    label: str
    comparison: Comparison
    iqm: Estimate  # of its own gains over all problems
    step_x: float  # its step time over the control's, mean over blocks


@dataclass(frozen=True)
class Verdicts:
    """All lines of a grid against its control, the best first."""

    control: str
    control_iqm: Estimate
    lines: tuple[Line, ...]
    problems: int
    seeds: int
    smoke: bool


def judge(rows: Sequence[Row], axis: str, control: str) -> Verdicts | None:
    """Hold every line of a grid against one; None where no other shares two blocks with it.

    Args:
        rows: with `delta.gain` among their metrics where they are done; failed ones, too.
        axis: the field of a cell that names a line.
        control: its value that the others are held against.
    """
    rows = [row for row in rows if row.get("status", "done") in ("done", "failed")]
    axes = axes_of(rows, axis) if rows else (axis,)
    own = [a for a in axes if a == axis or a not in PROBLEM]
    shared = [a for a in axes if a not in own]
    gains = _by_block(rows, own, shared, _gain)
    if control not in gains:
        return None
    problems = list(dict.fromkeys(problem for line in gains.values() for problem, _ in line))
    seeds = sorted({seed for line in gains.values() for _, seed in line})
    score_LMN = np.array([_table(line, problems, seeds) for line in gains.values()])
    step = column("step_ms")
    steps = _by_block(rows, own, shared, lambda row: measured(row, step))
    step_LMN = np.array([_table(steps[label], problems, seeds) for label in gains])
    at = list(gains).index(control)
    rest = [i for i, label in enumerate(gains) if i != at]
    compared = evidence.compare(score_LMN[rest], score_LMN[at])
    if not any(each.blocks > 1 for each in compared):
        return None
    iqms = evidence.bootstrap(score_LMN)
    labels = list(gains)
    lines = [
        Line(labels[i], each, iqms[i], _ratio(step_LMN[i], step_LMN[at]))
        for i, each in zip(rest, compared, strict=True)
        if each.blocks
    ]
    lines.sort(key=lambda line: -np.nan_to_num(line.comparison.difference.mean, nan=-1e9))
    smoke = any(row.get("smoke") for row in rows)
    return Verdicts(control, iqms[at], tuple(lines), len(problems), len(seeds), smoke)


# --- the section and the picture ------------------------------------------------------------------


def section(found: Verdicts) -> Section:
    """A line each: difference with its interval, P(X > Y), p by Holm, verdict, cost."""
    heads = (
        Head("line", left=True),
        Head("blocks"),
        Head(f"difference to {found.control}", "points"),
        Head("95 % interval"),
        Head("P(X>Y)"),
        Head("p", "Holm"),
        Head("verdict", left=True),
        Head("IQM of gain", "points"),
        Head("step", f"x of {found.control}"),
    )
    lines = [_table_row(line) for line in found.lines]
    own = TableRow.of(found.control, *[""] * 6, _points(found.control_iqm), "")
    return Section(
        heading=f"Against {found.control}",
        heads=heads,
        lines=(*lines, own),
        source=sentence(found),
        caption=f"Against {found.control}. {sentence(found)} {' '.join(notes(found))}",
    )


def sentence(found: Verdicts) -> str:
    """What the whole comparison says, in one sentence."""
    total = len(found.lines)
    of = {word: [x for x in found.lines if x.comparison.verdict == word] for word in COLORS}
    cost = [line.step_x for line in of["better"] if not math.isnan(line.step_x)]
    at = f" (at {np.median(cost):.2f} times its step time)" if cost else ""
    return (
        f"{total} line{'s' * (total > 1)} against {found.control}: {len(of['better'])} better{at}, "
        f"{len(of['equivalent'])} equivalent within {evidence.MARGIN:g} point, "
        f"{len(of['worse'])} worse, {len(of['open'])} open."
    )


def untested(control: str, lines: Sequence[str]) -> str:
    """Why no line is tested against the control, in one sentence.

    Args:
        lines: their names.
    """
    if control not in lines:
        return f"Nothing is tested against '{control}': no such line{did_you_mean(control, lines)}."
    return (
        f"Nothing is tested against '{control}': it takes two seeds or problems in which this line "
        "and another have a log gain; the baseline of the gain has none."
    )


def notes(found: Verdicts) -> list[str]:
    """What a reader must know before believing the verdicts."""
    blocks = max(line.comparison.blocks for line in found.lines)
    made = " x ".join(
        f"{count} {what}{'s' * (count > 1)}"
        for what, count in (("problem", found.problems), ("seed", found.seeds))
    )
    said = [
        "Gain: 100 times the mean log ratio to the baseline of the same seed, first over a task's "
        "metrics and then over tasks; one point is about one percent.",
        f"Differences are paired by problem and seed ({made}); their interval is Student's, over "
        "the given problems. p: sign-flip test, two-sided, by Holm over the "
        f"{len(found.lines)} lines. Equivalent: the 90 % interval lies inside "
        f"+-{evidence.MARGIN:g} point. IQM: mean of the middle half of a line's own gains, with a "
        "bootstrap over seeds.",
    ]
    failed = sum(line.comparison.failed for line in found.lines)
    if failed:
        said.append(
            "Failed runs, and those with a 0 where more is better, count as the worst: "
            f"{failed} block{'s' * (failed > 1)} of line and control with one. Such a line has no "
            "mean difference and is never equivalent."
        )
    if len(found.lines) * 2 / 2**blocks > 1 - evidence.LEVEL:
        said.append(
            f"With {blocks} blocks no line of {len(found.lines)} can be better or worse by this "
            "test: more seeds or problems are needed."
        )
    return said


def forest(found: Verdicts, out_dir: Path, name: str) -> str | None:
    """The differences with their intervals, coloured by verdict, and the margin of equivalence.

    Returns:
        What the figure shows in words, or None where every line has failed runs.
    """
    shown = [line for line in found.lines if np.isfinite(line.comparison.difference.mean)]
    if not shown:
        return None
    with styled():
        figure = Figure(figsize=(7.2, 1.3 + 0.24 * len(shown)), layout="constrained")
        axes = figure.add_subplot()
        axes.axvspan(-evidence.MARGIN, evidence.MARGIN, color="#eeeeee", zorder=0)
        axes.axvline(0, **BASELINE)
        for place, line in enumerate(shown):
            of, color = line.comparison.difference, COLORS[line.comparison.verdict]
            if np.isfinite(of.low):
                axes.plot([of.low, of.high], [place, place], color=color, linewidth=2)
            axes.plot(of.mean, place, "o", color=color, markersize=5)
        axes.set_yticks(range(len(shown)), [line.label for line in shown])
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(f"difference of gain to {found.control}, points (more is better)")
        for word, color in COLORS.items():
            if any(line.comparison.verdict == word for line in shown):
                axes.plot([], [], "o-", color=color, label=word, markersize=5)
        figure.legend(loc="outside right upper")
        if found.smoke:
            axes.set_title(SMOKE, color="#a40000")
        save(figure, out_dir, name)
    left_out = [line.label for line in found.lines if line not in shown]
    lacking = f" Not drawn, as runs failed: {', '.join(left_out)}." if left_out else ""
    return (
        f"Paired differences to {found.control} with 95 % intervals; gray: the margin of "
        f"equivalence, {PLUS_MINUS}{evidence.MARGIN:g} point. {sentence(found)}{lacking}"
    )


# --- parts ----------------------------------------------------------------------------------------


def _by_block(
    rows: Sequence[Row], own: Sequence[str], shared: Sequence[str], value: Callable[[Row], float]
) -> dict[str, dict[tuple[str, int], float]]:
    """Line -> block (problem, seed) -> value."""
    found: dict[str, dict[tuple[str, int], float]] = {}
    for row in rows:
        cell = cell_of(row)
        line, problem = (", ".join(text(cell.get(axis)) for axis in axes) for axes in (own, shared))
        found.setdefault(line, {})[problem, int(row["seed"])] = value(row)
    return found


def _table(line: Mapping[tuple[str, int], float], problems: list[str], seeds: list[int]) -> Array:
    return np.array([[line.get((p, s), math.nan) for s in seeds] for p in problems])


def _gain(row: Row) -> float:
    """In points; -inf for a failed run."""
    if row.get("status") == "failed":
        return -math.inf
    percent = float(row.get("metric", {}).get("delta.gain", math.nan))
    return -math.inf if percent == -100 else 100 * math.log1p(percent / 100)


def _ratio(step_MN: Array, control_MN: Array) -> float:
    both = ~np.isnan(step_MN) & ~np.isnan(control_MN)
    return float(np.mean(step_MN[both] / control_MN[both])) if both.any() else math.nan


def _table_row(line: Line) -> TableRow:
    each = line.comparison
    of, p = each.difference, each.p_holm
    between = "-" if np.isnan(of.low) else f"{_signed(of.low)} ... {_signed(of.high)}"
    return TableRow.of(
        line.label,
        str(each.blocks),
        Cell(_signed(of.mean), bold=each.verdict == "better", value=of.mean),
        between,
        f"{each.superior:.2f}",
        Cell("< 0.001" if p < 0.001 else f"{p:.3f}", value=p),
        each.verdict,
        _points(line.iqm),
        "-" if math.isnan(line.step_x) else f"{line.step_x:.2f}",
    )


def _signed(value: float) -> str:
    """A difference; infinite ones are of failed runs."""
    if np.isfinite(value):
        return f"{value:+z.1f}"
    return "control failed" if value > 0 else "failed"


def _points(of: Estimate) -> Cell:
    if not np.isfinite(of.mean):
        return Cell("failed" if np.isinf(of.mean) else "-")
    known = np.isfinite(of.low) and np.isfinite(of.high)
    return Cell(
        _signed(of.mean),
        f"({_signed(of.low)} ... {_signed(of.high)})" if known else "",
        value=of.mean,
    )
