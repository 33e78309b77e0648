"""Multi-task delta: how much better or worse than a baseline over all metrics, in percent.

Two definitions are in use, with opposite signs and different winners, so both have a name. Both
take a doubled error for -100 and a halved one for +50, so that one bad metric decides without
bound; the log gain treats the two alike, and is what statistics are made of.
"""

import math
from collections.abc import Mapping


def delta_flat(
    values: Mapping[str, float], baseline: Mapping[str, float], higher_is_better: Mapping[str, bool]
) -> float:
    """Mean relative loss over all metrics: LOWER is better (Nash-MTL, ICML 2022; FAMO)."""
    gains = [_gain(name, values, baseline, up) for name, up in higher_is_better.items()]
    return -sum(gains) / len(gains)


def delta_task(
    values: Mapping[str, float],
    baseline: Mapping[str, float],
    higher_is_better: Mapping[str, bool],
    task_of: Mapping[str, str],
) -> float:
    """Mean over tasks of the mean relative gain of a task's metrics: HIGHER is better.

    Source: Maninis et al., CVPR 2019. A task with many metrics weighs no more than one with few.
    """
    by_task: dict[str, list[float]] = {}
    for name, up in higher_is_better.items():
        by_task.setdefault(task_of[name], []).append(_gain(name, values, baseline, up))
    return sum(sum(gains) / len(gains) for gains in by_task.values()) / len(by_task)


def log_gain(
    values: Mapping[str, float],
    baseline: Mapping[str, float],
    higher_is_better: Mapping[str, bool],
    task_of: Mapping[str, str],
) -> float:
    """100 times the mean over tasks of the mean log ratio of a task's metrics: HIGHER is better.

    One point is about one percent: r points are 100 (exp(r / 100) - 1) percent. A halved error is
    +69, a doubled one -69. It is -inf where a metric of which more is better is 0.

    Raises:
        ValueError: a metric is below 0, or its baseline is 0: no ratio exists.
    """
    by_task: dict[str, list[float]] = {}
    for name, up in higher_is_better.items():
        own, base = values[name], baseline[name]
        if own < 0 or base <= 0:
            raise ValueError(
                f"'{name}' is {own} beside {base}, of which no ratio exists: leave it out"
            )
        ratio = own / base if up else base / own if own else math.inf
        by_task.setdefault(task_of[name], []).append(math.log(ratio) if ratio else -math.inf)
    return 100 * sum(sum(logs) / len(logs) for logs in by_task.values()) / len(by_task)


def _gain(
    name: str, values: Mapping[str, float], baseline: Mapping[str, float], higher_is_better: bool
) -> float:
    if baseline[name] == 0:
        raise ValueError(
            f"baseline of '{name}' is 0, so no change relative to it exists: leave it out"
        )
    change = 100 * (values[name] - baseline[name]) / abs(baseline[name])
    return change if higher_is_better else -change
