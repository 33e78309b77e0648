"""Processes of this program that need not import torch: forked from one that has.

A cell of the small problems trains for some seconds, and importing takes as many. Every cell still
has a process of its own. What was imported is the code as it was when the first one started; after
a change to the package's files none is forked any more.
"""

import functools
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path

PROGRAM = (sys.executable, "-m", "mtl_bench")
MODULES = ("mtl_bench.cli.app", "mtl_bench.bench.run", "mtl_bench.bench.warmed")
PACKAGE = Path(__file__).resolve().parents[1]


class Forked:
    """A command of this program, with as much of `subprocess.Popen` as the launcher uses.

    Args:
        words: behind the program's name.
        log: gets its output, at the end.
        environment: of the process.
    """

    def __init__(self, words: Sequence[str], log: Path, environment: Mapping[str, str]) -> None:
        given = (list(words), str(log.resolve()), dict(environment))
        self._process = _context().Process(target=_run, args=given)
        own = dict(os.environ)
        os.environ.update(environment)  # the process that is forked from starts with the first
        try:
            self._process.start()
        finally:
            os.environ.clear()
            os.environ.update(own)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired(PROGRAM, timeout or 0)
        return code


def can_fork(command: Sequence[str]) -> bool:
    """Whether a command is this program's, and its code still what a fork would run."""
    own = sys.platform == "linux" and tuple(command[: len(PROGRAM)]) == PROGRAM
    return own and _started() == _stamp()


@functools.cache
def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(MODULES))
    return context


@functools.cache
def _started() -> tuple[int, int]:
    return _stamp()


def _stamp() -> tuple[int, int]:
    """Number of the package's files, and when the newest was written."""
    times = [path.stat().st_mtime_ns for path in PACKAGE.rglob("*.py")]
    return len(times), max(times)


def _run(words: list[str], log: str, environment: dict[str, str]) -> None:
    """As a process that was started anew: its own session, output, environment and arguments."""
    os.setsid()
    with Path(log).open("ab") as file, Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
        for number in (1, 2):
            os.dup2(file.fileno(), number)
    os.environ.clear()
    os.environ.update(environment)
    # What this was forked from lives as long as somebody holds this end: the launcher alone is to.
    os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore[attr-defined]
    sys.argv = ["mtl-bench", *words]
    runpy.run_module("mtl_bench", run_name="__main__", alter_sys=True)
