"""Where the processes of jobs run: on this machine (`Processes`), or in a queue (`slurm.Slurm`)."""

import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from mtl_bench.bench.preloaded import PROGRAM, Forked, can_fork

GRACE_S = 30.0  # for a cell to save its state after Ctrl-C


@dataclass(frozen=True)
class Task:
    """A job's process.

    Args:
        log: gets its output, at the end.
        after: ids of the jobs that are to be done before it starts.
        environment: in place of this process's; None: that one.
        fork: whether it may be forked from a process that has imported torch.
    """

    id: str
    command: Sequence[str]
    log: Path
    after: tuple[str, ...] = ()
    environment: Mapping[str, str] | None = None
    fork: bool = False


@dataclass(frozen=True)
class Status:
    word: Literal["queued", "running", "ended"]
    code: int | None = None  # of an ended one, where it is known
    about: str = ""  # what the executor itself says


class Executor(Protocol):
    def submit(self, tasks: Sequence[Task]) -> None:
        """Start them, or queue them to be started; parents come before their children."""

    def states(self) -> Mapping[str, Status]:
        """By id, of all that were submitted and are not forgotten since."""

    def cancel(self) -> None:
        """Tell all of this executor's own to save and stop."""


@dataclass
class Processes(Executor):
    """Processes of this machine, started at once. It tells the end of each once, and forgets it."""

    _running: dict[str, "subprocess.Popen[bytes] | Forked"] = field(default_factory=dict)

    def submit(self, tasks: Sequence[Task]) -> None:
        for task in tasks:
            if task.fork and can_fork(task.command):
                words = task.command[len(PROGRAM) :]
                self._running[task.id] = Forked(words, task.log, task.environment or {})
                continue
            with task.log.open("ab") as log:
                self._running[task.id] = subprocess.Popen(
                    task.command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=task.environment,
                    start_new_session=True,  # Ctrl-C reaches it once, through `cancel`
                )

    def states(self) -> dict[str, Status]:
        codes = {name: process.poll() for name, process in self._running.items()}
        for name, code in codes.items():
            if code is not None:
                del self._running[name]
        return {
            name: Status("running" if code is None else "ended", code)
            for name, code in codes.items()
        }

    def cancel(self) -> None:
        """Interrupt all and wait; a second Ctrl-C or half a minute kills."""
        processes = list(self._running.values())
        for process in processes:
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + GRACE_S
        try:
            for process in processes:
                process.wait(max(0.0, deadline - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            for process in processes:
                process.kill()
                process.wait()
