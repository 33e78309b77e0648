"""What a running grid shows: bars with the time left in a terminal, timestamped lines elsewhere."""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from mtl_bench.core.config import TASKS, Cell

LINE_EVERY_S = 30.0


@dataclass
class Running:
    """A cell that runs now, as far as its `progress.json` tells."""

    number: int  # of total, from 1
    total: int
    cell: Cell
    directory: Path
    began: float = field(default_factory=time.monotonic)
    progress: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""  # the grid's, where it has names
    _stage: tuple[str, int, float] = ("", 0, 0.0)  # name, first step seen, when

    @property
    def label(self) -> str:
        name = f" ({self.name})" if self.name else ""
        return f"[{self.number}/{self.total}] {label(self.cell)}{name}"

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    def see(self, progress: Mapping[str, Any]) -> None:
        self.progress = progress
        if progress["stage"] != self._stage[0]:
            self._stage = (progress["stage"], progress["step"], time.monotonic())

    @property
    def left_s(self) -> float | None:
        """Time left in this stage at its pace so far."""
        _, first, since = self._stage
        done = self.progress.get("step", 0) - first
        if done <= 0:
            return None
        pace = (time.monotonic() - since) / done
        return float(pace * (self.progress["steps"] - self.progress["step"]))

    @property
    def text(self) -> str:
        if not self.progress:
            return "starting"
        p = self.progress
        left = "" if self.left_s is None else f", {duration(self.left_s)} left"
        return f"{p['stage']} {p['step']}/{p['steps']}{left}  {p.get('note', '')}".rstrip()


class Display(Protocol):
    """What the launcher tells; `with` begins and ends the showing."""

    def __enter__(self) -> "Display": ...
    def __exit__(self, *error: object) -> None: ...
    def say(self, line: str) -> None: ...
    def started(self, job: Running) -> None: ...
    def tick(self, jobs: Sequence[Running]) -> None: ...
    def ended(self, job: Running, line: str, ok: bool) -> None: ...


def choose(total: int, quiet: bool) -> Display:
    """Bars in a terminal, lines in a file, failures only where quiet."""
    return Bars(total) if sys.stdout.isatty() and not quiet else Lines(quiet)


class Lines:
    """A line when a cell starts and ends, and one about every half minute between."""

    def __init__(self, quiet: bool = False):
        self._quiet = quiet
        self._last = time.monotonic()

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def say(self, line: str) -> None:
        if not self._quiet:
            self._print(line)

    def started(self, job: Running) -> None:
        self.say(f"{job.label}  started  {job.directory}")

    def tick(self, jobs: Sequence[Running]) -> None:
        if time.monotonic() - self._last < LINE_EVERY_S:
            return
        self._last = time.monotonic()
        for job in jobs:
            self.say(f"{job.label}  {job.text}")

    def ended(self, job: Running, line: str, ok: bool) -> None:
        if not (ok and self._quiet):
            self._print(line)

    def _print(self, line: str) -> None:
        print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)


class Bars:
    """One bar for the grid and one for each running cell; what has ended stands above them."""

    def __init__(self, total: int):
        from rich.progress import BarColumn, Progress, TextColumn

        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(24),
            TextColumn("{task.fields[info]}", markup=False),
        )
        self._total = total
        self._began = time.monotonic()
        self._grid = self._progress.add_task("cells", total=total, info="")
        self._tasks: dict[str, Any] = {}
        self._done = 0

    def __enter__(self) -> "Bars":
        self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def say(self, line: str) -> None:
        self._progress.console.print(line, markup=False, highlight=False)

    def started(self, job: Running) -> None:
        if job.cell.id in self._tasks:  # it was left to another process, and comes again
            self._progress.remove_task(self._tasks[job.cell.id])
        self._tasks[job.cell.id] = self._progress.add_task(job.label, total=None, info="starting")

    def tick(self, jobs: Sequence[Running]) -> None:
        parts = 0.0
        for job in jobs:
            step, steps = job.progress.get("step", 0), job.progress.get("steps")
            if steps and job.progress["stage"] == "train":
                parts += step / steps
            self._progress.update(
                self._tasks[job.cell.id], completed=step, total=steps, info=job.text
            )
        share = (self._done + parts) / self._total
        left = (time.monotonic() - self._began) * (1 - share) / share if share > 0.02 else None
        info = f"{self._done}/{self._total}" + (f", {duration(left)} left" if left else "")
        self._progress.update(self._grid, completed=self._done + parts, info=info)

    def ended(self, job: Running, line: str, ok: bool) -> None:
        self._done += 1
        if job.cell.id in self._tasks:
            self._progress.remove_task(self._tasks.pop(job.cell.id))
        style = None if ok else "bold red"
        self._progress.console.print(line, markup=False, highlight=False, style=style)


def label(cell: Cell) -> str:
    """A cell in a few words: what a reader tells cells of one grid apart by."""
    words = [cell.method, cell.backbone, f"s{cell.seed}"]
    words += [] if cell.tasks == TASKS else [",".join(cell.tasks)]
    words += ["single-task"] if cell.single_task else []
    words += ["video"] if cell.video else []
    words += [] if cell.granularity == "terms" else [f"by {cell.granularity}"]
    words += [
        f"{key}={value}"
        for args in (cell.method_args, cell.backbone_args)
        for key, value in args.items()
    ]
    return " ".join(words)


def duration(seconds: float) -> str:
    """3h02, 4m10, 12s"""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600}h{whole % 3600 // 60:02}"
    return f"{whole // 60}m{whole % 60:02}" if whole >= 60 else f"{whole}s"
