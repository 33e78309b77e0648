"""Runs cells, each in a process of its own: GPU memory is freed, and a crash costs one cell.

The command of a cell is always `python -m mtl_bench train runs/X/cell.json ...`, here as in a
terminal. State is the run directories: a launcher that was killed is simply started again, and two
launchers on one grid share its cells. A cell that needs others waits until they are done.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mtl_bench.bench import claim, results
from mtl_bench.bench.grid import with_parents
from mtl_bench.cli.display import Display, Running, duration
from mtl_bench.core.config import Cell, to_dict
from mtl_bench.core.provenance import cores
from mtl_bench.core.quiet import SIDE_BY_SIDE

CLAIMED = 75  # exit code of a cell that another process runs
INTERRUPTED = (130, -signal.SIGINT, -signal.SIGTERM)  # exit codes of a cell that was told to stop
POLL_S = 0.2
GRACE_S = 30.0  # for a cell to save its state after Ctrl-C

Command = Callable[[Cell], Sequence[str]]


def to_run(cells: Iterable[Cell], runs: Path, rerun: str | None = None) -> list[Cell]:
    """The cells without a result, those asked for again, and before them what they need.

    Args:
        rerun: `stale`: also those whose code changed, each from the first stage on that this
            concerns. `failed`: those that failed begin at step 0
            rather than at their checkpoint. `all`: every cell, from step 0. `latency`: of those
            that are done, only the latency.
    """
    again: dict[str, list[str]] = {
        "stale": ["stale"],
        "all": [*results.WORDS],
        "latency": ["done", "stale"],
    }
    wanted = {"missing", "interrupted", "failed", "running", *again.get(rerun or "", [])}
    own = [cell for cell in cells if results.status(cell, runs) in wanted]
    return [cell for cell in with_parents(own) if results.status(cell, runs) in wanted]


def cell_command(cell: Cell, runs: Path, data: Path, options: Sequence[str] = ()) -> list[str]:
    """What runs a cell, here or in a terminal."""
    file = results.run_dir(cell, runs) / "cell.json"
    command = [sys.executable, "-m", "mtl_bench", "train", str(file)]
    return [*command, "--runs", str(runs), "--data", str(data), *options]


@dataclass
class Job(Running):
    process: subprocess.Popen[bytes] | None = None


@dataclass
class Launcher:
    """Runs cells in `jobs` processes at a time; `run` returns each one's state afterwards."""

    runs: Path
    command: Command
    display: Display
    jobs: int = 1
    rerun: str | None = None
    names: Mapping[str, str] = field(default_factory=dict)  # cell id -> what the grid calls it
    _running: list[Job] = field(default_factory=list)
    _unsettled: set[str] = field(default_factory=set)  # ids whose cells have not ended here yet
    _elsewhere: set[str] = field(default_factory=set)  # ids that another process was seen running
    _states: dict[str, results.State] = field(default_factory=dict)
    _began: float = field(default_factory=time.time)

    def run(self, cells: Sequence[Cell]) -> dict[str, results.State]:
        """Run all; on Ctrl-C the running ones are told to save and stop.

        A cell whose parent has no usable result in the end is not run: its state is `missing`.

        Raises:
            KeyboardInterrupt: after they have stopped.
        """
        queue: deque[Job] = deque()
        for number, cell in enumerate(cells, 1):
            directory, name = results.run_dir(cell, self.runs), self.names.get(cell.id, "")
            queue.append(Job(number, len(cells), cell, directory, name=name))
        self._unsettled = {cell.id for cell in cells}
        try:
            while queue or self._running:
                self._fill(queue)
                self._reap(queue)
                self.display.tick(self._running)
                time.sleep(POLL_S)
        except BaseException:
            self._stop()
            raise
        return self._states

    def _fill(self, queue: deque[Job]) -> None:
        """Start queued cells in free places; those that must wait keep their place in the queue."""
        waiting = []
        while queue and len(self._running) < self.jobs:
            job = queue.popleft()
            state = results.inspect(job.cell, self.runs)
            if state.word == "running":
                if job.cell.id not in self._elsewhere:
                    self.display.say(f"{job.label}  is run by another process")
                self._elsewhere.add(job.cell.id)
                waiting.append(job)
            elif self._settled_elsewhere(job, state):
                self._end(job, state, "by another process")
            elif self._must_wait(job):
                waiting.append(job)
            elif lack := self._lack(job):
                self._give_up(job, lack)
            else:
                self._start(job, state)
        queue.extendleft(reversed(waiting))

    def _must_wait(self, job: Job) -> bool:
        """Whether a parent is still to run, here or in another process."""
        return any(
            parent.id in self._unsettled or results.status(parent, self.runs) == "running"
            for parent in job.cell.parents
        )

    def _lack(self, job: Job) -> str:
        """What keeps a cell from ever running: a parent without a result that may be used."""
        for parent in job.cell.parents:
            state = results.inspect(parent, self.runs)
            if not state.trained:
                remedy = "; --rerun stale" if state.word == "stale" else ""
                why = f" ({state.why}{remedy})" if state.why else ""
                return f"needs {parent.slug}, which is {state.word}{why}"
        return ""

    def _give_up(self, job: Job, lack: str) -> None:
        self._unsettled.discard(job.cell.id)
        self._states[job.cell.id] = results.State("missing", lack)
        self.display.ended(job, f"{job.label}  NOT RUN  {lack}", False)

    def _settled_elsewhere(self, job: Job, state: results.State) -> bool:
        """Whether another process brought the cell to an end since this launcher began."""
        if job.cell.id in self._elsewhere:
            return state.word in ("done", "failed")
        row = job.directory / "row.json"
        return state.word == "done" and row.stat().st_mtime > self._began

    def _start(self, job: Job, state: results.State) -> None:
        timed = self.rerun == "latency" and state.row is not None
        if self.rerun == "all" or self.rerun == state.word == "failed":
            results.clear(job.directory)
        renewed = self.rerun == state.word == "stale"
        job.directory.mkdir(parents=True, exist_ok=True)
        for left_over in ("failed.json", "progress.json"):
            (job.directory / left_over).unlink(missing_ok=True)
        results.write_json(job.directory / "cell.json", to_dict(job.cell))
        job.began, job.progress = time.monotonic(), {}
        with (job.directory / "log.txt").open("ab") as log:
            job.process = subprocess.Popen(
                [*self.command(job.cell), *["--latency"] * timed, *["--stale"] * renewed],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=child_environment(self.jobs),
                start_new_session=True,  # Ctrl-C reaches it once, through `_stop`
            )
        self._running.append(job)
        self.display.started(job)

    def _reap(self, queue: deque[Job]) -> None:
        for job in list(self._running):
            assert job.process is not None
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
                job.see(json.loads((job.directory / "progress.json").read_text()))
            code = job.process.poll()
            if code is None:
                continue
            self._running.remove(job)
            if code == CLAIMED:  # another launcher was faster
                self._elsewhere.add(job.cell.id)
                queue.append(job)
            else:
                self._end(job, self._state_after(job, code))

    def _state_after(self, job: Job, code: int) -> results.State:
        """What a process left; one that died without a word gets its failure written for it."""
        if code in INTERRUPTED:
            return results.State("interrupted", f"stopped by a signal (exit code {code})")
        failure = job.directory / "failed.json"
        kept = (job.directory / "row.json").is_file()
        if (code or not kept) and not failure.is_file():
            log = (job.directory / "log.txt").read_text(errors="replace")
            results.write_failure(job.directory, explain_exit(code, log), log, code)
        if code and kept:  # of a row that was to be renewed
            return results.State("failed", str(results.read_json(failure)["error"]))
        return results.stored(job.cell, self.runs)

    def _end(self, job: Job, state: results.State, how: str = "") -> None:
        self._unsettled.discard(job.cell.id)
        self._states[job.cell.id] = state
        ok = state.word in ("done", "stale")
        word = state.word if ok else state.word.upper()
        about = state.headline if ok else f"{state.why}  log: {job.directory}/log.txt"
        words = [job.label, f"{word} {how}".strip(), duration(job.seconds), about]
        self.display.ended(job, "  ".join([*words, str(job.directory)] if ok else words), ok)

    def _stop(self) -> None:
        """Forward the interruption and wait; a second Ctrl-C or half a minute kills."""
        processes = [job.process for job in self._running if job.process is not None]
        for process in processes:
            process.send_signal(signal.SIGINT)
        if processes:
            self.display.say(f"stopping {len(processes)} running cells; they save their state")
        deadline = time.monotonic() + GRACE_S
        try:
            for process in processes:
                process.wait(max(0.0, deadline - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            for process in processes:
                process.kill()
                process.wait()


def child_environment(jobs: int) -> dict[str, str]:
    """Of a cell's process; processes side by side share the cores instead of fighting for them."""
    extra = {claim.LAUNCHER: str(os.getpid()), "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    if jobs > 1:
        extra["OMP_NUM_THREADS"] = str(max(1, cores() // jobs))
        extra[SIDE_BY_SIDE] = str(jobs)
    return {**os.environ, **extra}


def explain_exit(code: int, log: str) -> str:
    """One line for a process that ended without writing why."""
    if code == 0:
        return "ended without a row"
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    last = f": {lines[-1]}" if lines else ""
    if code < 0:
        name = signal.Signals(-code).name
        hint = (
            " (out of memory? try a smaller recipe.optim.batch)" if code == -signal.SIGKILL else ""
        )
        return f"killed by {name}{hint}{last}"
    return f"exit code {code}{last}"


def summary(cells: Sequence[Cell], runs: Path) -> str:
    """`done 3   failed 1`, and what to do about stale and failed ones."""
    states = [results.inspect(cell, runs) for cell in cells]
    reasons = "; ".join(sorted({state.why for state in states if state.word == "stale"}))
    hints = {"stale": f" ({reasons}; --rerun stale)", "failed": " (tried again by the next ablate)"}
    counts = {word: sum(state.word == word for state in states) for word in results.WORDS}
    return "   ".join(f"{word} {n}{hints.get(word, '')}" for word, n in counts.items() if n)


def hours_to_run(todo: Sequence[Cell], cells: Sequence[Cell], runs: Path) -> float | None:
    """Expected duration of cells, from the mean of those that are done; None where none is.

    Only cells that train count: a single-task cell's row repeats the times of its parents.
    """
    states = [results.inspect(cell, runs) for cell in cells if not cell.single_task]
    rows = [state.row for state in states if state.row is not None]
    times = [[v for k, v in row.get("time", {}).items() if k.endswith("_s")] for row in rows]
    known = [sum(values) for values in times if values]
    count = sum(not cell.single_task for cell in todo)
    return count * sum(known) / len(known) / 3600 if known else None
