"""What a running cell tells the outside: one small JSON file, and a signal asking it to stop."""

import json
import os
import signal
import statistics
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from mtl_bench.core.files import replacing
from mtl_bench.core.locks import STEP_S, Quiet
from mtl_bench.core.provenance import cores

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)  # the last: a queue's time limit is near
WINDOW = 20  # steps whose median is their pace
SLOW = 2.0  # times the first window's pace, of which the log tells


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop, saved its state and stopped."""


class Progress:
    """Writes `progress.json`, at most every `every_s` seconds; knows whether a signal came."""

    def __init__(self, run_dir: Path, echo: Callable[[str], None], every_s: float = 1.0):
        self._path = run_dir / "progress.json"
        self._every_s = every_s
        self._echo = echo
        self._last = self._passed = 0.0
        self._start = time.monotonic()
        self.quiet = Quiet(run_dir.parent)
        self.stop_asked = False

    def catch_signals(self) -> None:
        """Turn a signal into a request. A second SIGINT kills as usual; of the others a queue may
        send several."""
        for number in STOPPING:
            signal.signal(number, self._ask_to_stop)

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self.stop_asked = True
        if number == signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)

    def say(self, line: str) -> None:
        self._echo(line)

    def update(self, stage: str, step: int, steps: int, note: str = "") -> None:
        """After every step of a stage; waits here while another cell is timed."""
        now = time.monotonic()
        if now - self._passed >= STEP_S / 4:  # the lock takes longer than a small step's losses
            self.quiet.pass_by()
            now = self._passed = time.monotonic()
        if now - self._last < self._every_s and step < steps:
            return
        self._last = now
        state = {"stage": stage, "step": step, "steps": steps, "note": note}
        state["seconds"] = round(now - self._start, 1)
        with replacing(self._path, synced=False) as file:
            file.write(json.dumps(state).encode())


class Listening(Progress):
    """Of a rank behind the first: it writes and says nothing, and knows whether a signal came."""

    def say(self, line: str) -> None:
        """Rank 0 says it."""

    def update(self, stage: str, step: int, steps: int, note: str = "") -> None:
        """Rank 0 writes it."""


class Pace:
    """Notices, once, that steps take far longer than the first ones, and tells why."""

    def __init__(self) -> None:
        self._first: list[float] = []
        self._recent: deque[tuple[float, float]] = deque(maxlen=WINDOW)
        self._told = False

    def note(self, step_ms: float, data_ms: float) -> str | None:
        """One line when the last steps' median is SLOW times that of the first ones."""
        if len(self._first) < WINDOW:
            self._first.append(step_ms)
            return None
        self._recent.append((step_ms, data_ms))
        if self._told or len(self._recent) < WINDOW:
            return None
        first = statistics.median(self._first)
        now = statistics.median(step for step, _ in self._recent)
        if now < SLOW * first:
            return None
        self._told = True
        waits = statistics.median(data / step for step, data in self._recent)
        load = os.getloadavg()[0]
        if waits > 0.5:
            why = f"{100 * waits:.0f} % of it waits for data: raise recipe.data.workers"
        elif load > cores() + 0.5:
            why = f"other work shares the cores (load {load:.1f} on {cores()})"
        else:
            why = "the processor may have been slowed down"
        return f"steps take {now / first:.1f} times as long as the first ones: {why}"
