"""Cells in a queue: what is submitted, and what becomes of them on a Slurm of one node."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from launching import cells, fake, history
from support import slurm_node
from support.slurm_node import call
from typer.testing import CliRunner

from mtl_bench.bench import launch, slurm, store
from mtl_bench.bench.executors import Task
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.slurm import Slurm, arrays, options_of
from mtl_bench.cli.app import app
from mtl_bench.cli.display import Lines
from mtl_bench.core.config import Cell, Recipe

# --- what is submitted ----------------------------------------------------------------------------


def task(name, *after):
    return Task(name, ["train", name], Path("runs") / name / "log.txt", after)


def test_cells_are_queued_behind_what_they_need():
    tasks = [task("a"), task("b", "a"), task("c", "b", "a"), task("d"), task("e", "not queued")]
    assert [[each.id for each in array] for array in arrays(tasks)] == [
        ["a", "d", "e"],
        ["b"],
        ["c"],
    ]


def test_an_array_has_no_more_tasks_than_a_cluster_takes(monkeypatch):
    monkeypatch.setattr(slurm, "LARGEST", 2)
    assert [len(array) for array in arrays([task(str(n)) for n in range(5)])] == [2, 2, 1]


def test_options_are_those_of_sbatch():
    given = "partition=gpu, time=4:00:00,--gpus=1,exclusive"
    expected = {"partition": "gpu", "time": "4:00:00", "gpus": "1", "exclusive": ""}
    assert options_of(given) == expected
    text = Slurm(Path("runs"), options_of(given), cap=8).script(Path("/x y"), 4)
    for line in ("partition=gpu", "exclusive", "array=0-3%8", "requeue", "signal=USR1@60"):
        assert f"#SBATCH --{line}\n" in text
    assert "mapfile -t commands < '/x y'/commands" in text
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)


@pytest.mark.parametrize(
    ("text", "why"),
    [("=3", "is no option of sbatch"), ("array=0-9", "sets array itself"), ("a b", "no option")],
)
def test_wrong_options_are_one_line(text, why):
    with pytest.raises(ValueError, match=why):
        options_of(text)


def test_without_slurm_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match="no sbatch here"):
        Slurm(tmp_path).check()
    with pytest.raises(ValueError, match="no sbatch here"):
        Slurm(tmp_path).submit([task("a")])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--grid", "latency", "--on", "slurm"], "on a machine that you choose"),
        (["--grid", "backbones", "--slurm", "time=1"], "--slurm is for --on slurm"),
        (["--grid", "backbones", "--on", "slurm", "--slurm", "signal=x"], "sets signal itself"),
    ],
)
def test_what_does_not_go_together_is_told(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["ablate", "--smoke", *words])
    assert found.exit_code == 2
    assert message in found.output


def test_a_dry_run_prints_the_scripts_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["ablate", "--grid", "ablation", "--smoke", "--on", "slurm", "--jobs", "3"]
    found = CliRunner().invoke(app, [*words, "--slurm", "partition=gpu", "--dry-run"])
    assert found.exit_code == 0, found.output
    assert found.output.count("#!/bin/bash") > 1  # cells, and those that need them
    assert "%3" in found.output
    assert "#SBATCH --partition=gpu" in found.output
    assert list(tmp_path.iterdir()) == []


SQUEUE = """#!/bin/sh
cat <<END
7_0|PENDING|Priority
7_1|RUNNING|None
7_3|FAILED|NonZeroExitCode
9_0|PENDING|Dependency
END
"""


def test_status_says_what_the_queue_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "squeue"
    program.write_text(SQUEUE)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    ids = [cell.id for cell in load_grid("backbones", smoke=True).jobs]
    for job, of_job in ((7, ids), (9, ids[:1])):
        folder = tmp_path / "runs" / ".slurm" / str(job)
        folder.mkdir(parents=True)
        (folder / "array.json").write_text(json.dumps({"job": job, "ids": of_job}))
    found = Slurm(Path("runs")).states()
    assert [found[key].word for key in ids if key in found] == ["queued", "running", "ended"]
    text = CliRunner().invoke(app, ["status", "--grid", "backbones", "--smoke"]).output
    about = [line.partition("Slurm ")[2].strip() for line in text.splitlines()[:4]]
    assert about == ["9_0 PENDING (Dependency)", "7_1 RUNNING", "", "7_3 FAILED (NonZeroExitCode)"]


# --- on a node ------------------------------------------------------------------------------------

lacking = slurm_node.why_not()
on_a_node = pytest.mark.skipif(bool(lacking), reason=lacking or "it is here")


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    with slurm_node.running(tmp_path_factory.mktemp("slurm")):
        yield
    assert list(Path.cwd().glob("slurm-*.out")) == []  # the log of a job that nobody gave a place


def submit(todo, runs, **behaviour):
    queue = Slurm(runs)
    queue.submit(launch.queued_tasks(todo, runs, fake(runs, **behaviour), None, None))
    return queue


def wait_for(condition, seconds=90.0):
    """What is requeued waits until its credential has expired: cred_expire, and a second."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, call("squeue", "-r", "-t", "all")
        time.sleep(0.2)


def ended(queue):
    return lambda: {status.word for status in queue.states().values()} == {"ended"}


def words(runs, cell):
    return [word for word, slug, *_ in history(runs) if slug == cell.slug]


@on_a_node
def test_children_run_after_their_parents_and_never_after_failed_ones(node, tmp_path):
    plain, other = cells(2)
    todo = [plain, other, replace(plain, video=True), replace(other, video=True)]
    queue = submit(todo, tmp_path, seconds=0.5, actions={other.id: "crash"})
    assert len(queue.submitted) == 2
    assert {status.word for status in queue.states().values()} <= {"queued", "running", "ended"}
    wait_for(ended(queue))
    found = [store.inspect(cell, tmp_path) for cell in todo]
    assert [state.word for state in found] == ["done", "failed", "done", "missing"]
    assert found[1].why.startswith("exit code 137 in Slurm job ")
    assert "about to crash" in (tmp_path / other.slug / "log.txt").read_text()
    times = {(word, slug): when for word, slug, when, _ in history(tmp_path)}
    assert times["end", plain.slug] <= times["start", todo[2].slug]
    assert "CANCELLED" in queue.states()[todo[3].id].about


@on_a_node
def test_what_is_cancelled_saves_and_does_not_come_back(node, tmp_path):
    (cell,) = todo = cells(1)
    queue = submit(todo, tmp_path, seconds=60)
    wait_for((tmp_path / cell.slug / "progress.json").exists)
    assert queue.states()[cell.id].word == "running"
    queue.cancel()
    wait_for(ended(queue))
    assert words(tmp_path, cell) == ["start", "saved"]
    assert store.status(cell, tmp_path) == "interrupted"
    assert "Restarts=0" in call("scontrol", "show", "job", f"{queue.submitted[0]}_0")


@on_a_node
@pytest.mark.parametrize("how", ["preempted", "out of time"])
def test_what_is_preempted_or_out_of_time_goes_on_later(node, how, tmp_path):
    (cell,) = todo = cells(1)
    queue = submit(todo, tmp_path, action="resume", seconds=60)
    job = f"{queue.submitted[0]}_0"
    wait_for((tmp_path / cell.slug / "progress.json").exists)
    if how == "preempted":
        script = "#!/bin/bash\nsleep 1\n"
        words_of_it = ["sbatch", "--partition=high", "--exclusive", f"--output={tmp_path}/high"]
        subprocess.run(words_of_it, input=script, text=True, check=True, capture_output=True)
    else:
        call("scancel", "--signal=USR1", job)  # what Slurm sends before the limit, in minutes
    wait_for(lambda: words(tmp_path, cell)[-1] == "saved")
    wait_for(lambda: store.status(cell, tmp_path) == "done")
    assert words(tmp_path, cell) == ["start", "saved", "start", "end"]


@on_a_node
def test_a_local_launcher_and_slurm_share_a_grid(node, tmp_path):
    todo = cells(5)
    queue = submit(todo, tmp_path, seconds=0.5)
    states = launch.Launcher(tmp_path, fake(tmp_path, seconds=0.5), Lines(quiet=True)).run(todo)
    assert [states[cell.id].word for cell in todo] == ["done"] * 5
    wait_for(ended(queue))
    assert [words(tmp_path, cell) for cell in todo] == [["start", "end"]] * 5


@on_a_node
def test_a_refusal_is_one_line_and_leaves_nothing_queued(node, tmp_path):
    parent = Cell(Recipe(), "tiny", "fixed")
    tasks = launch.queued_tasks(
        [parent, replace(parent, video=True)], tmp_path, fake(tmp_path, seconds=60), None, None
    )
    for act in (Slurm.check, lambda queue: queue.submit(tasks)):
        with pytest.raises(ValueError, match=r"sbatch says: sbatch: error: .*invalid partition"):
            act(Slurm(tmp_path, {"partition": "none"}))
    Slurm(tmp_path, {"partition": "low", "time": "10"}).check()
    assert Slurm(tmp_path).states() == {}
    queue = Slurm(tmp_path)
    submitted = queue._submit

    def refuse_the_second(tasks, held):
        if held:
            raise ValueError("refused")
        return submitted(tasks, held)

    queue._submit = refuse_the_second
    with pytest.raises(ValueError, match="refused"):
        queue.submit(tasks)
    wait_for(ended(queue))


GRID = """
recipe = "smoke"
[axes]
method = ["fixed"]
backbone = ["tiny"]
video = [true]
"""


@pytest.mark.slow
@on_a_node
def test_a_grid_with_a_video_cell_runs(node, tmp_path):
    (tmp_path / "mine.toml").write_text(GRID)

    def run(*words):
        command = [sys.executable, "-m", "mtl_bench", *words, "--grid", "mine.toml"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return done.stdout

    told = run("ablate", "--on", "slurm", "--slurm", "time=10", "--jobs", "2")
    assert "queued 2 cells as Slurm's jobs" in told
    assert "PENDING (Dependency)" in run("status")
    assert "nothing to queue" in run("ablate", "--on", "slurm")
    wait_for(lambda: len(list(tmp_path.glob("runs/*/row.json"))) == 2, seconds=500)
    assert "done 2" in run("status")
    assert (tmp_path / run("report").strip()).is_file()
