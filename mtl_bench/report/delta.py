"""Multi-task delta of every row against its baseline: the stored single-task row of its seed.

Each seed is compared with its own baseline, and the table then takes mean and spread over seeds.
"""

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from mtl_bench.core import quality
from mtl_bench.core.columns import Column
from mtl_bench.evaluate.delta import delta_flat, delta_task, log_gain
from mtl_bench.report.columns import Row
from mtl_bench.report.statistics import by_recipe, recipe_of


def counted(rows: Sequence[Row]) -> list[Column]:
    """The metrics that count: those of the tasks that some row has a metric of.

    A row must have all of them, so that all rows of a recipe are judged by the same ones. A recipe
    of one task has none: there is nothing to trade.
    """
    metrics = [column for column in quality.quality() if column.in_delta]
    found = {c.task for c in metrics if any(_has(row, c) for row in rows)}
    return [column for column in metrics if column.task in found] if len(found) > 1 else []


def with_delta(
    rows: Sequence[Row],
    baseline_of: Callable[[Row], Row | None],
    metrics: Sequence[Column] = (),
) -> list[dict[str, Any]]:
    """Copies of rows with `delta.flat`, `.task` and `.gain` among their metrics, in percent.

    A row has none where its baseline is missing or itself (0 by definition, no finding), where one
    of the two lacks a metric, where the baseline has a 0 (no change relative to it exists), and
    where only the baseline's code is older or only one of the two is a smoke run.

    Args:
        metrics: what counts; none: what the tasks of the row's recipe declare.
    """
    of = {name: metrics or counted(several) for name, several in by_recipe(rows).items()}
    return [_with_delta(row, baseline_of(row), of[recipe_of(row)]) for row in rows]


def with_single_task_delta(
    rows: Sequence[Row], metrics: Sequence[Column] = ()
) -> list[dict[str, Any]]:
    """The same, against the single-task row among them whose cell differs in the method only."""
    single = {_but_the_method(row): row for row in rows if row["cell"].get("single_task")}
    return with_delta(rows, lambda row: single.get(_but_the_method(row)), metrics)


def _but_the_method(row: Row) -> str:
    method = ("method", "method_args", "granularity", "single_task", "replay")
    return json.dumps({k: v for k, v in row["cell"].items() if k not in method}, sort_keys=True)


def _with_delta(row: Row, baseline: Row | None, metrics: Sequence[Column]) -> dict[str, Any]:
    if baseline is None or not metrics or not _comparable(row, baseline, metrics):
        return dict(row)
    own, base = row["metric"], baseline["metric"]
    upward = {column.key: column.better > 0 for column in metrics}
    task_of = {column.key: column.task for column in metrics}
    delta = {
        "delta.flat": delta_flat(own, base, upward),
        "delta.task": delta_task(own, base, upward, task_of),
    }
    if all(own[key] >= 0 and base[key] > 0 for key in upward):  # else there are no ratios
        points = log_gain(own, base, upward, task_of)
        delta["delta.gain"] = 100 * math.expm1(points / 100)
    return {**row, "metric": {**own, **delta}, "delta_baseline": _named(baseline)}


def _has(row: Row, column: Column) -> bool:
    return math.isfinite(row.get("metric", {}).get(column.key, math.nan))


def _comparable(row: Row, baseline: Row, metrics: Sequence[Column]) -> bool:
    base = baseline.get("metric", {})
    return (
        row["slug"] != baseline["slug"]
        and baseline.get("status", "done") in ("done", row.get("status", "done"))
        and bool(row.get("smoke")) == bool(baseline.get("smoke"))
        and all(_has(row, column) and _has(baseline, column) for column in metrics)
        and all(base[column.key] != 0 for column in metrics)
    )


def _named(baseline: Row) -> str:
    """The baseline as a footnote names it."""
    kind = "single-task " if baseline.get("cell", {}).get("single_task") else ""
    return f"{kind}{baseline.get('method')} on {baseline.get('backbone')}"
