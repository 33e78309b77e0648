"""Which lines are better than the control: paired differences of gain, a test, and a verdict.

A grid asks for it by `control` under its [report]: the line (a value of `rows`) that every other
is held against. Runs are paired by problem (recipe, backbone, tasks) and seed; a failed run counts
as the worst, a missing one leaves its block out. The other lines are the family of Holm's test.
"""

import csv
import io
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.columns import Column
from mtl_bench.core.plain import did_you_mean
from mtl_bench.report import evidence
from mtl_bench.report.columns import DELTA, Row, column, measured, text
from mtl_bench.report.evidence import Array, Comparison, Estimate
from mtl_bench.report.statistics import (
    SHOWN,
    axes_of,
    by_recipe,
    cell_of,
    own_and_shared,
    recipe_of,
)
from mtl_bench.report.table import FEWER, Cell, Head, Section, TableRow
from mtl_bench.report.tuned import note

VERDICTS = ("better", "worse", "equivalent", "open")
MARK = "*"  # behind a difference whose p by Holm is at most 0.05
ALL = "all problems"
Blocks = dict[str, dict[tuple[str, int], float]]  # line -> problem and seed -> value


@dataclass(frozen=True)
class Scores:
    """What the runs of a grid measured: by line, problem and seed."""

    labels: tuple[str, ...]
    problems: tuple[str, ...]
    seeds: tuple[int, ...]
    gain_LMN: Array  # points; NaN: missing, -inf: failed
    others: tuple[Array, ...]  # the same by the other definitions of a delta, percent
    step_LMN: Array  # ms; NaN: unknown

    def within(self, chosen_M: NDArray[np.bool_]) -> "Scores":
        """Those of some problems."""
        return replace(
            self,
            problems=tuple(itertools.compress(self.problems, chosen_M)),
            gain_LMN=self.gain_LMN[:, chosen_M],
            others=tuple(other_LMN[:, chosen_M] for other_LMN in self.others),
            step_LMN=self.step_LMN[:, chosen_M],
        )


@dataclass(frozen=True)
class Line:
    """A line's case against the control."""

    label: str
    comparison: Comparison  # over all problems
    iqm: Estimate  # of its own gains over all problems
    step_x: float  # its step time over the control's, each of its fastest run; mean over problems
    by_problem: tuple[Comparison, ...]  # tested by Student: a problem has few seeds
    without: tuple[Comparison, ...]  # of all problems but one; of one problem none
    rank: float  # by mean gain, the control among them; NaN for a line that lacks a problem
    chosen: tuple[float, float]  # its ranks over definitions of the delta and left-out problems
    drawn: tuple[float, float]  # its ranks over resampled seeds, the middle 95 %


@dataclass(frozen=True)
class Verdicts:
    """All lines of a grid against its control, the best first."""

    control: Line  # compared with itself
    lines: tuple[Line, ...]
    scores: Scores
    smoke: bool
    left_out: tuple[str, ...]  # problems in which the control has no gain
    stale: str  # recipes whose runs are of older code, and which; empty: none

    @property
    def problems(self) -> tuple[str, ...]:
        return self.scores.problems

    @property
    def ranked(self) -> list[Line]:
        """The control among the others, by its mean gain; those without a rank are absent."""
        known = [line for line in (*self.lines, self.control) if not math.isnan(line.rank)]
        return sorted(known, key=lambda line: line.rank)


def judge(rows: Sequence[Row], axis: str, control: str) -> Verdicts | None:
    """Hold every line of a grid against one; None where no other shares two blocks with it.

    Args:
        rows: with `delta.gain` among their metrics where they have numbers; failed ones, too.
        axis: the field of a cell that names a line.
        control: its value that the others are held against.
    """
    recipes = by_recipe(rows)
    rows = _comparable(rows, axis, control)
    of = scores(rows, axis)
    if control not in of.labels:
        return None
    at = of.labels.index(control)
    has_M = ~np.isnan(of.gain_LMN[at]).all(-1)
    judged = {recipe_of(row) for row in rows if not math.isnan(_gain(row))}
    left_out = [name for name in recipes if name not in judged]
    left_out += itertools.compress(of.problems, ~has_M)
    of = of.within(has_M)
    gain_LMN = of.gain_LMN
    rest = [i for i in range(len(of.labels)) if i != at]
    compare = partial(_compare, gain_LMN, at)
    over_all = compare()
    if not any(over_all[i].blocks > 1 for i in rest):
        return None
    places = range(len(of.problems))
    by_problem = [compare([m], test=evidence.student) for m in places]
    without = [compare([o for o in places if o != m]) for m in places if len(places) > 1]
    iqms = evidence.bootstrap(gain_LMN)
    ranks = evidence.ranks(evidence.suite_mean(gain_LMN))
    chosen, drawn = evidence.rank_bands([gain_LMN, *of.others])
    found = {
        i: Line(
            label=of.labels[i],
            comparison=over_all[i],
            iqm=iqms[i],
            step_x=_ratio(of.step_LMN[i], of.step_LMN[at]),
            by_problem=tuple(each[i] for each in by_problem),
            without=tuple(each[i] for each in without),
            rank=float(ranks[i]),
            chosen=tuple(chosen[i]),
            drawn=tuple(drawn[i]),
        )
        for i in range(len(of.labels))
        if over_all[i].blocks or i == at
    }
    lines = [line for i, line in found.items() if i != at]
    lines.sort(key=lambda line: -np.nan_to_num(line.comparison.difference.mean, nan=-1e9))
    smoke = any(row.get("smoke") for row in rows)
    return Verdicts(found[at], tuple(lines), of, smoke, tuple(left_out), _stale(rows))


def _comparable(rows: Sequence[Row], axis: str, control: str) -> list[Row]:
    """What failed, and of every problem the runs by the code of today, or, where its control has
    none of those, the stale ones."""
    rows = [row for row in rows if row.get("status", "done") in (*SHOWN, "failed")]
    current = {
        recipe_of(row)
        for line, _, row in _named(rows, axis)
        if line == control and row.get("status", "done") == "done"
    }
    return [
        row
        for row in rows
        if row.get("status") == "failed"
        or (row.get("status") == "stale") != (recipe_of(row) in current)
    ]


def _stale(rows: Sequence[Row]) -> str:
    """Recipes whose runs are stale, and the commits that these were of."""
    stale = [row for row in rows if row.get("status") == "stale"]
    commits = {str(row.get("env", {}).get("git_commit") or "unknown")[:7] for row in stale}
    names = ", ".join(by_recipe(stale))
    return f"{names} (commit {', '.join(sorted(commits))})" if stale else ""


def scores(rows: Sequence[Row], axis: str) -> Scores:
    """Every run's numbers in their places.

    A line whose finished runs have no gain, as the baseline's, is none; one of failed runs is.
    """
    named = list(_named(rows, axis))
    gains = {
        line: of
        for line, of in _by_block(named, _gain).items()
        if any(map(math.isfinite, of.values())) or all(map(math.isinf, of.values()))
    }
    blocks = {b: 0 for of in gains.values() for b, gain in of.items() if not math.isnan(gain)}
    problems = tuple(dict.fromkeys(problem for problem, _ in blocks))
    seeds = tuple(sorted({seed for _, seed in blocks}))

    def table(of: Blocks) -> Array:
        found = [[[of[k].get((p, s), math.nan) for s in seeds] for p in problems] for k in gains]
        return np.array(found).reshape(len(gains), len(problems), len(seeds))

    def number(of: Column) -> Callable[[Row], float]:
        return lambda row: measured(row, of)

    step_ms, others = column("step_ms"), [c for c in DELTA if c.name != "gain"]
    return Scores(
        labels=tuple(gains),
        problems=problems,
        seeds=seeds,
        gain_LMN=table(gains),
        others=tuple(table(_by_block(named, partial(_signed_delta, c))) for c in others),
        step_LMN=table(_by_block(named, number(step_ms))),
    )


# --- what is said of it ---------------------------------------------------------------------------


def sections(found: Verdicts, tune: Any = None) -> list[Section]:
    """The whole comparison, then problem by problem where there are several.

    Args:
        tune: the grid's section [tune].
    """
    return [_over_all(found, tune), *([_by_problem(found)] if len(found.problems) > 1 else [])]


def sentence(found: Verdicts) -> str:
    """What the whole comparison says, in one sentence: counts, and what it costs."""
    total, control = len(found.lines), found.control.label
    of = {word: [x for x in found.lines if x.comparison.verdict == word] for word in VERDICTS}
    suite = f" over {len(found.problems)} problems" if len(found.problems) > 1 else ""
    return (
        f"{len(of['better'])} of {total} line{'s' * (total > 1)} beat{'s' * (total == 1)} "
        f"{control}{suite}{_at(of['better'])}, {len(of['equivalent'])} {_are(of['equivalent'])} "
        f"equivalent within {evidence.MARGIN:g} point{_at(of['equivalent'])}, {len(of['worse'])} "
        f"{_are(of['worse'])} worse, {len(of['open'])} {_are(of['open'])} open{_lacking(found)}."
    )


def protocol(found: Verdicts, tune: Any = None) -> str:
    """How the comparison was made, for a paper: budget, results, test, margin.

    Args:
        tune: the grid's section [tune].
    """
    budget = (
        "Untuned: every line has the settings that the grid gives it, published ones or its own."
    )
    blocks = max(line.comparison.blocks for line in found.lines)
    seeds = ", ".join(map(str, found.scores.seeds))
    several = f" x {len(found.problems)} problems" if len(found.problems) > 1 else ""
    if tune is not None:
        budget = f"{note(tune)} Intervals are over the results' seeds, not over other trials."
    return (
        f"{budget} Results: seeds {seeds}{several}, n = {blocks} "
        f"blocks; family: {len(found.lines)} line{'s' * (len(found.lines) > 1)} against "
        f"{found.control.label}, sign-flip test, two-sided, by Holm at "
        f"{1 - evidence.LEVEL:.2g}; margin of equivalence: {evidence.MARGIN:g} point."
    )


def untested(control: str, lines: Sequence[str]) -> str:
    """Why no line is tested against the control, in one sentence.

    Args:
        lines: their names.
    """
    if control not in lines:
        why = f"no such line has numbers{did_you_mean(control, lines)}"
        return f"Nothing is tested against '{control}': {why}."
    return (
        f"Nothing is tested against '{control}': it takes two seeds or problems in which this line "
        "and another have a log gain, both by the code of today or both stale. The baseline of the "
        "gain has none."
    )


def notes(found: Verdicts) -> list[str]:
    """What a reader must know before believing the verdicts."""
    blocks = max(line.comparison.blocks for line in found.lines)
    made = " x ".join(
        f"{count} {what}{'s' * (count > 1)}"
        for what, count in (("problem", len(found.problems)), ("seed", len(found.scores.seeds)))
    )
    several = len(found.problems) > 1
    said = [
        "Gain: 100 times the mean log ratio to the baseline of the same seed, first over a task's "
        "metrics and then over tasks; one point is about one percent.",
        f"Differences are paired by problem and seed ({made}, n = {blocks} blocks); their interval "
        "is Student's, over the given problems. p: sign-flip test, two-sided, by Holm over the "
        f"family of {len(found.lines)} lines. Equivalent: the 90 % interval lies inside "
        f"+-{evidence.MARGIN:g} point. P(X>Y): share of blocks in which the line is ahead. IQM: "
        "mean of the middle half of a line's own gains, with a bootstrap over seeds at 95 %, which "
        "covers about 91 % with five.",
        f"Rank: by mean gain, {found.control.label} among the lines; below it the range over "
        "definitions of the delta (log gain, flat, by task)"
        f"{' and left-out problems' * several}, and the middle 95 % over resampled seeds. Step: of "
        "each line's fastest run, since other work on a machine only slows one.",
    ]
    if several:
        said.append(
            f"{MARK} p by Holm at most 0.05: of one problem by Student's paired test over its "
            "seeds, of all by the sign-flip test. Verdicts hold for these problems; the last "
            "columns leave out each of them in turn."
        )
    if found.left_out:
        said.append(
            f"Left out: {', '.join(found.left_out)}, where {found.control.label} has no log gain: "
            "its own numbers or the baseline's are missing."
        )
    if found.stale:
        said.append(
            f"Stale, all runs that are compared: {found.stale}. Code has changed since; "
            "--rerun stale runs them again."
        )
    if any(has_fewer(line, found) for line in found.lines):
        said.append(
            f"{FEWER} Fewer blocks than another line: runs are missing, and a line without any run "
            "of a problem has no rank."
        )
    if any(np.isfinite(d.mean) and np.isnan(d.low) for d in _differences(found)):
        said.append(
            "No interval: a single run of a problem has no spread. Such a line is never equivalent."
        )
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


def records(found: Verdicts) -> str:
    """`verdicts.csv`: a line per comparison, over all problems, in each, and without each."""
    file = io.StringIO()
    heads = ("line", "control", "problems", "blocks", "failed", "difference", "low", "high")
    more = ("superior", "p", "p_holm", "verdict", "step_x", "rank", "rank_best", "rank_worst")
    out = csv.writer(file, lineterminator="\n")
    out.writerow([*heads, *more])
    for line in found.lines:
        named = [(ALL, line.comparison)]
        if line.without:
            named += zip(found.problems, line.by_problem, strict=True)
        named += [(f"without {p}", e) for p, e in zip(found.problems, line.without, strict=False)]
        for problems, each in named:
            of = each.difference
            numbers = (of.mean, of.low, of.high, each.superior, each.p, each.p_holm)
            cost = (line.step_x, line.rank, *band(line)) if problems == ALL else [math.nan] * 4
            words = [_plain(value) for value in (*numbers, *cost)]
            named_by = [line.label, found.control.label, problems, each.blocks, each.failed]
            out.writerow([*named_by, *words[:6], each.verdict, *words[6:]])
    return file.getvalue()


def band(line: Line) -> tuple[float, float]:
    """The best and the worst rank of a line by any choice or draw."""
    both = (line.chosen, line.drawn)
    return min(low for low, _ in both), max(high for _, high in both)


def has_fewer(line: Line, found: Verdicts) -> bool:
    """Whether runs of a line are missing that another has."""
    return line.comparison.blocks < max(each.comparison.blocks for each in found.lines)


# --- parts ----------------------------------------------------------------------------------------


def _named(rows: Sequence[Row], axis: str) -> Iterator[tuple[str, str, Row]]:
    """Line, problem and row: a problem's name is its recipe's where there are several, and what
    else makes it one."""
    recipes = by_recipe(rows)
    axes = {name: axes_of(several, axis) for name, several in recipes.items()}
    parts = {name: own_and_shared(several) for name, several in axes.items()}
    own = dict.fromkeys(axes[name][i] for name in recipes for i in parts[name][0])
    for name, several in recipes.items():
        shared = [axes[name][i] for i in parts[name][1]]
        for row in several:
            cell = cell_of(row)
            line = ", ".join(text(cell.get(key)) for key in own)
            named = [name] * (len(recipes) > 1) + [text(cell.get(key)) for key in shared]
            tuned = row.get("tuned", {})  # what trials were of is called by them
            yield tuned.get("line", line), tuned.get("problem", ", ".join(named)), row


def _by_block(named: Sequence[tuple[str, str, Row]], value: Callable[[Row], float]) -> Blocks:
    found: Blocks = {}
    for line, problem, row in named:
        found.setdefault(line, {})[problem, int(row["seed"])] = value(row)
    return found


def _gain(row: Row) -> float:
    """In points; -inf for a failed run."""
    percent = _signed_delta(DELTA[-1], row)
    return -math.inf if percent <= -100 else 100 * math.log1p(percent / 100)


def _signed_delta(of: Column, row: Row) -> float:
    """Percent, of which more is better; -inf for a failed run."""
    return -math.inf if row.get("status") == "failed" else of.better * measured(row, of)


def _compare(
    gain_LMN: Array,
    at: int,
    problems: Sequence[int] | None = None,
    test: Callable[[Array], float] | None = None,
) -> list[Comparison]:
    """Each line against the one at a place, over some problems; that one's own is in its place."""
    chosen_LMN = gain_LMN if problems is None else gain_LMN[:, problems]
    rest = np.delete(chosen_LMN, at, axis=0)
    found = evidence.compare(rest, chosen_LMN[at], test)
    (own,) = evidence.compare(chosen_LMN[at : at + 1], chosen_LMN[at], test)
    return [*found[:at], own, *found[at:]]


def _ratio(step_MN: Array, control_MN: Array) -> float:
    """Of the fastest runs, since what else a machine does only makes some slower."""
    ratio_M = np.fmin.reduce(step_MN, axis=1) / np.fmin.reduce(control_MN, axis=1)
    known_M = ~np.isnan(ratio_M)
    return float(ratio_M[known_M].mean()) if known_M.any() else math.nan


def _over_all(found: Verdicts, tune: Any) -> Section:
    """A line each: difference with its interval, P(X > Y), p by Holm, verdict, rank, cost."""
    control = found.control.label
    heads = (
        Head("line", left=True),
        Head("blocks"),
        Head(f"difference to {control}", "points"),
        Head("95 % interval"),
        Head("P(X>Y)"),
        Head("p", "Holm"),
        Head("verdict", left=True),
        Head("IQM of gain", "points"),
        Head("rank", "and its range"),
        Head("step", f"x of {control}"),
    )
    own = TableRow.of(control, *[""] * 6, _points(found.control.iqm), _rank(found.control), "1.00")
    return Section(
        heading=f"Against {control}",
        heads=heads,
        lines=(*(_table_row(line, found) for line in found.lines), own),
        source=f"{sentence(found)} {protocol(found, tune)}",
        caption=" ".join(
            [f"Against {control}.", sentence(found), protocol(found, tune), *notes(found)]
        ),
    )


def _by_problem(found: Verdicts) -> Section:
    """A line each: difference in every problem, and over all when one of them is left out."""
    control = found.control.label
    heads = [Head("line", left=True), *(Head(problem, "points") for problem in found.problems)]
    heads += [Head(ALL, "points"), Head("one left out", "least, most")]
    heads += [Head("verdict without it", left=True)]
    lines = []
    for line in found.lines:
        every = [each.difference.mean for each in line.without]
        known = [value for value in every if not math.isnan(value)]
        range_of = Cell(f"{_signed(min(known))}, {_signed(max(known))}") if known else Cell("-")
        cells = [_difference(each) for each in (*line.by_problem, line.comparison)]
        lines.append(TableRow.of(line.label, *cells, range_of, _stands(line, found.problems)))
    return Section(
        heading=f"Difference to {control} by problem",
        heads=tuple(heads),
        lines=tuple(lines),
        caption=(
            f"Paired differences of gain to {control} by problem, with 95 % intervals. {MARK}: p "
            "by Holm at most 0.05; bold: better."
        ),
    )


def _stands(line: Line, problems: Sequence[str]) -> str:
    """Whether the verdict stays, whatever problem is left out."""
    own = line.comparison.verdict
    other: dict[str, list[str]] = {}
    for problem, each in zip(problems, line.without, strict=True):
        if each.verdict != own:
            other.setdefault(each.verdict, []).append(problem)
    said = [f"{verdict} without {' or '.join(without)}" for verdict, without in other.items()]
    return "; ".join(said) or f"{own}, whichever"


def _table_row(line: Line, found: Verdicts) -> TableRow:
    each = line.comparison
    of, p = each.difference, each.p_holm
    between = "-" if np.isnan(of.low) else f"{_signed(of.low)} ... {_signed(of.high)}"
    return TableRow.of(
        line.label,
        f"{each.blocks}{FEWER * has_fewer(line, found)}",
        Cell(_marked(each), bold=each.verdict == "better", value=of.mean),
        between,
        f"{each.superior:.2f}",
        Cell("< 0.001" if p < 0.001 else f"{p:.3f}", value=p),
        each.verdict,
        _points(line.iqm),
        _rank(line),
        "-" if math.isnan(line.step_x) else f"{line.step_x:.2f}",
    )


def _difference(each: Comparison) -> Cell:
    of = each.difference
    if math.isnan(of.mean):
        return Cell("-")
    between = "" if math.isnan(of.low) else f"({_signed(of.low)} ... {_signed(of.high)})"
    return Cell(_marked(each), between, each.verdict == "better", of.mean)


def _marked(each: Comparison) -> str:
    told = each.verdict in ("better", "worse") and math.isfinite(each.difference.mean)
    return _signed(each.difference.mean) + MARK * told


def _rank(line: Line) -> Cell:
    if math.isnan(line.rank):
        return Cell("-")
    best, worst = band(line)
    return Cell(f"{line.rank:g}", f"({best:g} ... {worst:g})", value=line.rank)


def _differences(found: Verdicts) -> list[Estimate]:
    return [line.comparison.difference for line in found.lines]


def _at(lines: Sequence[Line]) -> str:
    """What lines cost, where it is known."""
    cost = [line.step_x for line in lines if not math.isnan(line.step_x)]
    median = " in the median" * (len(cost) > 1)
    return f" (at {np.median(cost):.2f} times its step time{median})" if cost else ""


def _lacking(found: Verdicts) -> str:
    """How many of the lines are judged by some of the runs alone."""
    count = sum(has_fewer(line, found) for line in found.lines)
    lines = f"{count} line{'s' * (count > 1)} lack{'s' * (count == 1)} runs ({FEWER})"
    return f"; {lines}" if count else ""


def _are(lines: Sequence[Line]) -> str:
    return "is" if len(lines) == 1 else "are"


def _plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


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
