"""The paper's ablation as a person runs it, killed anywhere, too."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.program import rows


def ablation(place: Path, root: Path, runs: str) -> list[str]:
    words = [sys.executable, "-m", "mtl_bench", "ablate", "--grid", "ablation", "--smoke"]
    words += ["--set", "backbone=tiny", "--data", root, "--jobs", "2"]
    return [str(word) for word in [*words, "--runs", runs, "--reports", f"reports-{runs}"]]


def run_whole(words: list[str], cwd: Path) -> str:
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def ablated(tmp_path_factory, smoke_root) -> Path:
    place = tmp_path_factory.mktemp("ablation")
    text = run_whole(ablation(place, smoke_root, "runs"), place)
    assert "4 cells and 2 that they need" in text
    assert "4 of 4 cells done" in text
    return place


def test_the_papers_ablation_runs_from_one_command(ablated):
    found = rows(ablated / "runs")
    assert len(found) == 6
    kinds = [(row["cell"]["single_task"], row["cell"]["video"]) for row in found.values()]
    assert sorted(kinds) == [(False, False)] * 4 + [(False, True), (True, False)]
    table = (ablated / "reports-runs" / "ablation-smoke" / "table.md").read_text()
    names = ["Single-Task Baseline", "Multi-Task Baseline", "+ Uncertainty", "+ Video Sequence"]
    assert sorted(names, key=table.index) == names


@pytest.mark.slow
def test_an_ablation_killed_anywhere_ends_with_the_same_rows(ablated, smoke_root):
    words = ablation(ablated, smoke_root, "killed")
    process = subprocess.Popen(
        words,
        cwd=ablated,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    time.sleep(random.uniform(4, 30))
    # The launcher is killed outright, and every cell of it, wherever each is.
    claims = [json.loads(path.read_text() or "{}") for path in ablated.glob("killed/*/claim")]
    for pid in [process.pid, *(claim["pid"] for claim in claims if claim)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()
    run_whole(ablation(ablated, smoke_root, "killed"), ablated)
    assert rows(ablated / "killed") == rows(ablated / "runs")
    assert "to run 0" in run_whole(ablation(ablated, smoke_root, "killed"), ablated)
