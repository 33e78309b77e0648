"""What stands in the table of a grid of latencies: a line per timing, with what it lacks or doubts.

Nothing is drawn or formatted here.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mtl_bench.core.config import TASKS
from mtl_bench.report.columns import Column, Row, measured
from mtl_bench.report.groups import SMOKE, text

REFERENCE = "plain"  # the engine that speed-ups are over
SHOWN = ("done", "stale")  # statuses that have numbers
WORDS = {"missing": "not run"}  # a status as a reader says it
PASSES = 500  # the paper's
COLUMNS = (
    Column("mean_ms", "mean", "latency.mean_ms", -1, 1, note="ms"),
    Column("p50_ms", "p50", "latency.p50_ms", -1, 1, note="ms"),
    Column("p95_ms", "p95", "latency.p95_ms", -1, 1, note="ms"),
    Column("p99_ms", "p99", "latency.p99_ms", -1, 1, note="ms"),
    Column("fps", "FPS", "latency.fps", +1, 2),
    Column("speedup", "speedup", "latency.speedup", +1, 2, note=f"x of {REFERENCE}"),
    Column("transfer_ms", "transfer", "latency.transfer_ms", -1, 1, note="ms"),
    Column("network_ms", "network", "latency.network_ms", -1, 1, note="ms"),
    Column("postprocess_ms", "postproc", "latency.postprocess_ms", -1, 1, note="ms"),
    Column("throughput_fps", "batched", "latency.throughput_fps", +1, 2, note="FPS"),
    Column("panoptic_equal", "panoptic", "agreement.panoptic_equal", +1, 3, 100, note="% equal"),
    Column("depth_rel", "depth", "agreement.depth_median_rel", -1, 0, note="median diff."),
    Column("logits_max", "logits", "agreement.logits_max", -1, 0, note="max diff."),
    Column("roofline", "roofline", "roofline.share", +1, 0, 100, note="% reached"),
    Column("passes", "passes", "latency.passes", +1, 0),
)
BY_NAME = {column.name: column for column in COLUMNS}
SHORT = ("mean_ms", "p95_ms", "fps", "speedup", "network_ms", "postprocess_ms", "panoptic_equal")
IDENTITY = ("backbone", "tasks", "engine", "precision")  # columns of words, beside the size


@dataclass(frozen=True)
class Line:
    """One timing."""

    row: Row
    size: str  # height x width
    names: tuple[str, ...]  # one per IDENTITY
    status: str  # done | stale | wrong | failed | unavailable | missing
    why: str
    values: Mapping[str, float]  # column -> number; NaN where there is none

    @property
    def shown(self) -> bool:
        return self.status in SHOWN

    @property
    def engine(self) -> str:
        return self.names[2]

    @property
    def label(self) -> str:
        return " ".join([*self.names, self.size])

    @property
    def mark(self) -> str:
        """What a reader must know before reading the numbers; empty for a plain result."""
        noisy = self.shown and bool(self.row["metric"].get("latency.noisy"))
        marks = ["" if self.status == "done" else WORDS.get(self.status, self.status)]
        return "; ".join(filter(None, [*marks, "noisy" * noisy, SMOKE * self.smoke]))

    @property
    def smoke(self) -> bool:
        return bool(self.row.get("smoke"))


@dataclass(frozen=True)
class Quality:
    """What a backbone reached where it was trained: means over seeds."""

    backbone: str
    pq: float
    rmse: float
    seeds: int
    recipe: Mapping[str, Any]

    @property
    def size(self) -> str:
        return f"{self.recipe['data']['height']}x{self.recipe['data']['width']}"


@dataclass(frozen=True)
class LatencyTable:
    lines: tuple[Line, ...]
    quality: tuple[Quality, ...] = ()

    @property
    def sizes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(line.size for line in self.lines))

    @property
    def smoke(self) -> bool:
        return any(line.smoke for line in self.lines)

    @property
    def measured(self) -> list[Line]:
        return [line for line in self.lines if line.shown]

    def of(self, size: str) -> list[Line]:
        return [line for line in self.lines if line.size == size]

    def columns(self) -> list[Column]:
        """Those that some line has."""
        return [c for c in COLUMNS if any(not math.isnan(v.values[c.name]) for v in self.lines)]

    def facts(self, key: str) -> list[str]:
        """Different values of a measured fact, such as `latency.device`."""
        found = [line.row["metric"].get(f"latency.{key}") for line in self.measured]
        return list(dict.fromkeys(text(value) for value in found if value is not None))


def tabulate(rows: Sequence[Row], quality: Sequence[Row] = ()) -> LatencyTable:
    """A line per timing, in the rows' order.

    Args:
        rows: as `latency_runs.rows` gives them.
        quality: done rows of trained cells, whose PQ and RMSE the plots set beside the speed.
    """
    references = {_alike(row): row for row in rows if _is_reference(row)}
    lines = [_line(row, references.get(_alike(row))) for row in rows]
    return LatencyTable(tuple(lines), tuple(_qualities(quality)))


def _is_reference(row: Row) -> bool:
    return row["engine"] == REFERENCE and row["status"] in SHOWN


def _alike(row: Row) -> str:
    """What a timing and its reference share: all but engine and precision."""
    timing = {k: v for k, v in row["timing"].items() if k not in ("engine", "precision")}
    return json.dumps(timing, sort_keys=True)


def _line(row: Row, reference: Row | None) -> Line:
    arguments = row["timing"].get("backbone_args", {})
    backbone = " ".join([row["backbone"], *(f"{k}={text(v)}" for k, v in arguments.items())])
    shown = row["status"] in SHOWN
    values = {c.name: measured(row, c) if _tells(row, c) else math.nan for c in COLUMNS}
    if shown and reference is not None:
        base = measured(reference, BY_NAME["mean_ms"])
        values["speedup"] = base / values["mean_ms"]
    return Line(
        row=row,
        size=f"{row['height']}x{row['width']}",
        names=(backbone, text(row["tasks"]), row["engine"], row["precision"]),
        status=row["status"],
        why=str(row.get("why") or ""),
        values=values,
    )


def _tells(row: Row, column: Column) -> bool:
    """Whether a row may show a number: a wrong one how wrong it is, and no time."""
    agreement = column.key.startswith("agreement.")
    return row["status"] in SHOWN or (row["status"] == "wrong" and agreement)


def _qualities(rows: Sequence[Row]) -> Iterator[Quality]:
    """Of the networks with all tasks, by backbone."""
    whole = [row for row in rows if set(row["tasks"]) == set(TASKS)]
    for backbone in dict.fromkeys(row["backbone"] for row in whole):
        own = [row for row in whole if row["backbone"] == backbone]
        yield Quality(
            backbone=backbone,
            pq=_mean(own, "panoptic.pq"),
            rmse=_mean(own, "depth_median.rmse"),
            seeds=len(own),
            recipe=own[0]["cell"]["recipe"],
        )


def _mean(rows: Sequence[Row], key: str) -> float:
    return sum(row["metric"][key] for row in rows) / len(rows)


# --- what must be said ----------------------------------------------------------------------------


def without_numbers(table: LatencyTable) -> list[tuple[str, str, str, str]]:
    """Status, engine, which timings and why: a line for each engine and reason."""
    found: dict[tuple[str, str, str], list[Line]] = {}
    for line in table.lines:
        if not line.shown:
            found.setdefault((line.status, line.engine, line.why), []).append(line)
    return [
        (WORDS.get(status, status), engine, _which(lines), why or "mtl-bench ablate takes it")
        for (status, engine, why), lines in found.items()
    ]


def _which(lines: Sequence[Line]) -> str:
    if len(lines) == 1:
        return lines[0].label
    return f"{len(lines)} timings"


def notes(table: LatencyTable) -> list[str]:
    """One sentence or two for each thing that occurs in the table."""
    return list(_notes(table))


def _notes(table: LatencyTable) -> Iterator[str]:
    lines = table.measured
    if not lines:
        return
    where = ", ".join(table.facts("device"))
    threads = " or ".join(table.facts("threads"))
    yield (
        f"Measured on {where}, {threads} thread{'s' * (threads != '1')}, batch 1: from the 8-bit "
        "image in host memory to panoptic map and metric depth, transfer and post-processing in. "
        "FPS is 1000 / mean; the three stages add up to the mean."
    )
    if len(table.facts("device")) > 1:
        yield "Several devices: lines of different devices do not compare."
    if any(not math.isnan(line.values["speedup"]) for line in lines):
        yield (
            f"Speed-up: mean of '{REFERENCE}' (eager torch as the network is trained, nothing "
            "folded) over a line's mean, same backbone, tasks and size."
        )
    batches = " or ".join(table.facts("throughput_batch"))
    if batches:
        yield f"Batched: throughput in images a second, {batches} at a time."
    yield (
        f"Agreement: output compared with that of '{REFERENCE}' on the same images before anything "
        "is timed: panoptic pixels that are equal, depth relative, logits absolute. A line that "
        "differs too much is marked wrong and has no time."
    )
    if any(line.row.get("weights") == "random" for line in lines):
        yield (
            "Random weights: a convolution takes as long as with trained ones, but the number of "
            "instances that post-processing finds, and its time, may be another, and nearly tied "
            "logits make equal panoptic pixels say less."
        )
    yield from _doubts(table)


def _doubts(table: LatencyTable) -> Iterator[str]:
    lines = table.measured
    if any("noisy" in line.mark for line in lines):
        yield "Noisy: the passes spread or drift too much, as on a busy machine: --rerun all."
    fewest = min(line.values["passes"] for line in lines)
    if fewest < PASSES:
        yield (
            f"As few as {fewest:.0f} passes, where the paper has {PASSES}: "
            f"p99 is {'the slowest one' if fewest <= 100 else 'of few'}."
        )
    stale = list(dict.fromkeys(line.why for line in lines if line.status == "stale"))
    if stale:
        yield f"Stale: code changed after the time was taken ({', '.join(stale)}): --rerun stale."
    if table.smoke:
        yield "Smoke: a few passes of a tiny network that show that all runs. Not a result."
