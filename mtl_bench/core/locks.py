"""Who works where: a claim on a folder, and quiet for the process that is being timed.

A claim is a file that says who runs a job. On its own machine it is void once that process is dead.
Of another machine's process only this can be seen: it changes its claim all the time. A claim that
stayed as it was while one watched is void, by the watcher's own stopwatch, so no two clocks are
compared and no host names. (`filelock.SoftFileLease` watches alike, but takes a killed process that
nobody waited for as alive, and two machines of one name as one, which steals live claims.)

Quiet is a lock of this machine: whoever is timed holds it, every neighbour passes by it between two
steps. The system releases the lock of a process that dies.
"""

import contextlib
import functools
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

BEAT_S = 15.0  # how often a running process changes its claim
LEASE_S = 90.0  # watched so long without a change, another machine's claim is void
WRITING_S = 2.0  # the same of one that is being written now, or is damaged
CLAIMED = 75  # exit code of a command that found its job claimed
LAUNCHER = "MTL_BENCH_LAUNCHER"  # the process of the launcher that this one works for
POLL_S = 1.0
SIDE_BY_SIDE = "MTL_BENCH_SIDE_BY_SIDE"  # set for cells that a launcher runs at the same time
STEP_S = 1.0  # for a neighbour to finish the step that it is in

_watched: dict[Path, tuple[tuple[bytes, int], float]] = {}  # claim -> as it is, and since when


class ClaimedError(Exception):
    """Another process is running the job."""


def process(pid: int | None = None) -> dict[str, Any]:
    """What tells a process of this machine (None: this one) from any other anywhere."""
    pid = pid or os.getpid()
    return {"pid": pid, "machine": _machine(), "began": _state(pid)[1]}


def claimed_by(directory: Path) -> dict[str, Any] | None:
    """Who is running a job now, as `process` says it; None where nobody is.

    A claim of another machine counts until this process has seen it unchanged for LEASE_S, at looks
    before this one.
    """
    path = directory / "claim"
    try:
        with path.open("rb") as file:  # of a shared folder, opening asks the server
            seen = file.read(), os.fstat(file.fileno()).st_mtime_ns
    except FileNotFoundError:
        _watched.pop(path, None)
        return None
    before, since = _watched.get(path, (None, 0.0))
    if seen != before:
        since = time.monotonic()
        _watched[path] = seen, since
    unchanged_s = time.monotonic() - since
    try:
        owner: dict[str, Any] = json.loads(seen[0])
        void = _gone(owner) if is_here(owner) else unchanged_s > LEASE_S
    except (ValueError, TypeError, KeyError, OverflowError):
        owner, void = {}, unchanged_s > WRITING_S
    return None if void else owner


def is_here(owner: dict[str, Any]) -> bool:
    """Whether a process is one of this machine."""
    return bool(owner["machine"] == _machine())


@contextlib.contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Hold a run directory, which is made where it is missing, while the block runs.

    Another machine's claim is watched first, for BEAT_S if its process lives and LEASE_S if not.
    Started by a launcher, the process also watches it: a launcher that was killed outright takes
    its cells with it, as an interruption, instead of leaving them to run unseen.

    Raises:
        ClaimedError: another process holds it.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "claim"
    own = {**process(), "token": os.urandom(8).hex()}
    descriptor = _take(path, own)
    stop = threading.Event()
    thread = threading.Thread(target=_keep, args=(path, descriptor, own, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        os.close(descriptor)
        if _is_own(path, own):
            path.unlink()


def free(directory: Path) -> None:
    """Remove a void claim, and only that one: another process may replace it at any instant."""
    path = directory / "claim"
    if claimed_by(directory) is not None or path not in _watched:
        return
    judged = _watched[path][0][0]
    aside = path.with_name(f"claim.{os.urandom(4).hex()}")
    with contextlib.suppress(FileNotFoundError):
        path.rename(aside)
        if aside.read_bytes() != judged:
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)  # not the one judged: give it back
        aside.unlink()


def end_with_launcher() -> None:
    """From now on end, as if interrupted, when the launcher that started this process has gone."""

    def watch() -> None:
        while not _orphan():
            time.sleep(POLL_S)
        os.kill(os.getpid(), signal.SIGTERM)

    if LAUNCHER in os.environ:
        threading.Thread(target=watch, daemon=True).start()


def _orphan() -> bool:
    """Whether the launcher has gone. Between it and this process there may be others (srun, a
    container), and on another machine nothing is known of it."""
    launcher = json.loads(os.environ.get(LAUNCHER, "null"))
    return launcher is not None and is_here(launcher) and _gone(launcher)


def _take(path: Path, own: dict[str, Any]) -> int:
    """Make the claim; its open file, by which it is renewed."""
    while True:
        _wait_until_void(path)
        free(path.parent)
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR)
        except FileExistsError:
            continue  # another was faster
        try:
            _beat(descriptor, own, 0)
        except BaseException:  # such as a full disk
            os.close(descriptor)
            path.unlink()
            raise
        return descriptor


def _wait_until_void(path: Path) -> None:
    first = None
    while (owner := claimed_by(path.parent)) is not None:
        seen = _watched[path][0]
        here = bool(owner) and is_here(owner)
        if here or (first is not None and seen != first):
            where = "" if here else " on another machine"
            raise ClaimedError(
                f"{path.parent} is being run by process {owner.get('pid', '?')}{where}"
            )
        first = seen
        time.sleep(min(POLL_S, WRITING_S / 4))


def _keep(path: Path, descriptor: int, own: dict[str, Any], stop: threading.Event) -> None:
    """Renew the claim; interrupt this process when its launcher has gone or its claim is lost."""
    beats, lost, renewed = 0, 0, time.monotonic()
    while not stop.wait(min(POLL_S, BEAT_S)):
        lost = 0 if _is_own(path, own) else lost + 1  # once: another looks at it, see `free`
        if lost > 1 or _orphan():
            os.kill(os.getpid(), signal.SIGTERM)
            return
        if time.monotonic() - renewed > BEAT_S:
            with contextlib.suppress(OSError):  # a server that is away: tried again in a second
                beats += 1
                _beat(descriptor, own, beats)
                renewed = time.monotonic()


def _beat(descriptor: int, own: dict[str, Any], number: int) -> None:
    """Write the claim, each time another text of one length, and wait until the disk has it."""
    os.pwrite(descriptor, json.dumps({**own, "beat": f"{number:09}"}).encode(), 0)
    os.fsync(descriptor)


def _is_own(path: Path, own: dict[str, Any]) -> bool:
    """Whether a claim is still this one; also where the server cannot be asked."""
    try:
        return bool(json.loads(path.read_text()).get("token") == own["token"])
    except (FileNotFoundError, ValueError):
        return False
    except OSError:
        return True


def _gone(owner: dict[str, Any]) -> bool:
    """Whether a process of this machine has ended, be there another one of its number or not."""
    alive, began = _state(owner["pid"])
    return not alive or (None not in (began, owner["began"]) and began != owner["began"])


def _state(pid: int) -> tuple[bool, int | None]:
    """Whether a process of this machine lives, and when it began, where the system tells that."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False, None
    except PermissionError:  # another user's
        pass
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return True, None
    return fields[0] != "Z", int(fields[19])  # Z: killed, but its parent has not asked how it ended


@functools.cache
def _machine() -> str:
    """Tells machines apart without naming them: whose process ids mean the same."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()
        here = f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:  # no Linux
        import uuid

        here = f"{platform.node()} {uuid.getnode()}"
    return hashlib.sha256(here.encode()).hexdigest()[:16]


# --- quiet ----------------------------------------------------------------------------------------


class Quiet:
    """The lock of a runs folder on this machine: what runs side by side in it can hold still.

    It lies in a local folder: in a shared one other machines would wait, if it knows locks at all.
    """

    def __init__(self, runs: Path):
        import tempfile

        from filelock import FileLock  # takes longer to import than `--help` may take

        place = hashlib.sha256(os.fsencode(runs.resolve())).hexdigest()[:12]
        name = f"mtl-bench-{os.getuid()}-{place}.timing"
        self._lock = FileLock(Path(tempfile.gettempdir()) / name)

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
