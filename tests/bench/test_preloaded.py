"""Processes that are forked from one that has imported torch, as the launcher uses them."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mtl_bench.bench import preloaded
from mtl_bench.bench.preloaded import PROGRAM, Forked, can_fork

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")


def test_a_command_runs_as_if_it_was_started_anew(tmp_path):
    log = tmp_path / "log.txt"
    log.write_text("before\n")
    right = Forked(["list", "recipes"], log, {"NO_COLOR": "1", "PATH": "/bin"})
    wrong = Forked(["train", "--recipe", "no-such"], tmp_path / "wrong.txt", {})
    assert (right.wait(120), wrong.wait(120)) == (0, 2)
    assert right.poll() == 0
    assert log.read_text().startswith("before\n")
    assert "scales" in log.read_text()
    assert "no recipe called 'no-such'" in (tmp_path / "wrong.txt").read_text()
    assert "Traceback" not in (tmp_path / "wrong.txt").read_text()


def test_it_takes_signals(tmp_path):
    words = ["train", "--recipe", "scales", "--method", "fixed", "--runs", str(tmp_path / "runs")]
    process = Forked(words, tmp_path / "log.txt", {})
    for _ in range(600):
        if list(tmp_path.glob("runs/*/progress.json")):
            break
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130
    killed = Forked(words, tmp_path / "log.txt", {})
    killed.kill()
    assert killed.wait(120) == -signal.SIGKILL


LAUNCHING = """
import json, os, sys, time
from pathlib import Path
from mtl_bench.bench.preloaded import Forked
from mtl_bench.core.locks import LAUNCHER, process as this

words = ["train", "--recipe", "scales", "--method", "fixed", "--runs", sys.argv[1]]
words += ["--set", "recipe.optim.steps=1000000"]
process = Forked(words, Path(sys.argv[2]), {**os.environ, LAUNCHER: json.dumps(this())})
print(process.pid, flush=True)
time.sleep(600)
"""


def test_it_ends_with_the_launcher_and_not_before(tmp_path):
    words = [sys.executable, "-c", LAUNCHING, str(tmp_path / "runs"), str(tmp_path / "log.txt")]
    launcher = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    cell = Path(f"/proc/{int(launcher.stdout.readline())}")

    def waits_for(happened) -> bool:
        return any(happened() or time.sleep(0.2) for _ in range(600))

    assert waits_for(lambda: list(tmp_path.glob("runs/*/progress.json")))
    time.sleep(3)  # in which it looks thrice whether its launcher is there
    assert cell.exists(), (tmp_path / "log.txt").read_text()
    launcher.kill()
    launcher.wait()
    assert waits_for(lambda: not cell.exists())
    assert "interrupted: stopped at step" in (tmp_path / "log.txt").read_text()


def test_other_programs_and_changed_code_are_not_forked(monkeypatch):
    command = [*PROGRAM, "train"]
    assert can_fork(command)
    assert not can_fork([sys.executable, "fake_cell.py"])
    monkeypatch.setattr(preloaded, "_stamp", lambda: (0, 0))
    assert not can_fork(command)
