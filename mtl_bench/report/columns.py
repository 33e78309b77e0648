"""The measured quantities that a table shows: where a row has them and how they are written."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """One measured quantity: where a row has it and how it is shown."""

    name: str  # in table.csv
    title: str
    key: str  # dotted key of a row; of a column relative to the reference: the other column's name
    better: int  # +1: higher, -1: lower
    digits: int
    scale: float = 1.0
    part: str = "quality"  # quality | cost
    note: str = ""  # said under the title


COLUMNS = (
    Column("pq", "PQ", "panoptic.pq", +1, 1, note="%"),
    Column("pq_things", "PQ things", "panoptic.pq_things", +1, 1, note="%"),
    Column("pq_stuff", "PQ stuff", "panoptic.pq_stuff", +1, 1, note="%"),
    Column("miou", "mIoU", "semantic.miou", +1, 1, note="%"),
    Column("abs_rel", "AbsRel", "depth_median.abs_rel", -1, 3, note="median-scaled"),
    Column("rmse", "RMSE", "depth_median.rmse", -1, 2, note="m, median-scaled"),
    Column("delta1", "delta1", "depth_median.delta1", +1, 3, note="median-scaled"),
    Column("rmse_dgc", "RMSE dgc", "depth_dgc.rmse", -1, 2, note="m, dgc-scaled"),
    Column("delta_flat", "\u0394 flat", "delta.flat", -1, 1, note="% worse"),
    Column("delta_task", "\u0394 task", "delta.task", +1, 1, note="% better"),
    Column("fps", "FPS", "latency.fps", +1, 1, part="cost"),
    Column("p50_ms", "p50", "latency.p50_ms", -1, 1, part="cost", note="ms"),
    Column("p95_ms", "p95", "latency.p95_ms", -1, 1, part="cost", note="ms"),
    Column("params_m", "params", "latency.params_m", -1, 2, part="cost", note="M"),
    Column("gmacs", "GMACs", "latency.gmacs", -1, 2, part="cost"),
    Column("peak_mib", "peak", "latency.peak_mib", -1, 1, part="cost", note="MiB"),
    Column("train_min", "train", "time.train_s", -1, 1, 1 / 60, part="cost", note="min"),
    Column("step_ms", "step", "time.step_ms", -1, 1, part="cost", note="ms"),
    Column("train_peak_mib", "train peak", "time.peak_mib", -1, 1, part="cost", note="MiB"),
)
BY_NAME = {column.name: column for column in COLUMNS}
RELATIVE = (  # to the reference group's mean
    Column("step_x", "step", "step_ms", -1, 2, part="cost"),
    Column("train_peak_x", "train peak", "train_peak_mib", -1, 2, part="cost"),
)
ONLY = {  # what a grid that is about one thing shows
    "cost": ("step_ms", "step_x", "train_peak_mib", "train_peak_x"),
}


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
        value = flatten(row).get(column.key)
    return math.nan if value is None else float(value) * column.scale
