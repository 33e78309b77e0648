"""What the trials of a tuned grid say: what a budget buys, and how far lines are from a front.

All of it is measured on the split that trials are judged by, so nothing here reads the results'.
A trial's score is in points of gain up to a constant of its problem; differences have a meaning.
"""

import csv
import io
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import stats

from mtl_bench.bench.space import SPLIT
from mtl_bench.bench.tuning import Key, Setting, Settings, Tried, best
from mtl_bench.core.style import save, styled
from mtl_bench.report import evidence
from mtl_bench.report.evidence import Array
from mtl_bench.report.plots import FRONT, draw_front, middle, plain_log
from mtl_bench.report.table import NOTHING, Cell, Head, Section, TableRow
from mtl_bench.report.verdict_plots import (
    highlighted,
    line_legend,
    line_of,
    point_of,
    said_of_colors,
    warn,
)
from mtl_bench.report.verdicts import Verdicts

PAIRS = 3  # of tasks, where there are more than two


def budgets(found: Verdicts, settings: Settings, out_dir: Path, name: str) -> str | None:
    """Expected best score of n trials over n, and over the seconds that they take.

    Returns:
        What the figure shows in words, or None where the control's trials have not ended, or there
        is but one.
    """
    control = found.control.label
    problems = [p for p in found.problems if _best((control, p), settings) is not None]
    trials = min((len(settings[control, p]) for p in problems), default=0)
    if trials < 2:
        return None
    curves = {}
    for label, look in highlighted(found):
        of = [settings.get((label, problem)) for problem in problems]
        if all(of):
            curves[label] = (_curve(control, label, problems, settings, trials), look)
    with styled():
        figure = Figure(figsize=(9.2, 4.0), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for (best_T, seconds), look in curves.values():
            budget_T = np.arange(1, trials + 1)
            left.plot(budget_T, best_T, **line_of(look))
            if seconds > 0:
                right.plot(budget_T * seconds, best_T, **line_of(look))
        every = np.concatenate([best_T for (best_T, _), _ in curves.values()])
        low, high = middle(every, every)
        room = 0.05 * (high - low)
        left.set_ylim(low - room, high + room)
        left.set_xticks(range(1, trials + 1))
        left.set_xlabel("trials" + " a problem" * (len(problems) > 1))
        plain_log(right, "x")
        right.set_xlabel("seconds of training and evaluation")
        left.set_ylabel(f"expected best of them, points over\n{control}'s best ({SPLIT})")
        line_legend(figure, found, set(curves))
        warn(figure, found)
        save(figure, out_dir, name)
    over = f", mean over {len(problems)} problems" if len(problems) > 1 else ""
    return (
        f"What a budget of tuning buys: expected score on the split {SPLIT} of the best of n of "
        f"the {trials} trials (Dodge et al., 2019), over n and over their seconds{over}; 0 is the "
        f"best of {control}'s. A failed trial counts as the worst of its problem."
        f"{said_of_colors(found)}"
    )


def tradeoff(
    found: Verdicts, settings: Settings, problem: str, out_dir: Path, name: str
) -> str | None:
    """Each line's chosen trial, task against task, and the front of the control's trials.

    Returns:
        What the figure shows in words, or None for fewer than two tasks or two trials with numbers.
    """
    control = found.control.label
    front, base = _front((control, problem), settings), _best((control, problem), settings)
    if base is None or len(base.task_scores) < 2 or len(front) < 2:
        return None
    tasks = list(base.task_scores)
    points = {
        label: (_differences(own, base), look)
        for label, look in highlighted(found)
        if (own := _best((label, problem), settings)) is not None and own.task_scores
    }
    every = [s for (_, p), several in settings.items() if p == problem for s in several]
    pairs = _pairs(
        tasks, np.array([_differences(each, base) for each in every if each.task_scores])
    )
    front_FK = np.array([_differences(each, base) for each in front])
    with styled():
        size = (2.0 + 3.2 * len(pairs), 3.6) if len(pairs) > 1 else (6.8, 4.0)
        figure = Figure(figsize=size, layout="constrained")
        for axes, pair in zip(figure.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
            _scatter(axes, [(p[list(pair)], look) for p, look in points.values()])
            corners = [(float(x), float(y)) for x, y in front_FK[:, pair]]
            draw_front(axes, corners)
            axes.plot(*zip(*corners, strict=True), ".", color=FRONT["color"], markersize=3)
            axes.set_xlabel(f"{tasks[pair[0]]}, points")
            axes.set_ylabel(f"{tasks[pair[1]]}, points")
        handle = Line2D([], [], label=f"{control}'s trials: front", **FRONT)
        line_legend(figure, found, set(points), [handle], point_of)
        warn(figure, found)
        save(figure, out_dir, name)
    chosen = f" The {len(pairs)} pairs of {len(tasks)} tasks that trade most." * (len(tasks) > 2)
    return (
        f"Task against task on the split {SPLIT}, each line's chosen trial: points over that of "
        f"{control}, more is better; a point far out stands at the edge. Stairs: the front of "
        f"{control}'s {len(front)} trials (dots).{chosen}"
        f"{said_of_colors(found)}"
    )


def distances(found: Verdicts, settings: Settings) -> Section | None:
    """A line each: how far it is behind the front of the control's trials, by problem; None where
    the control has no front."""
    control = found.control.label
    fronts = {p: _front((control, p), settings) for p in found.problems}
    problems = [p for p, f in fronts.items() if len(f) > 1 and len(f[0].task_scores) > 1]
    if not problems:
        return None
    lines = []
    for line in found.lines:
        values = [
            _behind(_best((line.label, problem), settings), fronts[problem]) for problem in problems
        ]
        mean = float(np.mean(values))
        shown = [*values, mean] if len(problems) > 1 else values
        cells = [
            Cell(f"{v:z.1f}", bold=v <= 0, value=v) if math.isfinite(v) else Cell(NOTHING)
            for v in shown
        ]
        lines.append((mean, TableRow.of(line.label, *cells)))
    lines.sort(key=lambda line: (math.isnan(line[0]), line[0]))
    heads = [Head("line", left=True), *(Head(p or "distance", "points") for p in problems)]
    heads += [Head("mean", "points")] * (len(problems) > 1)
    about = (
        f"Distance to the front of {control}'s trials on the split {SPLIT}: how many points each "
        "task of a line's chosen trial lacks until no trial of the front is ahead in all tasks "
        "(additive epsilon). Bold: 0 or less, on the front or beyond it."
    )
    return Section(
        heading=f"Distance to the front of {control}",
        heads=tuple(heads),
        lines=tuple(line for _, line in lines),
        source=about,
        caption=about,
    )


def records(tried: Sequence[Tried]) -> str:
    """`trials.csv`: a line per trial."""
    file = io.StringIO()
    out = csv.writer(file, lineterminator="\n")
    out.writerow(["line", "problem", "trial", "seed", "score", "seconds", "settings"])
    for each in tried:
        trial = each.trial
        known = "" if math.isnan(each.score) else f"{each.score:.6g}"
        named = [trial.line, trial.problem, trial.number, trial.cell.seed, known]
        out.writerow([*named, f"{each.seconds:.4g}", json.dumps(dict(trial.values))])
    return file.getvalue()


# --- parts ----------------------------------------------------------------------------------------


def _best(key: Key, settings: Settings) -> Setting | None:
    """The chosen one; None where trials have not ended, or all failed."""
    found = best(settings[key]) if key in settings else None
    return found if found is not None and math.isfinite(found.score) else None


def _front(key: Key, settings: Settings) -> list[Setting]:
    """The trials that have a finite score in every task."""
    return [each for each in settings.get(key, ()) if math.isfinite(each.score)]


def _curve(
    control: str, label: str, problems: Sequence[str], settings: Settings, trials: int
) -> tuple[Array, float]:
    """Expected best of 1 ... trials over the control's best, mean over problems; and a trial's
    seconds in all of them together."""
    best_MT, seconds = [], 0.0
    for problem in problems:
        every = [s.score for (_, p), several in settings.items() if p == problem for s in several]
        worst = min(score for score in every if math.isfinite(score))
        own = settings[label, problem][:trials]
        score_T = np.maximum([each.score for each in own], worst)
        base = _best((control, problem), settings)
        assert base is not None  # of the problems that were chosen
        best_MT.append(evidence.expected_best(score_T) - base.score)
        known = [each.seconds for each in own if not math.isnan(each.seconds)]
        seconds += float(np.mean(known)) if known else math.nan
    return np.mean(best_MT, axis=0), seconds


def _differences(of: Setting, base: Setting) -> Array:
    return np.array([of.task_scores[task] - base.task_scores[task] for task in base.task_scores])


def _behind(point: Setting | None, front: Sequence[Setting]) -> float:
    if point is None or not point.task_scores:
        return math.nan
    tasks = list(point.task_scores)
    front_FK = np.array([[each.task_scores[task] for task in tasks] for each in front])
    return evidence.behind_front(np.array([point.task_scores[task] for task in tasks]), front_FK)


def _pairs(tasks: Sequence[str], score_TK: Array) -> list[tuple[int, int]]:
    """Pairs of tasks, those first whose scores go together least over all trials."""
    pairs = list(itertools.combinations(range(len(tasks)), 2))
    if len(pairs) == 1:
        return pairs
    rank_TK = stats.rankdata(score_TK, axis=0)
    together = np.corrcoef(rank_TK, rowvar=False)
    return sorted(pairs, key=lambda pair: together[pair])[:PAIRS]


def _scatter(axes: Axes, points: Sequence[tuple[Array, Any]]) -> None:
    """The lines' points; those far out stand at the edge."""
    every = np.array([point for point, _ in points])
    limits = [middle(each, each, evidence.MARGIN) for each in every.T]
    for point, look in points:
        inside = [float(np.clip(v, *ends)) for v, ends in zip(point, limits, strict=True)]
        axes.plot(*inside, **point_of(look))
    (left, right), (low, high) = limits
    across, up = 0.06 * (right - left) or 1.0, 0.06 * (high - low) or 1.0
    axes.set_xlim(left - across, right + across)
    axes.set_ylim(low - up, high + up)
