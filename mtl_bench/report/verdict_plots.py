"""The figures of verdicts: forest, performance profiles, bands of ranks.

Colour is the verdict; in the profiles, the line.
"""

import math
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mtl_bench.core.style import BASELINE, GRAY, PALETTE, Look, looks, save, styled
from mtl_bench.report import evidence
from mtl_bench.report.evidence import Array, Comparison
from mtl_bench.report.plots import middle
from mtl_bench.report.statistics import SMOKE
from mtl_bench.report.table import FEWER, PLUS_MINUS
from mtl_bench.report.verdicts import ALL, VERDICTS, Verdicts, has_fewer, sentence

COLORS = dict(zip(VERDICTS, (PALETTE[2], PALETTE[1], PALETTE[0], GRAY), strict=True))
PANELS = 6  # problems that fit beside each other
LEADERS = 7  # lines that have a colour where there are many
ACROSS = 4  # entries of a legend that fit beside each other
ROW = 0.2  # inches
FAINT = "#c8c8c8"


def forest(found: Verdicts, out_dir: Path, name: str) -> str | None:
    """The differences with their intervals and the margin of equivalence, a panel for each problem
    where they fit, the whole suite last.

    Returns:
        What the figure shows in words, or None where every line has failed runs.
    """
    panels = {ALL: [line.comparison for line in found.lines]}
    if 1 < len(found.problems) <= PANELS:
        each = zip(*(line.by_problem for line in found.lines), strict=True)
        panels = dict(zip(found.problems, map(list, each), strict=True)) | panels
    if not any(np.isfinite(c.difference.mean) for several in panels.values() for c in several):
        return None
    labels = [line.label + FEWER * has_fewer(line, found) for line in found.lines]
    one = len(panels) == 1
    with styled():
        width = 7.2 if one else 1.8 + 1.55 * len(panels)
        figure = Figure(figsize=(width, 1.3 + ROW * max(len(labels), 4)), layout="constrained")
        every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (title, compared) in zip(every, panels.items(), strict=True):
            _intervals(axes, compared)
            axes.set_title("" if one else title)
        every[0].set_yticks(range(len(labels)), labels)
        every[0].set_ylim(len(labels) - 0.4, -0.6)
        _verdict_legend(figure, [c for several in panels.values() for c in several])
        figure.supxlabel(f"difference of gain to {found.control.label}, points", fontsize=9)
        warn(figure, found)
        save(figure, out_dir, name)
    own = "" if one else " Each panel has its own scale."
    shown = [c.difference for several in panels.values() for c in several]
    single = any(np.isfinite(d.mean) and np.isnan(d.low) for d in shown)
    hollow = " Hollow: a single run of a problem, so that no interval is known." * single
    return (
        f"Paired differences to {found.control.label} with 95 % intervals, more is better; gray: "
        f"the margin of equivalence, {PLUS_MINUS}{evidence.MARGIN:g} point; an arrow: it goes on "
        f"further out; a number: the mean, where that is out, too.{hollow}{own} {sentence(found)}"
    )


def profiles(found: Verdicts, out_dir: Path, name: str) -> str | None:
    """Share of runs, over problems and seeds, whose gain is above a threshold.

    Returns:
        What the figure shows in words, or None where no run has a gain.
    """
    of = found.scores
    finite = of.gain_LMN[np.isfinite(of.gain_LMN)]
    if not len(finite):
        return None
    ends = middle(finite, finite, evidence.MARGIN)
    tau_T = np.unique(np.clip(finite, *ends))
    with styled():
        figure = Figure(figsize=(8.4, 4.2), layout="constrained")
        axes = figure.add_subplot()
        for label, look in highlighted(found):
            share_T = evidence.profile(of.gain_LMN[of.labels.index(label)], tau_T)
            axes.plot(tau_T, share_T, drawstyle="steps-post", **line_of(look))
        axes.axvline(0, **BASELINE)
        axes.set_xlabel("threshold of gain over the baseline, points")
        axes.set_ylabel("share of runs above it")
        axes.set_ylim(-0.02, 1.02)
        line_legend(figure, found)
        warn(figure, found)
        save(figure, out_dir, name)
    return (
        f"Performance profiles: share of a line's runs ({_suite(found)}) whose gain is above a "
        f"threshold; higher is better, and a failed run is above none.{_out_of_view(finite, ends)}"
        f"{said_of_colors(found)}"
    )


def bands(found: Verdicts, out_dir: Path, name: str) -> str | None:
    """Each line's rank and how far it goes by what a report chooses and by seeds.

    Returns:
        What the figure shows in words, or None where fewer than two lines have a rank.
    """
    ranked = found.ranked
    if len(ranked) < 2:
        return None
    with styled():
        figure = Figure(figsize=(7.2, 1.5 + ROW * max(len(ranked), 4)), layout="constrained")
        axes = figure.add_subplot()
        for place, line in enumerate(ranked):
            is_control = line is found.control
            color = "black" if is_control else COLORS[line.comparison.verdict]
            wide: dict[str, Any] = {"solid_capstyle": "butt", "color": color}
            axes.plot(line.drawn, [place, place], linewidth=7, alpha=0.3, **wide)
            axes.plot(line.chosen, [place, place], linewidth=1.6, **wide)
            axes.plot(line.rank, place, "D" if is_control else "o", color=color, markersize=4.5)
        names = [x.label + " (control)" * (x is found.control) for x in ranked]
        axes.set_yticks(range(len(ranked)), names)
        axes.set_ylim(len(ranked) - 0.4, -0.6)
        axes.set_xlim(0.5, len(ranked) + 0.5)
        axes.set_xlabel("rank by mean gain, 1 is best")
        shown: dict[str, Any] = {"color": GRAY, "solid_capstyle": "butt"}
        choices = "definition, problem left out" if len(found.problems) > 1 else "definition"
        more = [
            Line2D([], [], linewidth=7, alpha=0.3, label="seeds, 95 %", **shown),
            Line2D([], [], linewidth=1.6, label=choices, **shown),
        ]
        _verdict_legend(figure, [line.comparison for line in found.lines], more)
        warn(figure, found)
        save(figure, out_dir, name)
    left_out = " and with each problem left out" if len(found.problems) > 1 else ""
    without = len(found.lines) + 1 - len(ranked)
    absent = (
        f" Absent: {without} line{'s' * (without > 1)} without a run of some problem."
        if without
        else ""
    )
    return (
        "Ranks by mean gain (point; diamond: the control), their range by definition of the delta "
        f"(log gain, flat, by task){left_out} (line), and the middle 95 % over seeds resampled "
        f"jointly for all lines (bar). Colour: the verdict.{absent}"
    )


# --- lines of many, shared with the figures of trials ---------------------------------------------


def highlighted(found: Verdicts) -> list[tuple[str, Look]]:
    """Every line with its look, those in front last: of many only the best and the control have a
    colour of their own."""
    best = [line.label for line in found.ranked if line is not found.control]
    rest = [line.label for line in found.lines if line.label not in best]
    own = [*best, *rest]
    few = own if len(own) <= LEADERS else best[:LEADERS]
    colors = [color for color in PALETTE if color != "#000000"]
    given = {
        label: Look(colors[i], look.marker, look.dash)
        for i, (label, look) in enumerate(looks(few).items())
    }
    given[found.control.label] = Look("#000000", "*", "-")
    gray = [(label, Look(FAINT, "o", "-")) for label in own if label not in given]
    return [*gray, *reversed(given.items())]


def line_of(look: Look) -> dict[str, Any]:
    """How a curve is drawn."""
    faint = look.color == FAINT
    width = 0.9 if faint else 2.2 if look.color == "#000000" else 1.5
    style = {"color": look.color, "linestyle": look.dash, "linewidth": width}
    return style | {"zorder": 1 if faint else 2}


def point_of(look: Look) -> dict[str, Any]:
    """How a point is drawn."""
    size = {FAINT: 4.5, "#000000": 11.0}.get(look.color, 6.5)
    style = {"color": look.color, "marker": look.marker, "markersize": size, "linestyle": ""}
    return style | {"zorder": 2 if look.color == FAINT else 3}


def line_legend(
    figure: Figure,
    found: Verdicts,
    drawn: Collection[str] | None = None,
    more: Sequence[Line2D] = (),
    style: Callable[[Look], dict[str, Any]] = line_of,
) -> None:
    """The lines with a colour, the best first, and how many have none.

    Args:
        drawn: the lines that the figure has; None: all.
        more: what it has besides.
        style: `line_of` or `point_of`.
    """
    every = [item for item in highlighted(found) if drawn is None or item[0] in drawn]
    handles = [
        Line2D([], [], label=label, **style(look))
        for label, look in reversed(every)
        if look.color != FAINT
    ]
    others = sum(look.color == FAINT for _, look in every)
    if others:
        handles.append(
            Line2D([], [], label=f"{others} other{'s' * (others > 1)}", **style(every[0][1]))
        )
    figure.legend(handles=[*handles, *more], loc="outside right upper")


def said_of_colors(found: Verdicts) -> str:
    faint = any(look.color == FAINT for _, look in highlighted(found))
    return f" In colour: the control and the {LEADERS} best by mean gain." if faint else ""


# --- parts ----------------------------------------------------------------------------------------


def _intervals(axes: Axes, compared: Sequence[Comparison]) -> None:
    """A difference with its interval each, in the colour of its verdict."""
    known = [c for c in compared if np.isfinite(c.difference.mean)]
    lows = np.array([np.fmin(c.difference.low, c.difference.mean) for c in known])
    highs = np.array([np.fmax(c.difference.high, c.difference.mean) for c in known])
    margin = evidence.MARGIN
    left, right = middle(lows, highs, 2 * margin) if known else (-margin, margin)
    left, right = min(left, -1.3 * margin), max(right, 1.3 * margin)
    room = 0.04 * (right - left)
    axes.set_xlim(left - room, right + room)
    axes.axvspan(-margin, margin, color="#eeeeee", zorder=0)
    axes.axvline(0, **BASELINE)
    for place, each in enumerate(compared):
        of, color = each.difference, COLORS[each.verdict]
        if np.isfinite(of.mean):
            low, mean, high = np.clip([of.low, of.mean, of.high], left, right)
            style: dict[str, Any] = {"color": color, "markersize": 4.5, "clip_on": False}
            axes.plot([low, high], [place, place], color=color, linewidth=2)
            if np.fmin(of.low, of.mean) < left:
                axes.plot(left, place, "<", **style)
            if np.fmax(of.high, of.mean) > right:
                axes.plot(right, place, ">", **style)
            if mean == of.mean:
                face = "white" if np.isnan(of.low) else color
                axes.plot(mean, place, "o", markerfacecolor=face, **style)
            else:
                at, side = (mean + room, "left") if of.mean < left else (mean - room, "right")
                said = f"{of.mean:+.0f}"
                axes.text(at, place, said, ha=side, va="center", fontsize=7, color=color)
        elif each.failed:
            said = f"{each.failed} failed"
            axes.text(left, place, said, va="center", fontsize=7, color=COLORS["worse"])


def _verdict_legend(
    figure: Figure, compared: Sequence[Comparison], more: Sequence[Line2D] = ()
) -> None:
    given = {each.verdict for each in compared}
    handles = [
        Line2D([], [], marker="o", markersize=4.5, linewidth=2, color=color, label=word)
        for word, color in COLORS.items()
        if word in given
    ]
    handles += more
    across = len(handles) if len(handles) <= ACROSS else math.ceil(len(handles) / 2)
    figure.legend(handles=handles, loc="outside upper center", ncols=across)


def _out_of_view(values: Array, ends: tuple[float, float]) -> str:
    """How many runs have a gain beyond the ends of the axis."""
    below, above = int(np.sum(values < ends[0])), int(np.sum(values > ends[1]))
    said = " and ".join(f"{n} {where}" for n, where in ((below, "below"), (above, "above")) if n)
    return f" Out of view: {said} of {len(values)} runs." if said else ""


def warn(figure: Figure, found: Verdicts) -> None:
    if found.smoke:
        figure.suptitle(SMOKE, color="#a40000")


def _suite(found: Verdicts) -> str:
    problems, seeds = len(found.problems), len(found.scores.seeds)
    return f"{problems} problem{'s' * (problems > 1)} x {seeds} seed{'s' * (seeds > 1)}"
