"""Runs jobs, each in a process of its own: GPU memory is freed, and a crash costs one job.
Those of cells are forked from one that has imported torch, where that is possible.

The command of a cell is always `python -m mtl_bench train runs/X/cell.json ...`, that of a timing
`python -m mtl_bench latency ...`, here as in a terminal. State is what lies in runs/: a launcher
that was killed is simply started again. Two launchers share the cells of a grid, and a cell that
needs others waits until they are done. Timings are taken one at a time by one launcher, and cells
that train in the same runs folder hold still meanwhile. `run_here` runs one cell in this process.
"""

import contextlib
import json
import math
import os
import signal
import time
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.executors import Processes, Task
from mtl_bench.bench.jobs import Job, Timing, kind_of, with_parents
from mtl_bench.bench.jobs import lack as lack_of
from mtl_bench.bench.store import State
from mtl_bench.core import locks
from mtl_bench.core.config import Cell
from mtl_bench.core.files import read_json, write_json
from mtl_bench.core.plain import to_dict
from mtl_bench.core.provenance import cores
from mtl_bench.core.ranks import ALONE, Ranks

INTERRUPTED = (130, -signal.SIGINT, -signal.SIGTERM)  # exit codes of a job that was told to stop
POLL_S = 0.2
ORDERED = "MTL_BENCH_ORDERED"  # set by who starts a cell only when what it needs is done

CellCommand = Callable[[Cell], Sequence[str]]
TimingCommand = Callable[[Timing, Path], Sequence[str]]  # a timing, and the file for its row


class Display(Protocol):
    """What the launcher tells; `with` begins and ends the showing."""

    def __enter__(self) -> "Display": ...
    def __exit__(self, *error: object) -> None: ...
    def say(self, line: str) -> None: ...
    def started(self, run: "Run") -> None: ...
    def tick(self, runs: Sequence["Run"]) -> None: ...
    def ended(self, run: "Run", line: str, ok: bool) -> None: ...


@dataclass
class Run(ABC):
    """A job on its way: in the queue, then in a process."""

    number: int  # of total, from 1
    total: int
    job: Any
    runs: Path
    name: str = ""  # the grid's, where it has names
    began: float = field(default_factory=time.monotonic)
    progress: Mapping[str, Any] = field(default_factory=dict)  # of its `progress.json`
    gpu: str | None = None  # that it has, as CUDA_VISIBLE_DEVICES names it
    _stage: tuple[str, int, float] = ("", 0, 0.0)  # name, first step seen, when

    @property
    def label(self) -> str:
        name = f" ({self.name})" if self.name else ""
        return f"[{self.number}/{self.total}] {self.job.label}{name}"

    @property
    def place(self) -> str:
        """Where its files are, for a reader."""
        return ""

    @property
    def log(self) -> Path:
        return kind_of(self.job).log_file(self.job, self.runs)

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

    @abstractmethod
    def settled(self, state: State) -> State | None:
        """What it has come to without a process, for a reason that needs none; None: start one."""

    @abstractmethod
    def prepare(self, state: State, rerun: str | None) -> Sequence[str]:
        """Make its place ready; the command to run."""

    @abstractmethod
    def ended(self, code: int) -> State:
        """What its process left, by its exit code."""

    def release(self) -> None:  # noqa: B027
        """Let go of what `prepare` took."""


@dataclass
class CellRun(Run):
    command: CellCommand = field(kw_only=True)
    data: Data | None = None

    @property
    def directory(self) -> Path:
        return store.run_dir(self.job, self.runs)

    @property
    def place(self) -> str:
        return str(self.directory)

    def settled(self, state: State) -> State | None:
        """A parent without a result that may be used keeps a cell from ever running."""
        for parent in self.job.parents:
            found = store.inspect(parent, self.runs, self.data)
            if not found.trained:
                remedy = "; --rerun stale" if found.word == "stale" else ""
                why = f" ({found.why}{remedy})" if found.why else ""
                return State("missing", f"needs {parent.slug}, which is {found.word}{why}")
        return None

    def prepare(self, state: State, rerun: str | None) -> Sequence[str]:
        timed = rerun == "latency" and state.row is not None
        if rerun == "all" or rerun == state.word == "failed":
            store.clear(self.directory)
        renewed = rerun == state.word == "stale"
        self.directory.mkdir(parents=True, exist_ok=True)
        locks.free(self.directory)  # which the cell's process would have to watch again
        for left_over in ("failed.json", "progress.json"):
            (self.directory / left_over).unlink(missing_ok=True)
        write_json(self.directory / "cell.json", to_dict(self.job))
        return [*self.command(self.job), *["--latency"] * timed, *["--stale"] * renewed]

    def ended(self, code: int) -> State:
        """One that died without a word gets its failure written for it."""
        if code in INTERRUPTED:
            return State("interrupted", f"stopped by a signal (exit code {code})")
        failure = self.directory / "failed.json"
        kept = (self.directory / "row.json").is_file()
        if (code or not kept) and not failure.is_file():
            log = self.log.read_text(errors="replace")
            store.write_failure(self.directory, explain_exit(code, log), log, code)
        if code and kept:  # of a row that was to be renewed
            return State("failed", str((read_json(failure) or {}).get("error")))
        return store.stored(self.job, self.runs, self.data)


@dataclass
class TimingRun(Run):
    """Whatever becomes of it, it leaves a row; an interrupted one leaves none."""

    command: TimingCommand = field(kw_only=True)
    lack: Callable[[Timing], str | None] = field(kw_only=True)
    smoke: bool = field(kw_only=True)
    _code: Any = None
    _quiet: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    @property
    def text(self) -> str:
        return ""

    @property
    def written(self) -> Path:
        return self.runs / f"{self.job.slug}.new"

    def settled(self, state: State) -> State | None:
        self._code = kind_of(self.job).code(self.job)
        self.began = time.monotonic()
        why = self.lack(self.job)
        return None if why is None else self._keep({"status": "unavailable", "why": why})

    def prepare(self, state: State, rerun: str | None) -> Sequence[str]:
        self.written.unlink(missing_ok=True)
        self.log.unlink(missing_ok=True)
        claims = (path.parent for path in self.runs.glob("*/claim"))
        training = [path for path in claims if path != self.written.parent]
        owners = filter(None, map(locks.claimed_by, training))
        neighbours = any(locks.is_here(owner) for owner in owners)
        self._quiet.enter_context(locks.Quiet(self.runs).alone(neighbours))
        return self.command(self.job, self.written)

    def ended(self, code: int) -> State:
        if code in INTERRUPTED:
            raise KeyboardInterrupt(f"{self.job.label} was told to stop")
        row = read_json(self.written)
        self.written.unlink(missing_ok=True)
        if row is None:
            log = self.log.read_text(errors="replace")
            row = {"status": "failed", "why": explain_exit(code, log)}
        return self._keep(row)

    def _keep(self, row: dict[str, Any]) -> State:
        kind = kind_of(self.job)
        own = {"smoke": self.smoke, "code": self._code, "seconds": self.seconds}
        file = kind.row_file(self.job, self.runs)
        write_json(file, {**kind.identity(self.job), **row, "timing": to_dict(self.job), **own})
        return store.stored(self.job, self.runs)

    def release(self) -> None:
        self._quiet.close()


@dataclass
class Launcher:
    """Runs jobs in `jobs` processes at a time; `run` returns each one's state afterwards.

    Args:
        rerun: as in `store.to_run`.
        names: id -> what the grid calls it.
        lack: why a timing cannot be taken on this machine; then no process is started for it.
        smoke: stands in the rows of timings.
        data: those that cells run on.
        gpus: that cells are spread over, see `gpu_pool`: one each, and several on one only where
            there are more `jobs`. Empty: the processes see what this one sees.
        ranks: that each cell starts, which is part of the command.
    """

    runs: Path
    command: Callable[..., Sequence[str]]  # CellCommand | TimingCommand
    display: Display
    jobs: int = 1
    rerun: str | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    lack: Callable[[Timing], str | None] = lack_of
    smoke: bool = False
    data: Data | None = None
    gpus: Sequence[str] = ()
    ranks: int = 1
    _processes: Processes = field(default_factory=Processes)
    _running: list[Run] = field(default_factory=list)
    _unsettled: set[str] = field(default_factory=set)  # ids whose jobs have not ended here yet
    _elsewhere: set[str] = field(default_factory=set)  # ids that another process was seen running
    _remote: dict[str, float] = field(default_factory=dict)  # that of them on a machine, when last
    _rows: dict[str, int] = field(default_factory=dict)  # of jobs that had one before: its time
    _states: dict[str, State] = field(default_factory=dict)

    def run(self, todo: Sequence[Job]) -> dict[str, State]:
        """Run all; on Ctrl-C the running ones are told to save and stop.

        A cell whose parent has no usable result in the end is not run: its state is `missing`.

        Raises:
            ClaimedError: another launcher takes timings in this runs folder.
            KeyboardInterrupt: after they have stopped; a timing has no row then.
        """
        queue = deque(self._queued(job, n, len(todo)) for n, job in enumerate(todo, 1))
        self._unsettled = {job.id for job in todo}
        self._rows = {job.id: self._row_time(job) for job in todo}
        timed = any(isinstance(job, Timing) for job in todo)
        with locks.claim(self.runs / "latency") if timed else contextlib.nullcontext():
            try:
                while queue or self._running:
                    self._fill(queue)
                    self._reap(queue)
                    self.display.tick(self._running)
                    if self._running or queue:
                        time.sleep(POLL_S)
            except BaseException:
                self._stop()
                raise
        return self._states

    def _queued(self, job: Job, number: int, total: int) -> Run:
        given = (number, total, job, self.runs, self.names.get(job.id, ""))
        if isinstance(job, Timing):
            return TimingRun(*given, command=self.command, lack=self.lack, smoke=self.smoke)
        return CellRun(*given, command=self.command, data=self.data)

    def _fill(self, queue: deque[Run]) -> None:
        """Start queued jobs in free places; those that must wait keep their place in the queue."""
        waiting = []
        while queue and len(self._running) < self.jobs:
            run = queue.popleft()
            state = store.inspect(run.job, self.runs, self.data)
            if state.word == "running":
                if run.job.id not in self._elsewhere:
                    self.display.say(f"{run.label}  is run by another process")
                self._elsewhere.add(run.job.id)
                if state.why == store.ELSEWHERE:
                    self._remote[run.job.id] = time.monotonic()
                waiting.append(run)
            elif self._settled_elsewhere(run, state):
                self._end(run, state, "by another process")
            elif self._must_wait(run) or self._not_shown_yet(run, state):
                waiting.append(run)
            else:
                self._start(run, state)
        queue.extendleft(reversed(waiting))

    def _must_wait(self, run: Run) -> bool:
        """Whether a parent is still to run, here or in another process."""
        return any(
            parent.id in self._unsettled or store.status(parent, self.runs) == "running"
            for parent in run.job.parents
        )

    def _settled_elsewhere(self, run: Run, state: State) -> bool:
        """Whether another process brought the job to an end since this launcher began."""
        if run.job.id in self._elsewhere:
            return state.word in ("done", "failed")
        return state.word == "done" and self._row_time(run.job) != self._rows[run.job.id]

    def _not_shown_yet(self, run: Run, state: State) -> bool:
        """Whether another machine, which has let go of the job, may have left a row that a shared
        folder's cache does not show yet."""
        let_go = not (store.run_dir(run.job, self.runs) / "claim").exists()
        recently = time.monotonic() - self._remote.get(run.job.id, -math.inf) < store.SHOWN_S
        return recently and let_go and state.word in ("missing", "interrupted")

    def _row_time(self, job: Job) -> int:
        row = kind_of(job).row_file(job, self.runs)
        return row.stat().st_mtime_ns if row.is_file() else 0

    def _start(self, run: Run, state: State) -> None:
        run.began, run.progress = time.monotonic(), {}
        settled = run.settled(state)
        if settled is not None:
            self._end(run, settled)
            return
        command = run.prepare(state, self.rerun)
        if self.gpus:
            taken = [each.gpu for each in self._running]
            run.gpu = min(self.gpus, key=taken.count)
        self._running.append(run)
        environment = child_environment(self.jobs, run.gpu, self.ranks)
        task = Task(
            run.job.id, command, run.log, environment=environment, fork=isinstance(run, CellRun)
        )
        self._processes.submit([task])
        self.display.started(run)

    def _reap(self, queue: deque[Run]) -> None:
        states = self._processes.states()
        for run in list(self._running):
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
                run.see(json.loads((run.log.parent / "progress.json").read_text()))
            code = states[run.job.id].code
            if code is None:
                continue
            self._running.remove(run)
            run.release()
            if code == locks.CLAIMED:  # another launcher was faster
                self._elsewhere.add(run.job.id)
                queue.append(run)
            else:
                self._end(run, run.ended(code))

    def _end(self, run: Run, state: State, how: str = "") -> None:
        self._unsettled.discard(run.job.id)
        self._states[run.job.id] = state
        ok = state.word in kind_of(run.job).good
        if state.word == "missing":
            self.display.ended(run, f"{run.label}  NOT RUN  {state.why}", ok)
            return
        about = [state.headline or state.why, run.place]
        if not ok:
            about = [state.why, f"log: {run.log}"]
        word = state.word if ok else state.word.upper()
        words = [run.label, f"{word} {how}".strip(), duration(run.seconds), *filter(None, about)]
        self.display.ended(run, "  ".join(words), ok)

    def _stop(self) -> None:
        """Forward the interruption and wait."""
        saving = sum(not isinstance(run.job, Timing) for run in self._running)
        if saving:
            self.display.say(f"stopping {saving} running cells; they save their state")
        self._processes.cancel()
        for run in self._running:
            run.release()


def queued_tasks(
    todo: Sequence[Cell], runs: Path, command: CellCommand, rerun: str | None, data: Data | None
) -> list[Task]:
    """What a queue is given for cells that nobody runs, each with its place made ready."""
    tasks = []
    for cell in todo:
        run = CellRun(1, 1, cell, runs, command=command, data=data)
        words = run.prepare(store.inspect(cell, runs, data), rerun)
        after = tuple(parent.id for parent in cell.parents)
        tasks.append(Task(cell.id, words, run.log, after))
    return tasks


def gpu_pool(visible: str | None, count: int) -> tuple[str, ...]:
    """The GPUs that this process sees, as CUDA_VISIBLE_DEVICES would name each.

    Args:
        visible: CUDA_VISIBLE_DEVICES; None: not set, and all are seen.
        count: how many are seen. CUDA ends at the first name that it does not know.
    """
    names = map(str, range(count)) if visible is None else map(str.strip, visible.split(","))
    return tuple(names)[:count]


def together(pool: Sequence[str], each: int) -> tuple[str, ...]:
    """So many GPUs for each cell, as CUDA_VISIBLE_DEVICES names them; the rest is not used.

    Raises:
        ValueError: there are GPUs, but fewer.
    """
    if len(pool) < each and pool:
        raise ValueError(f"--gpus-per-cell {each}, but this process sees {len(pool)} GPUs")
    return tuple(",".join(gpus) for gpus in zip(*[iter(pool)] * each, strict=False))


def child_environment(jobs: int, gpu: str | None = None, ranks: int = 1) -> dict[str, str]:
    """Of a job's process; processes side by side share the cores instead of fighting for them.

    It is no rank of a cell of its own, even where this process is one of several.
    """
    extra = {locks.LAUNCHER: json.dumps(locks.process()), ORDERED: "1", "WORLD_SIZE": "1"}
    extra |= {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}
    if jobs > 1:
        extra["OMP_NUM_THREADS"] = str(max(1, cores() // (jobs * ranks)))
        extra[locks.SIDE_BY_SIDE] = str(jobs)
    if gpu is not None:
        extra["CUDA_VISIBLE_DEVICES"] = gpu
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


def duration(seconds: float) -> str:
    """3h02, 4m10, 12s"""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600}h{whole % 3600 // 60:02}"
    return f"{whole // 60}m{whole % 60:02}" if whole >= 60 else f"{whole}s"


# --- one cell, in this process --------------------------------------------------------------------


@dataclass(frozen=True)
class Here:
    """Runs cells in this process.

    Args:
        root: the data set.
        echo: where lines of text go.
        data: what cells are compared with; those in the root that need not be rendered for that.
        ranks: that train each cell together; this process is their first.
    """

    runs: Path
    root: Path
    device: str
    wandb: str
    echo: Callable[[str], None]
    data: Data
    ranks: Ranks = ALONE

    def run(self, cell: Cell, rerun: bool = False, stale: bool = False) -> None:
        """Run what is left of a cell, after the cells that it needs.

        Args:
            rerun: from step 0, whatever there is.
            stale: of a row whose code changed, only what that concerns.

        Raises:
            ValueError: a cell that it needs is stale.
            ClaimedError: another process runs one of them.
        """
        for parent in with_parents(cell.parents):
            assert isinstance(parent, Cell)
            look = store.inspect_done if ORDERED in os.environ else store.inspect
            state = look(parent, self.runs, store.data_for(parent, cell, self.data))
            if state.word == "stale" and not state.trained:
                again = f"mtl-bench train {store.run_dir(parent, self.runs)}/cell.json --stale"
                raise ValueError(f"a cell that this one needs is stale, {state.why}: {again}")
            if not state.trained:
                self.echo(f"{cell.label} needs {parent.label} first")
                self._run(parent, rerun=False, stale=False)
        self._run(cell, rerun, stale)

    def _run(self, cell: Cell, rerun: bool, stale: bool) -> None:
        directory = store.run_dir(cell, self.runs)
        if (owner := locks.claimed_by(directory)) and not locks.is_here(owner):
            self.echo(f"{directory} is claimed {store.ELSEWHERE}: watching whether that one lives")
        with locks.claim(directory):
            if rerun:
                store.clear(directory)
            elif line := store.done_already(cell, self.runs, stale, self.data):
                self.echo(line)  # meanwhile, by another
                return
            renewed = stale and store.can_renew(cell, self.runs, self.data)
            with _recorded(directory):
                if not renewed:
                    self._begin(cell, rerun)
                from mtl_bench.bench.run import renew, run_cell

                if renewed:
                    renew(cell, directory, self.root, self.device, self.echo)
                else:
                    given = (self.root, self.device, self.wandb, self.echo, self.ranks)
                    run_cell(cell, directory, *given)
        self.echo(f"{directory}/row.json")

    def _begin(self, cell: Cell, rerun: bool) -> None:
        state = store.stored(cell, self.runs, self.data)
        if state.row is None and (store.run_dir(cell, self.runs) / "row.json").is_file():
            self.echo(f"its row is made anew: {state.why}")
        if state.word == "stale":
            self.echo(store.set_aside(store.run_dir(cell, self.runs), state.why))
        if line := store.begin(cell, self.runs, self.data)[1]:
            self.echo(line)
        from mtl_bench.bench.reuse import adopt

        if not rerun and (line := adopt(cell, self.runs, self.data)):
            self.echo(line)


@contextlib.contextmanager
def _recorded(directory: Path) -> Iterator[None]:
    """Whatever ends a run early other than an interruption is left in `failed.json`."""
    (directory / "failed.json").unlink(missing_ok=True)
    try:
        yield
    except (Exception, SystemExit) as error:  # the latter a plug-in's
        line = " ".join(f"{type(error).__name__}: {error}".split())
        store.write_failure(directory, line, traceback.format_exc())
        raise
