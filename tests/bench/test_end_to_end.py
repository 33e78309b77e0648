"""The program as a person runs it: a grid, a method of one's own, a killed and repeated run."""

import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.program import MINE, mtl_bench, rows, user_folder


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return user_folder(tmp_path_factory.mktemp("user"))


def ablate(place: Path, root: Path, runs: str = "runs") -> list:
    words = ["ablate", "--grid", "grid.toml", "--plugins", "plugins", "--data", root]
    return [*words, "--runs", runs, "--reports", f"reports-{runs}"]


@pytest.fixture(scope="module")
def finished(place, smoke_root) -> Path:
    done = mtl_bench(*ablate(place, smoke_root), cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    return place


def test_a_method_is_one_short_file():
    assert len(MINE.splitlines()) <= 15


def test_own_method_is_listed_and_checked(place):
    listed = mtl_bench("list", "methods", "--plugins", "plugins", cwd=place)
    assert "mine" in listed.stdout
    assert "Log-sum: scale-invariant weighting of my own." in listed.stdout
    checked = mtl_bench("check", "mine", "--plugins", "plugins", cwd=place)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_grid_runs_and_reports(finished):
    found = rows(finished / "runs")
    assert sorted(name.split("-")[0] for name in found) == ["fixed", "mine"]
    for row in found.values():
        assert 0 <= row["metric"]["panoptic.pq"] <= 100
        assert row["metric"]["depth_median.rmse"] > 0
    (report,) = (finished / "reports-runs").iterdir()
    page = (report / "index.html").read_text()
    assert "mine" in page
    assert "smoke" in page
    for name in ("table.csv", "table.md", "table.tex"):
        assert "mine" in (report / name).read_text()


def test_second_run_trains_nothing(finished, smoke_root):
    before = {p: p.stat().st_mtime_ns for p in (finished / "runs").glob("*/*")}
    start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    again = mtl_bench(*ablate(finished, smoke_root), cwd=finished)
    assert again.returncode == 0, again.stdout + again.stderr
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start < 30
    assert {p: p.stat().st_mtime_ns for p in (finished / "runs").glob("*/*")} == before


def test_killed_grid_ends_with_the_same_rows(finished, smoke_root):
    words = [sys.executable, "-m", "mtl_bench", *ablate(finished, smoke_root, "killed")]
    process = subprocess.Popen(
        [str(word) for word in words],
        cwd=finished,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    time.sleep(random.uniform(4, 14))
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    again = mtl_bench(*ablate(finished, smoke_root, "killed"), cwd=finished)
    assert again.returncode == 0, again.stdout + again.stderr
    assert rows(finished / "killed") == rows(finished / "runs")
