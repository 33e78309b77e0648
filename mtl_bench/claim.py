"""One process at a time runs a cell: a file that says who, and is known to be void when they died."""

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
EXPIRES_S = 600.0  # age at which a claim from another machine is void
LAUNCHER = "MTL_BENCH_LAUNCHER"  # process id of the launcher that started this process
POLL_S = 1.0


class ClaimedError(Exception):
    """Another process is running the cell."""


def claimed_by(directory: Path) -> dict[str, Any] | None:
    """Who is running a cell now: {"pid": ..., "machine": ...}; None where nobody is.

    A claim of this machine counts as long as its process lives, one of another machine for ten
    minutes after it was last renewed.
    """
    path = directory / "claim"
    try:
        owner = json.loads(path.read_text())
        age_s = time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return None
    except ValueError:  # being written at this moment, or left half-written by a crash
        return {} if time.time() - path.stat().st_mtime < TOUCH_S else None
    if owner["machine"] == _machine():
        return owner if _alive(owner["pid"]) else None
    return owner if age_s < EXPIRES_S else None


@contextlib.contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Hold a cell while the block runs.

    Started by a launcher, the process also watches it: a launcher that was killed outright takes
    its cells with it, as an interruption, instead of leaving them to run unseen.

    Raises:
        ClaimedError: another process holds it.
    """
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
        path.unlink(missing_ok=True)


def _take(path: Path) -> None:
    for _ in range(3):
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            owner = claimed_by(path.parent)
            if owner is not None:
                raise ClaimedError(
                    f"{path.parent} is being run by process {owner.get('pid', '?')}"
                ) from None
            _discard(path)
        else:
            with os.fdopen(descriptor, "w") as file:
                json.dump({"pid": os.getpid(), "machine": _machine()}, file)
            return
    raise ClaimedError(f"{path.parent} is being taken by another process")


def _discard(path: Path) -> None:
    """Remove a void claim; if another process replaced it in this instant, give it back."""
    aside = path.with_name(f"claim.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        path.rename(aside)
        fresh = json.loads(aside.read_text() or "{}").get("pid")
        if fresh is not None and _alive(fresh) and claimed_by_file(aside):
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)
        aside.unlink()
