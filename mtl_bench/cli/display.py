"""What a running grid shows: bars with the time left in a terminal, timestamped lines elsewhere."""

import sys
import time
from collections.abc import Sequence
from typing import Any

from mtl_bench.bench.launch import Display, Run, duration

LINE_EVERY_S = 30.0


def choose(total: int, quiet: bool, bars: bool = True) -> Display:
    """Bars in a terminal, if they may be; lines in a file; failures only where quiet."""
    return Bars(total) if bars and sys.stdout.isatty() and not quiet else Lines(quiet)


class Lines:
    """A line when a job starts and ends, and one about every half minute between."""

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

    def started(self, run: Run) -> None:
        self.say(f"{run.label}  started  {run.place}".rstrip())

    def tick(self, runs: Sequence[Run]) -> None:
        if time.monotonic() - self._last < LINE_EVERY_S:
            return
        self._last = time.monotonic()
        for run in runs:
            if run.text:
                self.say(f"{run.label}  {run.text}")

    def ended(self, run: Run, line: str, ok: bool) -> None:
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

    def started(self, run: Run) -> None:
        if run.job.id in self._tasks:  # it was left to another process, and comes again
            self._progress.remove_task(self._tasks[run.job.id])
        self._tasks[run.job.id] = self._progress.add_task(run.label, total=None, info="starting")

    def tick(self, runs: Sequence[Run]) -> None:
        parts = 0.0
        for run in runs:
            step, steps = run.progress.get("step", 0), run.progress.get("steps")
            if steps and run.progress["stage"] == "train":
                parts += step / steps
            self._progress.update(
                self._tasks[run.job.id], completed=step, total=steps, info=run.text
            )
        share = (self._done + parts) / self._total
        left = (time.monotonic() - self._began) * (1 - share) / share if share > 0.02 else None
        info = f"{self._done}/{self._total}" + (f", {duration(left)} left" if left else "")
        self._progress.update(self._grid, completed=self._done + parts, info=info)

    def ended(self, run: Run, line: str, ok: bool) -> None:
        self._done += 1
        if run.job.id in self._tasks:
            self._progress.remove_task(self._tasks.pop(run.job.id))
        style = None if ok else "bold red"
        self._progress.console.print(line, markup=False, highlight=False, style=style)
