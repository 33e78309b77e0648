"""The columns of a grid's table: the tasks' metrics, deltas and cost; and the values of rows."""

import math
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Any

from mtl_bench.core import quality
from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.text import in_a_line

Row = Mapping[str, Any]

DELTA = (  # of a baseline whose own is 0
    Column("delta_flat", "delta.flat", "\u0394 flat", -1, 1, "% worse"),
    Column("delta_task", "delta.task", "\u0394 task", +1, 1, "% better", short=True),
    Column("gain", "delta.gain", "log gain", +1, 1, "% better"),
)
COST = (
    FPS,
    Column("p50_ms", "latency.p50_ms", "p50", -1, 1, "ms", part="cost"),
    Column("p95_ms", "latency.p95_ms", "p95", -1, 1, "ms", part="cost"),
    Column("params_m", "latency.params_m", "params", -1, 2, "M", part="cost", short=True),
    Column("gmacs", "latency.gmacs", "GMACs", -1, 2, part="cost"),
    Column("peak_mib", "latency.peak_mib", "peak", -1, 1, "MiB", part="cost"),
    Column("train_min", "time.train_s", "train", -1, 1, "min", scale=1 / 60, part="cost"),
    Column("step_ms", "time.step_ms", "step", -1, 1, "ms", part="cost"),
    Column("train_peak_mib", "time.peak_mib", "train peak", -1, 1, "MiB", part="cost"),
)
RELATIVE = (  # to the reference group's mean; the key is the other column's name
    Column("step_x", "step_ms", "step", -1, 2, part="cost"),
    Column("train_peak_x", "train_peak_mib", "train peak", -1, 2, part="cost"),
)
OF_CONTROL = {  # figures of a grid with a control, the last two of one that is tuned
    "forest": "Against the control",
    "bands": "How far ranks go",
    "profiles": "Performance profiles",
    "budgets": "What a budget of tuning buys",
    "tradeoff": "Trade-off of tasks, and the control's front",
}
ONLY = {  # what a grid that is about one thing shows
    "cost": ("step_ms", "step_x", "train_peak_mib", "train_peak_x"),
}


def columns() -> tuple[Column, ...]:
    """All but the relative ones, in the table's order."""
    return (*quality.quality(), *DELTA, *COST)


def column(name: str) -> Column:
    return next(c for c in (*columns(), *RELATIVE) if c.name == name)


def headlines() -> list[Column]:
    """The metrics that are plotted, without the speed."""
    return [column for column in quality.quality() if column.headline]


def pairs() -> list[tuple[Column, Column]]:
    """What is plotted against what: (y, x)."""
    return [*((y, FPS) for y in headlines()), *combinations(headlines(), 2)]


def against(y: Column, x: Column) -> str:
    return capital(f"{y.in_words} against {x.in_words}")


def capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def per_class() -> dict[str, Column]:
    """Stem of a figure per class -> its metric: `classes` is the first headline's."""
    return {f"{c.name}_classes" if i else "classes": c for i, c in enumerate(headlines())}


def figures() -> dict[str, str]:
    """Stems of the figures that a grid's report may have -> their headings, in the page's order."""
    return {
        **OF_CONTROL,
        **{f"{y.name}_{x.name}": against(y, x) for y, x in pairs()},
        "samples": "Sample predictions",
        "extremes": "Worst and best frame of each row",
        **{stem: capital(f"{c.in_words} per class") for stem, c in per_class().items()},
        "loss_curves": "Training curves",
        "weight_curves": "Learned weights",
        "diagnostics": "Update norm and gradient cosines",
    }


# --- values ---------------------------------------------------------------------------------------


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def measured(row: Row, column: Column) -> float:
    """A row's value in the column's unit; NaN where it has none."""
    value = row.get("metric", {}).get(column.key)
    if value is None:
        value = row
        for part in column.key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
    return math.nan if value is None else float(value) * column.scale


def text(value: Any) -> str:
    """A setting as a reader writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(text(item) for item in value) or "none"
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else in_a_line(str(value))


def different(values: Iterable[Any]) -> list[str]:
    """Values as text, each once."""
    return list(dict.fromkeys(map(text, values)))
