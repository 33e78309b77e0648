"""Who works where: a claim on a folder, and quiet for the process that is being timed.

A claim is a file that says who runs a job, void once that process is dead. Quiet is a lock file in
runs/: whoever is timed holds it, every neighbour passes by it between two steps. The system
releases the lock of a process that dies.
"""

import contextlib
import hashlib
import json
import os
import platform
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TOUCH_S = 30.0  # how often a running process renews its claim
EXPIRES_S = 600.0  # age at which a claim is void
CLAIMED = 75  # exit code of a command that found its job claimed
LAUNCHER = "MTL_BENCH_LAUNCHER"  # process id of the launcher that started this process
POLL_S = 1.0
TIMING = ".timing"  # the lock file of what is timed
SIDE_BY_SIDE = "MTL_BENCH_SIDE_BY_SIDE"  # set for cells that a launcher runs at the same time
STEP_S = 1.0  # for a neighbour to finish the step that it is in


class ClaimedError(Exception):
    """Another process is running the job."""


def claimed_by(directory: Path) -> dict[str, Any] | None:
    """Who is running a job now: {"pid": ..., "machine": ...}; None where nobody is.

    A claim is void ten minutes after it was last renewed, or where it is of a time that has not
    come; on this machine, also as soon as its process is dead.
    """
    path = directory / "claim"
    try:
        age_s = abs(time.time() - path.stat().st_mtime)
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        owner: dict[str, Any] = json.loads(content)
        dead = owner["machine"] == _machine() and not _alive(owner["pid"])
    except (ValueError, TypeError, KeyError, OverflowError):  # being written now, or damaged
        return {} if age_s < TOUCH_S else None
    return None if dead or age_s > EXPIRES_S else owner


@contextlib.contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Hold a run directory, which is made where it is missing, while the block runs.

    Started by a launcher, the process also watches it: a launcher that was killed outright takes
    its cells with it, as an interruption, instead of leaving them to run unseen.

    Raises:
        ClaimedError: another process holds it.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "claim"
    _take(path)
    stop = threading.Event()
    thread = threading.Thread(target=_keep, args=(path, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        if _is_own(path):
            path.unlink()


def end_with_launcher() -> None:
    """From now on end, as if interrupted, when the launcher that started this process has gone."""

    def watch() -> None:
        while not _orphan():
            time.sleep(POLL_S)
        os.kill(os.getpid(), signal.SIGTERM)

    if LAUNCHER in os.environ:
        threading.Thread(target=watch, daemon=True).start()


def _orphan() -> bool:
    launcher = os.environ.get(LAUNCHER)
    return launcher is not None and os.getppid() != int(launcher)


def _take(path: Path) -> None:
    for _ in range(3):
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            _discard_void(path)
        else:
            with os.fdopen(descriptor, "w") as file:
                json.dump(_signature(), file)
            return
    raise ClaimedError(f"{path.parent} is being taken by another process")


def _discard_void(path: Path) -> None:
    """Remove a void claim, and only that one: another process may replace it at any instant."""
    with contextlib.suppress(FileNotFoundError):
        judged = path.stat()
        owner = claimed_by(path.parent)
        if owner is not None:
            raise ClaimedError(f"{path.parent} is being run by process {owner.get('pid', '?')}")
        aside = path.with_name(f"claim.{os.getpid()}")
        path.rename(aside)
        moved = aside.stat()
        if (moved.st_ino, moved.st_mtime_ns) != (judged.st_ino, judged.st_mtime_ns):
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)  # not the one judged: give it back
        aside.unlink()


def _keep(path: Path, stop: threading.Event) -> None:
    """Renew the claim; interrupt this process when its launcher has gone or its claim is lost."""
    renewed = time.monotonic()
    while not stop.wait(POLL_S):
        if _orphan() or not _is_own(path):
            os.kill(os.getpid(), signal.SIGTERM)
            return
        if time.monotonic() - renewed > TOUCH_S:
            renewed = time.monotonic()
            os.utime(path)


def _is_own(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_text()) == _signature())
    except (FileNotFoundError, ValueError):
        return False


def _signature() -> dict[str, Any]:
    return {"pid": os.getpid(), "machine": _machine()}


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    state = Path(f"/proc/{pid}/stat")  # killed, but its parent has not asked how it ended: Z
    return not (state.is_file() and state.read_text().rpartition(")")[2].split()[0] == "Z")


def _machine() -> str:
    """Tells machines apart without naming them."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


# --- quiet ----------------------------------------------------------------------------------------


class Quiet:
    """The lock of a runs folder, which exists: what runs side by side in it can hold still."""

    def __init__(self, runs: Path):
        from filelock import FileLock  # takes longer to import than `--help` may take

        self._lock = FileLock(runs / TIMING)

    def pass_by(self) -> None:
        """Wait while another process is timed."""
        with self._lock.acquire(poll_interval=0.02):
            pass

    @contextlib.contextmanager
    def alone(self, neighbours: bool) -> Iterator[None]:
        """Hold others back inside; `neighbours`: there may be some, in the middle of a step."""
        with self._lock.acquire(poll_interval=0.02):
            time.sleep(STEP_S if neighbours else 0)
            yield
