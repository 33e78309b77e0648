"""The program as a person runs it: a grid, a method of one's own, a killed and repeated run."""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

MINE = '''"""Log-sum: scale-invariant weighting of my own.

Source: this test.
"""
from mtl_bench.core.method import LossMethod


class Mine(LossMethod):
    def total(self, step):
        return step.loss_K.clamp_min(1e-8).log().sum()
'''
GRID = """
question = "Does everything run?"
recipe = "smoke"

[axes]
backbone = ["tiny"]
method = ["fixed", "mine"]

[report]
rows = "method"
"""


def mtl_bench(*arguments, cwd: Path, **options) -> subprocess.CompletedProcess:
    words = [sys.executable, "-m", "mtl_bench", *(str(a) for a in arguments)]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A user's folder: a grid file, and a plug-in in a folder of its own."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "plugins").mkdir()
    (folder / "plugins" / "mine.py").write_text(MINE)
    (folder / "grid.toml").write_text(GRID)
    return folder


def ablate(place: Path, root: Path, runs: str = "runs") -> list:
    words = ["ablate", "--grid", "grid.toml", "--plugins", "plugins", "--data", root]
    return [*words, "--runs", runs, "--reports", f"reports-{runs}"]


@pytest.fixture(scope="module")
def finished(place, smoke_root) -> Path:
    done = mtl_bench(*ablate(place, smoke_root), cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    return place


def rows(runs: Path) -> dict[str, dict]:
    """What a row says about the cell, without clocks and without what stood around the run."""
    found = {}
    for path in sorted(runs.glob("*/row.json")):
        row = json.loads(path.read_text())
        kept = {k: v for k, v in row["metric"].items() if not k.startswith("latency.")}
        found[path.parent.name] = {"metric": kept, "cell": row["cell"], "code": row["code"]}
    return found


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


def test_failed_cell_costs_its_row_only(place, smoke_root):
    (place / "fails").mkdir(exist_ok=True)
    (place / "fails" / "mine.py").write_text(MINE.replace(".sum()", ".sum() * float('nan')"))
    words = ["ablate", "--grid", "grid.toml", "--plugins", "fails", "--data", smoke_root]
    done = mtl_bench(*words, "--runs", "half", "--reports", "reports-half", cwd=place)
    assert done.returncode == 1, done.stdout + done.stderr
    (failed,) = (place / "half").glob("*/failed.json")
    assert failed.parent.name.startswith("mine-")
    (done_row,) = (place / "half").glob("*/row.json")
    assert done_row.parent.name.startswith("fixed-")
    (report,) = (place / "reports-half").iterdir()
    assert "failed" in (report / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "--backbone", "tinny", "--method", "fixed"], "did you mean 'tiny'"),
        (["train", "--backbone", "tiny", "--method", "fixd"], "did you mean 'fixed'"),
        (["train", "--backbone", "tiny", "--method", "fixed", "--recipe", "smal"], "'small'"),
        (["ablate", "--grid", "backbone"], "did you mean 'backbones'"),
        (["ablate", "--grid", "backbones", "--data", "nowhere"], "nowhere"),
        (["data", "check", "nowhere"], "nowhere"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(words, message, tmp_path):
    done = mtl_bench(*words, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("runs/*/row.json"))
