"""The training curve: one CSV row per step, cut back to the checkpoint when a run resumes."""

import csv
import statistics
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self


class Curve:
    """Appends rows to `path`; the header is the first row's keys.

    Args:
        resume_step: rows of later steps are dropped, since those steps will be run again.
    """

    def __init__(self, path: Path, resume_step: int = 0):
        kept = _rows_until(path, resume_step) if resume_step else []
        temporary = path.with_name(path.name + ".tmp")
        with temporary.open("w", newline="") as file:
            if kept:
                writer = csv.DictWriter(file, kept[0].keys())
                writer.writeheader()
                writer.writerows(kept)
        temporary.replace(path)
        self._empty = not kept
        self._file = path.open("a", newline="")

    def append(self, row: Mapping[str, float | None]) -> None:
        """Every row has the same keys; None leaves its place empty."""
        writer = csv.DictWriter(self._file, row.keys())
        if self._empty:
            writer.writeheader()
            self._empty = False
        writer.writerow({k: "" if value is None else f"{value:.6g}" for k, value in row.items()})

    def flush(self) -> None:
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()


def _rows_until(path: Path, step: int) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if int(row["step"]) <= step]


def training_time(path: Path) -> tuple[float, float]:
    """Seconds of all steps (of a resumed run too) and the median step in milliseconds."""
    with path.open(newline="") as file:
        step_ms = [float(row["step_ms"]) for row in csv.DictReader(file)]
    return sum(step_ms) / 1000, statistics.median(step_ms)


def data_share(path: Path) -> float:
    """Share of all steps' time in which training waited for batches."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    waited, took = (sum(float(row[key]) for row in rows) for key in ("data_ms", "step_ms"))
    return waited / took
