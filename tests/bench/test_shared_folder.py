"""Two machines on one folder: what one runs the other leaves alone, and takes over when it dies.

A machine is a namespace of process ids with a host name of its own (`unshare`), or this process
with another `locks._machine`.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from launching import FAKE, cells, fake, history

from mtl_bench.bench import launch, store
from mtl_bench.cli.display import Lines
from mtl_bench.core import files, locks

LEASE_S = 2.0
UNSHARE = ["unshare", "--uts", "--pid", "--fork", "--mount-proc", "--kill-child"]
HOLD = """
import os, sys, time
real = time.time
time.time = lambda: real() + 1200
from pathlib import Path
from mtl_bench.core import locks
locks.LEASE_S, locks.BEAT_S, locks.POLL_S = 2.0, 0.25, 0.1
directory = Path(sys.argv[1])
with locks.claim(directory):
    print("held", flush=True)
    while True:
        time.sleep(0.05)
        os.utime(directory / "claim", (time.time(),) * 2)
"""
LAUNCH = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from launching import cells, fake
from mtl_bench.bench import launch
from mtl_bench.cli.display import Lines
runs = Path({runs!r})
states = launch.Launcher(runs, fake(runs, seconds={seconds}), Lines()).run(cells(4))
print([state.word for state in states.values()])
"""


def can_unshare():
    try:
        return subprocess.run([*UNSHARE, "true"], timeout=20).returncode == 0
    except (FileNotFoundError, subprocess.TimeoutExpired):
        return False


machines = pytest.mark.skipif(not can_unshare(), reason="no namespaces here: unshare is refused")


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(locks, "LEASE_S", LEASE_S)
    monkeypatch.setattr(locks, "BEAT_S", LEASE_S / 8)
    monkeypatch.setattr(locks, "POLL_S", 0.1)
    monkeypatch.setattr(store, "SHOWN_S", 1.0)
    monkeypatch.setenv("TEST_LEASE_S", str(LEASE_S))


def on_a_machine(host, *command):
    named = ["sh", "-c", 'hostname "$0" && exec "$@"', host, *command]
    return subprocess.Popen([*UNSHARE, *named], stdout=subprocess.PIPE, text=True)


def kill(machine):
    machine.send_signal(signal.SIGKILL)  # and with it all of its processes
    machine.wait()
    machine.stdout.close()


def try_to_claim(directory):
    with locks.claim(directory):
        return True


@machines
@pytest.mark.parametrize("host", [os.uname().nodename, "other"])
def test_a_live_cell_is_not_stolen_and_a_dead_one_is(host, tmp_path, short):
    """Its clock is 20 minutes ahead, its host name may be this one's, its process id is 1 or 2."""
    holder = on_a_machine(host, sys.executable, "-c", HOLD, str(tmp_path))
    assert holder.stdout.readline() == "held\n"
    began = time.monotonic()
    while time.monotonic() - began < 2 * LEASE_S:  # watched for longer than a lease
        with pytest.raises(locks.ClaimedError, match="on another machine"):
            try_to_claim(tmp_path)
    kill(holder)
    began = time.monotonic()
    assert try_to_claim(tmp_path)
    assert LEASE_S / 2 < time.monotonic() - began < LEASE_S + 5


def test_a_dead_cell_is_taken_over_within_two_minutes():
    assert locks.LEASE_S + 2 * locks.POLL_S + launch.POLL_S < 120
    assert locks.BEAT_S * 4 < locks.LEASE_S  # some beats may come late


@machines
def test_two_launchers_share_a_grid_and_one_survives_the_death_of_the_other(tmp_path, short):
    todo, told = cells(4), []
    code = LAUNCH.format(tests=str(FAKE.parent), runs=str(tmp_path), seconds=0.3)
    other = on_a_machine(os.uname().nodename, sys.executable, "-c", code)
    runner = launch.Launcher(tmp_path, fake(tmp_path, seconds=0.3), Lines(quiet=True))
    states = runner.run(todo)
    assert [states[cell.id].word for cell in todo] == ["done"] * 4
    assert other.wait(60) == 0
    told = other.stdout.read().splitlines()
    other.stdout.close()
    assert told[-1] == "['done', 'done', 'done', 'done']"
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert sorted(starts) == sorted(cell.slug for cell in todo)


@machines
def test_the_cells_of_a_machine_that_dies_are_run_by_the_other(tmp_path, short):
    todo = cells(4)
    code = LAUNCH.format(tests=str(FAKE.parent), runs=str(tmp_path), seconds=60)
    other = on_a_machine("other", sys.executable, "-c", code)
    while not list(tmp_path.glob("*/progress.json")):
        time.sleep(0.05)
    assert store.inspect(todo[0], tmp_path) == store.State("running", store.ELSEWHERE)
    threading.Timer(3 * LEASE_S, lambda: kill(other)).start()
    began = time.monotonic()
    states = launch.Launcher(tmp_path, fake(tmp_path), Lines(quiet=True)).run(todo)
    assert [states[cell.id].word for cell in todo] == ["done"] * 4
    assert time.monotonic() - began > 3 * LEASE_S  # not while it lived
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert sorted(starts) == sorted([todo[0].slug, *(cell.slug for cell in todo)])
    assert not list(tmp_path.glob("*/claim*"))


def test_one_of_a_claim_that_changed_since_it_was_judged_gets_it_back(tmp_path, short, monkeypatch):
    path = tmp_path / "claim"
    path.write_text('{"pid": 1, "machine": "elsewhere", "beat": 1}')
    assert locks.claimed_by(tmp_path) is not None
    time.sleep(LEASE_S + 0.1)
    assert locks.claimed_by(tmp_path) is None
    rename = Path.rename

    def late(self, target):
        path.write_text('{"pid": 1, "machine": "elsewhere", "beat": 2}')
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", late)
    locks.free(tmp_path)
    assert json.loads(path.read_text())["beat"] == 2
    assert [each.name for each in tmp_path.iterdir()] == ["claim"]


# --- who started it -------------------------------------------------------------------------------

CELL = """
import json, os, sys, time
from pathlib import Path
from mtl_bench.core import locks
locks.POLL_S = 0.1
with locks.claim(Path(sys.argv[1])):
    time.sleep(1)
print("whole")
"""


@pytest.mark.parametrize("machine", ["", "elsewhere"])
def test_a_cell_behind_a_wrapper_lives(machine, tmp_path):
    """As behind srun: its parent is not the launcher, which may be on another machine."""
    launcher = locks.process() | ({"machine": machine, "pid": 2**22 + 1} if machine else {})
    environment = {**os.environ, locks.LAUNCHER: json.dumps(launcher)}
    wrapped = ["sh", "-c", '"$@"; exit $?', "sh", sys.executable, "-c", CELL, str(tmp_path)]
    found = subprocess.run(wrapped, env=environment, capture_output=True, text=True)
    assert (found.returncode, found.stdout) == (0, "whole\n")


def test_a_launcher_whose_number_another_process_has_is_gone(tmp_path, monkeypatch):
    launcher = locks.process() | {"began": 1}
    monkeypatch.setenv(locks.LAUNCHER, json.dumps(launcher))
    assert locks._orphan()


# --- files ----------------------------------------------------------------------------------------


def test_temporary_files_of_two_machines_differ(tmp_path):
    """Process and thread have one number on both, as here."""
    path = tmp_path / "row.json"
    with files.replacing(path) as one:
        with files.replacing(path) as other:
            other.write(b"other")
        one.write(b"one")
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]


def test_the_lock_of_a_timing_lies_on_this_machine(tmp_path):
    with locks.Quiet(tmp_path).alone(neighbours=False):
        assert list(tmp_path.iterdir()) == []


def test_a_row_that_a_cache_shows_late_is_waited_for(tmp_path, short):
    (cell,) = todo = cells(1)
    launch.Launcher(tmp_path, fake(tmp_path), Lines(quiet=True)).run(todo)
    row = tmp_path / cell.slug / "row.json"
    row.rename(row.with_name("later"))
    assert store.inspect(cell, tmp_path).word == "interrupted"
    threading.Timer(0.3, lambda: row.with_name("later").rename(row)).start()
    assert store.inspect_done(cell, tmp_path).word == "done"
    row.unlink()
    assert store.inspect_done(cell, tmp_path).word == "interrupted"  # after a minute


def test_a_launcher_waits_for_the_row_of_another_machine(tmp_path, short):
    """Its claim has gone, and its row is shown a moment later: the cell is not run again."""
    (cell,) = todo = cells(1)
    launch.Launcher(tmp_path, fake(tmp_path), Lines(quiet=True)).run(todo)
    directory = tmp_path / cell.slug
    row, claim = directory / "row.json", directory / "claim"
    row.rename(directory / "later")
    claim.write_text('{"pid": 1, "machine": "elsewhere"}')

    def end():
        time.sleep(0.5)
        claim.unlink()
        time.sleep(0.5)
        (directory / "later").rename(row)

    threading.Thread(target=end).start()
    states = launch.Launcher(tmp_path, fake(tmp_path), Lines(quiet=True)).run(todo)
    assert states[cell.id].word == "done"
    assert [word for word, *_ in history(tmp_path)] == ["start", "end"]
