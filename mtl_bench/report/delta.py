"""Multi-task delta of every row against its baseline: the stored single-task row of its seed.

Each seed is compared with its own baseline, and the table then takes mean and spread over seeds.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from mtl_bench.evaluate.delta import delta_flat, delta_task
from mtl_bench.report.columns import Row

METRICS = {  # key: task, whether higher is better
    "panoptic.pq": ("panoptic", True),
    "semantic.miou": ("panoptic", True),
    "depth_median.abs_rel": ("depth", False),
    "depth_median.rmse": ("depth", False),
    "depth_median.delta1": ("depth", True),
}
TASK_OF = {key: task for key, (task, _) in METRICS.items()}
HIGHER_IS_BETTER = {key: up for key, (_, up) in METRICS.items()}


def with_delta(
    rows: Sequence[Row], baseline_of: Callable[[Row], Row | None]
) -> list[dict[str, Any]]:
    """Copies of rows with `delta.flat` and `delta.task` among their metrics, in percent.

    A row has none where its baseline is missing or itself (0 by definition, no finding), where one
    of the two lacks a metric, where the baseline has a 0 (no change relative to it exists), and
    where only the baseline's code is older or only one of the two is a smoke run.
    """
    return [_with_delta(row, baseline_of(row)) for row in rows]


def _with_delta(row: Row, baseline: Row | None) -> dict[str, Any]:
    if baseline is None or not _comparable(row, baseline):
        return dict(row)
    own, base = row["metric"], baseline["metric"]
    delta = {
        "delta.flat": delta_flat(own, base, HIGHER_IS_BETTER),
        "delta.task": delta_task(own, base, HIGHER_IS_BETTER, TASK_OF),
    }
    return {**row, "metric": {**own, **delta}, "delta_baseline": _words(baseline)}


def _comparable(row: Row, baseline: Row) -> bool:
    own, base = row.get("metric", {}), baseline.get("metric", {})
    return (
        row["slug"] != baseline["slug"]
        and baseline.get("status", "done") in ("done", row.get("status", "done"))
        and bool(row.get("smoke")) == bool(baseline.get("smoke"))
        and all(math.isfinite(own.get(key, math.nan)) for key in METRICS)
        and all(math.isfinite(base.get(key, math.nan)) and base[key] != 0 for key in METRICS)
    )


def _words(baseline: Row) -> str:
    """The baseline as a footnote names it."""
    kind = "single-task " if baseline.get("cell", {}).get("single_task") else ""
    return f"{kind}{baseline.get('method')} on {baseline.get('backbone')}"
