"""What a running cell tells the outside: one small JSON file, and a signal asking it to stop."""

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from mtl_bench.core.quiet import Quiet


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop, saved its state and stopped."""


class Progress:
    """Writes `progress.json`, at most every `every_s` seconds; knows whether a signal came."""

    def __init__(self, run_dir: Path, echo: Callable[[str], None], every_s: float = 1.0):
        self._path = run_dir / "progress.json"
        self._every_s = every_s
        self._echo = echo
        self._last = 0.0
        self._start = time.monotonic()
        self.quiet = Quiet(run_dir.parent)
        self.stop_asked = False

    def catch_signals(self) -> None:
        """Turn the first SIGINT or SIGTERM into a request; a second one kills as usual."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask_to_stop)

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self.stop_asked = True
        signal.signal(number, signal.SIG_DFL)

    def say(self, line: str) -> None:
        self._echo(line)

    def update(self, stage: str, step: int, steps: int, note: str = "") -> None:
        """After every step of a stage; waits here while another cell is timed."""
        self.quiet.pass_by()
        now = time.monotonic()
        if now - self._last < self._every_s and step < steps:
            return
        self._last = now
        state = {"stage": stage, "step": step, "steps": steps, "note": note}
        state["seconds"] = round(now - self._start, 1)
        temporary = self._path.with_name(self._path.name + ".tmp")
        temporary.write_text(json.dumps(state))
        temporary.replace(self._path)
