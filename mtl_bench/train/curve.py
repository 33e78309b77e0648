"""The training curve: one CSV row per step, cut back to the checkpoint when a run resumes."""

import csv
import io
import os
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from mtl_bench.core.files import write_text

REMEDY = "put the right file there, or begin at step 0: train --rerun, ablate --rerun failed"
WEIGHTS = ("weight.", "head.")


class Curve:
    """Appends rows to `path`; the header is the first row's keys.

    Args:
        resume_step: rows of later steps are dropped, since those steps will be run again.

    Raises:
        ValueError: the rows of the steps up to that one are not all there.
    """

    def __init__(self, path: Path, resume_step: int = 0):
        kept = read(path)[:resume_step] if resume_step else []
        if len(kept) < resume_step:
            raise ValueError(
                f"{path} ends at step {len(kept)}, before the checkpoint's {resume_step}; {REMEDY}"
            )
        text = io.StringIO(newline="")
        if kept:
            writer = csv.DictWriter(text, kept[0].keys())
            writer.writeheader()
            writer.writerows(kept)
        write_text(path, text.getvalue())
        self._empty = not kept
        self._file: io.TextIOBase = path.open("a", newline="")

    def append(self, row: Mapping[str, float | None]) -> None:
        """Every row has the same keys; None leaves its place empty."""
        writer = csv.DictWriter(self._file, row.keys())
        if self._empty:
            writer.writeheader()
            self._empty = False
        writer.writerow({key: _text(key, value) for key, value in row.items()})

    def flush(self) -> None:
        """What was appended is on the disk, also for a machine that loses its power now."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


class Unwritten(Curve):
    """Of a rank that writes nothing."""

    def __init__(self) -> None:
        self._file = io.StringIO()

    def append(self, row: Mapping[str, float | None]) -> None:
        """Rank 0 writes it."""


def _text(key: str, value: float | None) -> str:
    """Six digits; of weights, which `replay` trains with, the nine that a float32 has."""
    if value is None:
        return ""
    return f"{value:.9g}" if key.startswith(WEIGHTS) else f"{value:.6g}"


def read(path: Path) -> list[dict[str, str]]:
    """The rows of steps 1, 2, ...; a last line that a kill left unfinished is dropped.

    Raises:
        ValueError: no such file, or one that no run has written.
    """
    try:
        text, ended, _ = path.read_bytes().decode().rpartition("\n")
        rows = list(csv.DictReader(io.StringIO(text + ended, newline="")))
        for number, row in enumerate(rows, 1):
            whole = None not in row and None not in row.values()
            if not whole or float(row["step"]) != number:
                raise ValueError(f"line {number + 1} is not step {number}")
            _ = [float(value) for value in row.values() if value]
    except FileNotFoundError:
        raise ValueError(f"no curve {path}; {REMEDY}") from None
    except KeyError as error:
        raise ValueError(f"{path} is damaged (no column {error}); {REMEDY}") from None
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path} is damaged ({error}); {REMEDY}") from None
    return rows


def training_time(path: Path) -> tuple[float, float]:
    """Seconds of all steps (of a resumed run too) and the median step in milliseconds."""
    step_ms = [float(row["step_ms"]) for row in read(path)]
    return sum(step_ms) / 1000, statistics.median(step_ms)


def data_share(path: Path) -> float:
    """Share of all steps' time in which training waited for batches."""
    rows = read(path)
    waited, took = (sum(float(row[key]) for row in rows) for key in ("data_ms", "step_ms"))
    return waited / took
