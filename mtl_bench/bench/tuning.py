"""Trials: what tuning a grid's lines costs, which settings it chooses, and the results of those.

Every line of a grid with a section [tune], its baseline among them, gets as many trials on every
problem as any other. A trial is a cell like others, on a seed of its own, evaluated on the split
val and not timed. The results are cells with the chosen settings, on the grid's seeds and the
recipe's own split, which nothing was chosen by. A line is chosen for once all its trials have
ended.
"""

import functools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.grid import Grid, baseline_cell
from mtl_bench.bench.jobs import CELLS, Job, with_parents
from mtl_bench.bench.references import baselines
from mtl_bench.bench.space import SPLIT, draws, value_of
from mtl_bench.core import plugins
from mtl_bench.core.columns import Column
from mtl_bench.core.config import Cell, set_values
from mtl_bench.core.quality import quality
from mtl_bench.evaluate.delta import log_gain

Key = tuple[str, str]  # line, problem
PROBLEM = ("backbone", "tasks", "pretrained")  # axes that make a problem of its own, as a recipe
ONE = ("recipe", "seed", *PROBLEM)  # axes that no line is called by


@dataclass(frozen=True)
class Trial:
    """A setting of a line on a problem, trained with a tuning seed."""

    line: str
    problem: str
    number: int  # 0: the published setting
    cell: Cell
    values: Mapping[str, Any]  # by key of --set; of trial 0 none


@dataclass(frozen=True)
class Tried:
    """A trial and how good it was.

    Args:
        score: 100 times the mean over tasks of the mean over a task's counted metrics of their
            logarithms, negative for errors: points of gain up to a constant. -inf for a trial that
            failed, NaN for one that has not ended.
        task_scores: the same of each task; of a trial without numbers none.
        seconds: what it took; 0 without numbers.
    """

    trial: Trial
    score: float
    task_scores: Mapping[str, float]
    seconds: float


@dataclass(frozen=True)
class Setting:
    """What a line's trials with one setting on a problem came to, over the tuning seeds."""

    trial: Trial  # of the first tuning seed
    score: float  # mean; -inf where one failed
    task_scores: Mapping[str, float]  # mean of each; none where one failed
    seconds: float  # of all together; NaN where one has no numbers


Settings = Mapping[Key, Sequence[Setting]]


@dataclass(frozen=True)
class Final:
    """A result: a cell of the grid with the settings that were chosen for its line."""

    line: str
    problem: str
    base: Cell  # as the grid has it
    cell: Cell
    choice: Setting


def problems(grid: Grid) -> tuple[str, ...]:
    """In the order in which they are run."""
    return tuple(dict.fromkeys(line.problem for line in _lines(grid)))


@functools.lru_cache(maxsize=2)
@plugins.listed_once()
def trials(grid: Grid) -> tuple[Trial, ...]:
    """All, problem by problem, the published settings of all lines first.

    Raises:
        ValueError: a setting that a cell cannot have.
    """
    assert grid.tune is not None
    seeds = grid.tune.seeds
    first = {(line.name, line.problem): line.base for line in reversed(_lines(grid))}
    drawn = {key: draws(grid.tune, base) for key, base in first.items()}
    return tuple(
        Trial(*key, number, _trial_cell(first[key], seed, drawn[key][number]), drawn[key][number])
        for problem in problems(grid)
        for number in range(grid.tune.trials)
        for key in dict.fromkeys((each.name, each.problem) for each in _lines(grid))
        if key[1] == problem
        for seed in seeds
    )


@plugins.listed_once()
def tried(
    grid: Grid, runs: Path, data: Data | None = None, of: Collection[str] | None = None
) -> tuple[Tried, ...]:
    """Every trial with its score, as far as it has ended.

    Args:
        of: problems; None: all.
    """
    wanted = problems(grid) if of is None else of
    every = [trial for trial in trials(grid) if trial.problem in wanted]
    found = [(trial, _state(trial.cell, runs, data)) for trial in every]
    metrics = {p: _counted(s.row for t, s in found if t.problem == p) for p in wanted}
    return tuple(_judged(trial, state, metrics[trial.problem]) for trial, state in found)


def ended(tried: Iterable[Tried]) -> Settings:
    """By line and problem its settings in order, where all its trials have ended."""
    groups: dict[Key, dict[int, list[Tried]]] = {}
    for each in tried:
        numbers = groups.setdefault((each.trial.line, each.trial.problem), {})
        numbers.setdefault(each.trial.number, []).append(each)
    found = {key: [_setting(of[n]) for n in sorted(of)] for key, of in groups.items()}
    return {k: v for k, v in found.items() if not any(math.isnan(each.score) for each in v)}


def best(settings: Sequence[Setting]) -> Setting:
    """The one that is chosen: the first of the best, which is the published one if all failed."""
    return max(settings, key=lambda each: each.score)


def chosen(
    grid: Grid, runs: Path, data: Data | None = None, of: Collection[str] | None = None
) -> dict[Key, Setting]:
    """What each line's trials choose on each problem, where all of them have ended."""
    return {key: best(several) for key, several in ended(tried(grid, runs, data, of)).items()}


@plugins.listed_once()
def finals(
    grid: Grid, runs: Path, data: Data | None = None, of: Collection[str] | None = None
) -> tuple[Final, ...]:
    """The grid's cells and their baselines with the settings that were chosen, where they were."""
    choices = chosen(grid, runs, data, of)
    return tuple(
        Final(*key, line.base, set_values(line.base, choices[key].trial.values), choices[key])
        for line in _lines(grid)
        for key in [(line.name, line.problem)]
        if key in choices
    )


# --- running and reporting ------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """What a problem of the grid takes, and how far it is."""

    problem: str
    trials: tuple[Tried, ...]
    finals: tuple[Final, ...]
    open: tuple[Cell, ...]  # of the grid, whose settings are not chosen yet

    @property
    def cells(self) -> tuple[Cell, ...]:
        return (*(each.trial.cell for each in self.trials), *(each.cell for each in self.finals))

    def to_try(self, again: bool) -> list[Cell]:
        """The cells of its trials; of those that failed only where they are wanted again."""
        return [t.trial.cell for t in self.trials if again or t.score != -math.inf]

    def hours(
        self, todo: Sequence[Job], runs: Path, rerun: str | None = None, data: Data | None = None
    ) -> float | None:
        """Expected, one cell after another; None where none is done.

        Args:
            todo: those of `cells` and of what they need that are not done.
            rerun, data: as in `store.to_run`.
        """
        return store.hours_to_run([*todo, *self.open], with_parents(self.cells), runs, rerun, data)


@plugins.listed_once()
def part(grid: Grid, problem: str, runs: Path, data: Data | None = None) -> Part:
    """How far a problem is."""
    found = finals(grid, runs, data, [problem])
    known = {final.base.id for final in found}
    bases = [line.base for line in _lines(grid) if line.problem == problem]
    left = tuple(base for base in bases if base.id not in known)
    return Part(problem, tried(grid, runs, data, [problem]), found, left)


@plugins.listed_once()
def results(
    grid: Grid, runs: Path, data: Data | None = None
) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """The rows of a report, and by cell id those that their deltas are against.

    A row is that of the cell with the chosen settings, under the cell that the grid names, so that
    lines are those of the grid; `tuned` says which settings.
    """
    found = {final.base.id: final for final in finals(grid, runs, data)}
    rows = {id: _row(final, runs, data) for id, final in found.items()}
    named = {id: {"name": name} for id, name in grid.names.items()}
    against = {}
    for cell in grid.cells if grid.baseline else ():
        baseline = rows.get(baseline_cell(cell, grid.baseline).id, {})
        if cell.id in found and "metric" in baseline:
            against[found[cell.id].cell.id] = baseline
    waiting = {"status": "missing", "error": "its trials have not ended"}
    every = [
        {**rows.get(cell.id, {**CELLS.identity(cell), **waiting}), **named.get(cell.id, {})}
        for cell in grid.cells
    ]
    return every, against


def _row(final: Final, runs: Path, data: Data | None) -> dict[str, Any]:
    (row,) = store.rows([final.cell], runs, data=data)
    trial = final.choice.trial
    tuned = {"line": final.line, "problem": final.problem, "trial": trial.number}
    tuned |= {"values": dict(trial.values), "failed": final.choice.score == -math.inf}
    return {**row, "cell": CELLS.identity(final.base)["cell"], "tuned": tuned}


# --- parts ----------------------------------------------------------------------------------------


def _state(cell: Cell, runs: Path, data: Data | None) -> store.State:
    """Of one that lacks a parent for good: failed, as that one."""
    state = store.inspect(cell, runs, data)
    if state.word == "missing" and cell.parents:
        failed = (store.inspect(parent, runs, data) for parent in cell.parents)
        return next((parent for parent in failed if parent.word == "failed"), state)
    return state


@dataclass(frozen=True)
class _Line:
    """A cell of the grid, or of its baseline, and where it belongs."""

    name: str
    problem: str
    base: Cell


@functools.lru_cache(maxsize=2)
def _lines(grid: Grid) -> tuple[_Line, ...]:
    own = {cell.id for cell in grid.cells}
    further = [cell for cell in baselines(grid) if cell.id not in own]
    named = [(_line(grid, cell), cell) for cell in grid.cells]
    named += [("single-task" if c.single_task else "baseline", c) for c in further]
    return tuple(_Line(name, _problem(grid, cell), cell) for name, cell in named)


def _line(grid: Grid, cell: Cell) -> str:
    """What the report calls it: a row's name, or the values of the axes in which lines differ."""
    axis = str(grid.report.get("rows", "backbone"))
    first = grid.names[cell.id] if axis == "name" else value_of(cell, axis)
    others = [key for key, v in grid.axes.items() if len(v) > 1 and key not in (axis, *ONE)]
    return ", ".join(_text(value) for value in (first, *(value_of(cell, key) for key in others)))


def _problem(grid: Grid, cell: Cell) -> str:
    """Its recipe's name, and what else makes it a problem of its own in this grid."""
    axis = grid.report.get("rows", "backbone")
    keys = [k for k in PROBLEM if k != axis and len(grid.axes.get(k, ())) > 1]
    return ", ".join([cell.recipe.name, *(_text(value_of(cell, key)) for key in keys)])


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _trial_cell(base: Cell, seed: int, values: Mapping[str, Any]) -> Cell:
    evaluate, latency = base.recipe.evaluate, base.recipe.latency
    judged = replace(
        base.recipe,
        evaluate=replace(evaluate, split=SPLIT),
        latency=replace(latency, passes=0),  # nobody asks, and cells beside it would hold still
    )
    return set_values(replace(base, recipe=judged, seed=seed), values)


def _counted(rows: Iterable[Mapping[str, Any] | None]) -> list[Column]:
    """The metrics that count in a delta and that some trial of a problem has."""
    found = {k for row in rows if row for k, v in row.get("metric", {}).items() if _finite(v)}
    return [column for column in quality() if column.in_delta and column.key in found]


def _judged(trial: Trial, state: store.State, metrics: list[Column]) -> Tried:
    if state.row is None or state.word not in ("done", "stale"):
        return Tried(trial, -math.inf if state.word == "failed" else math.nan, {}, 0.0)
    metric, seconds = state.row["metric"], CELLS.seconds(state.row)
    if not (metrics and all(_finite(metric.get(column.key)) for column in metrics)):
        return Tried(trial, -math.inf, {}, seconds)
    by_task = {task: _score(metric, metrics, task) for task in {c.task: 0 for c in metrics}}
    return Tried(trial, _mean(list(by_task.values())), by_task, seconds)


def _score(metric: Mapping[str, float], metrics: list[Column], task: str) -> float:
    own = [column for column in metrics if column.task == task]
    values = {column.key: max(metric[column.key], 0.0) for column in own}
    upward = {column.key: column.better > 0 for column in own}
    return log_gain(values, dict.fromkeys(values, 1.0), upward, dict.fromkeys(values, task))


def _setting(several: Sequence[Tried]) -> Setting:
    numbers = all(each.task_scores for each in several)
    tasks = several[0].task_scores if numbers else {}
    return Setting(
        trial=several[0].trial,
        score=_mean([each.score for each in several]),
        task_scores={task: fmean(each.task_scores[task] for each in several) for task in tasks},
        seconds=sum(each.seconds for each in several) if numbers else math.nan,
    )


def _mean(scores: list[float]) -> float:
    """The worst is worst, whatever else there is."""
    return -math.inf if -math.inf in scores else fmean(scores)


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)
