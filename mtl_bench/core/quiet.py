"""Cells side by side hold still while one of them is timed.

A lock file in runs/: the cell that is timed holds it, every other one passes by it between two
steps. The system releases the lock of a process that dies. Where there is no `flock` (Windows),
nobody waits.
"""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FILE = ".timing"
SIDE_BY_SIDE = "MTL_BENCH_SIDE_BY_SIDE"  # set for cells that a launcher runs at the same time
STEP_S = 1.0  # for a neighbour to finish the step that it is in


class Quiet:
    """The lock of a runs folder, which exists.

    Args:
        runs: folder that holds the run directories of cells that may run side by side.
    """

    def __init__(self, runs: Path):
        self._file = (runs / FILE).open("ab")

    def pass_by(self) -> None:
        """Wait while another process is timed."""
        if fcntl is not None:
            fcntl.flock(self._file, fcntl.LOCK_SH)
            fcntl.flock(self._file, fcntl.LOCK_UN)

    @contextlib.contextmanager
    def alone(self, neighbours: bool) -> Iterator[None]:
        """Hold others back inside; `neighbours`: there may be some, in the middle of a step."""
        if fcntl is None:
            yield
            return
        fcntl.flock(self._file, fcntl.LOCK_EX)
        try:
            time.sleep(STEP_S if neighbours else 0)
            yield
        finally:
            fcntl.flock(self._file, fcntl.LOCK_UN)
