"""A cell on several ranks from its command to its row, and what a rank that dies does to it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support import slurm_node
from support.training import curve
from typer.testing import CliRunner

from mtl_bench.bench import launch, store
from mtl_bench.bench.launch import child_environment, together
from mtl_bench.cli import grid
from mtl_bench.cli.app import app
from mtl_bench.core import ranks
from mtl_bench.core.config import Cell, load_recipe, override
from mtl_bench.core.device import choose_device
from mtl_bench.core.files import read_json
from mtl_bench.core.ranks import ALONE, Processes, joined
from mtl_bench.train import checkpoint

PARTS = ("--set", "recipe.optim.micro_batch=2")
SMOKE = ("train", "--recipe", "smoke", "--backbone", "tiny", "--method", "mgda", *PARTS)
LONG = ("--set", "recipe.optim.steps=400", "--set", "recipe.optim.checkpoint_every=5")


def begin(place: Path, *words: str, **environment: str) -> subprocess.Popen:
    """The command in a session of its own, one thread a rank; what it says is in `said`."""
    command = [sys.executable, "-m", "mtl_bench", *words]
    extra = {"OMP_NUM_THREADS": "1", **environment}
    with (place / "said").open("ab") as said:
        return subprocess.Popen(
            command,
            cwd=place,
            env={**os.environ, **extra},
            stdout=said,
            stderr=said,
            start_new_session=True,
        )


def run(place: Path, *words: str) -> str:
    process = begin(place, *words)
    code = process.wait(300)
    said = (place / "said").read_text()
    assert code == 0, said
    return said


def only(place: Path, name: str) -> Path:
    (found,) = place.glob(f"runs/*/{name}")
    return found


def test_a_cell_on_two_ranks_is_the_cell(tmp_path):
    words = (*SMOKE, "--set", "recipe.optim.steps=2", "--device", "cpu")
    run(tmp_path, *words, "--ranks", "2")
    row = read_json(only(tmp_path, "row.json"))
    assert row["env"]["ranks"] == 2
    assert "done already" in run(tmp_path, *words)


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.slow
def test_labels_and_measures_of_a_checkpoint_are_those_of_one_rank(tmp_path):
    """Of a trained cell without its row, and of the video stage after it."""
    words = (*SMOKE, "--video", "--set", "recipe.data.val_scenes=19", "--device", "cpu")
    run(tmp_path, *words, "--runs", "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    (video,) = (path.parent for path in tmp_path.glob("two/*/pseudo_labels"))
    (plain,) = (path for path in tmp_path.glob("two/*") if path.is_dir() and path != video)
    shutil.rmtree(video)
    (plain / "row.json").unlink()
    said = run(tmp_path, *words, "--runs", "two", "--ranks", "2")
    assert "continuing at step 6 of 6" in said
    before, after = (tmp_path / runs / plain.name for runs in ("one", "two"))
    one, two = (read_json(path / "row.json") for path in (before, after))
    assert (one["env"]["ranks"], two["env"]["ranks"]) == (1, 2)
    assert one["protocol"] == two["protocol"]
    first, second = (
        {k: v for k, v in r["metric"].items() if "latency" not in k} for r in (one, two)
    )
    assert len(first) > 20
    assert json.dumps(second) == json.dumps(first)
    pictures, others = (np.load(path / "samples.npz") for path in (before, after))
    assert others.files == pictures.files
    assert all(np.array_equal(others[key], pictures[key]) for key in pictures.files)
    made, of_two = (contents(tmp_path / r / video.name / "pseudo_labels") for r in ("one", "two"))
    assert len(made) == 1 + 2 * 16
    assert of_two == made
    assert read_json(video / "row.json")["protocol"]["pseudo_frames"] == 16


@pytest.mark.slow
def test_what_is_measured_of_two_ranks_is_what_is_measured_of_one(tmp_path):
    """But for the rounding of batch norms' statistics."""
    rows = []
    for number in ("1", "2"):
        (tmp_path / number).mkdir()
        run(tmp_path / number, *SMOKE, "--device", "cpu", "--ranks", number)
        rows.append(read_json(only(tmp_path / number, "row.json")))
    one, two = ({k: v for k, v in row["metric"].items() if "latency" not in k} for row in rows)
    assert len(one) > 20
    assert two == pytest.approx(one, rel=1e-5)


def test_a_cell_that_ranks_cannot_share_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in (
        [*SMOKE[:-2], "--ranks", "2"],
        ["ablate", "--grid", "backbones", "--smoke", "--gpus-per-cell", "2"],
    ):
        found = CliRunner().invoke(app, words)
        assert found.exit_code == 2, found.output
        assert "2 ranks cannot share the 1 part of a batch" in found.output
    assert list(tmp_path.iterdir()) == []


def test_timings_have_no_ranks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["ablate", "--grid", "latency", "--ranks", "2", "--dry-run"])
    assert found.exit_code == 2
    assert "--ranks 2: ranks train" in found.output


# --- who is which rank ----------------------------------------------------------------------------


@pytest.fixture
def environment(monkeypatch):
    for name in (*ranks.OWN, "SLURM_STEP_NUM_TASKS"):
        monkeypatch.delenv(name, raising=False)

    def be(**values):
        for name, value in values.items():
            monkeypatch.setenv(name, value)

    return be


def test_alone_where_nothing_says_otherwise(environment):
    with joined() as found:
        assert found is ALONE
    environment(WORLD_SIZE="1")  # of a cell that a launcher starts
    with joined(1) as found:
        assert found is ALONE


def test_torchruns_variables(environment):
    environment(RANK="3", WORLD_SIZE="8", LOCAL_RANK="1", MASTER_ADDR="node7")
    with pytest.raises(ValueError, match="WORLD_SIZE = 8 is set, but not MASTER_PORT"):
        joined()
    environment(WORLD_SIZE="two")
    with pytest.raises(ValueError, match="WORLD_SIZE = 'two' is set, and is no whole number"):
        joined()
    environment(WORLD_SIZE="8")
    environment(MASTER_PORT="1234")
    found = joined(2)
    assert isinstance(found, Processes)
    assert (found.rank, found.size, found.local) == (3, 8, 1)
    assert found.address == ("node7", 1234)


def test_sruns_variables(environment, tmp_path, monkeypatch):
    (tmp_path / "scontrol").write_text("#!/bin/sh\n[ \"$3\" = 'n[1-2]' ] && printf 'n1\\nn2\\n'\n")
    (tmp_path / "scontrol").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    environment(SLURM_STEP_NUM_TASKS="1", SLURM_PROCID="0")  # one task: no ranks
    with joined() as alone:
        assert alone is ALONE
    environment(SLURM_STEP_NUM_TASKS="4", SLURM_PROCID="3", SLURM_LOCALID="1")
    environment(SLURM_JOB_ID="17", SLURM_STEP_ID="2", SLURM_STEP_NODELIST="n[1-2]")
    found = joined()
    assert isinstance(found, Processes)
    assert (found.rank, found.size, found.local) == (3, 4, 1)
    assert found.address == ("n1", 20000 + 17 * 16 + 2)


def test_a_cell_of_a_launcher_is_no_rank_of_the_launchers(environment, monkeypatch):
    environment(RANK="1", WORLD_SIZE="2", LOCAL_RANK="1", MASTER_ADDR="x", MASTER_PORT="1")
    monkeypatch.setattr(os, "environ", child_environment(1))
    with joined() as found:
        assert found is ALONE


def test_a_rank_has_a_gpu_of_its_own(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    third = Processes(2, 4, 2, ("n1", 1))
    for count, device in ((4, "cuda:2"), (1, "cuda:0")):  # all are seen, or its own alone
        monkeypatch.setattr(torch.cuda, "device_count", lambda count=count: count)
        assert choose_device("cuda", third) == torch.device(device)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ValueError, match="rank 2 finds 2 GPUs here"):
        choose_device("cuda", third)
    with (
        Processes(0, 4, 0, None) as first,
        pytest.raises(ValueError, match=r"4 ranks, but .* 2 GPUs"),
    ):
        first.tell({}, torch.device("cuda"))


def test_gpus_go_to_cells_in_equal_numbers():
    assert together(("0", "1", "2", "3", "4"), 2) == ("0,1", "2,3")
    assert together(("0", "GPU-1"), 1) == ("0", "GPU-1")
    assert together((), 2) == ()
    with pytest.raises(ValueError, match="--gpus-per-cell 2, but this process sees 1 GPU"):
        together(("0",), 2)


def test_cells_side_by_side_share_the_cores_with_their_ranks(monkeypatch):
    monkeypatch.setattr(launch, "cores", lambda: 8)
    monkeypatch.setattr("mtl_bench.core.provenance.cores", lambda: 8)
    assert child_environment(2, None, ranks=2)["OMP_NUM_THREADS"] == "2"
    chosen = grid.Choice("backbones", None, None, False, None, None).load()
    assert grid._side_by_side(chosen, chosen.jobs, (), each=4) == 2


# --- a rank that dies -----------------------------------------------------------------------------


def followers(process: subprocess.Popen) -> list[int]:
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(pid) for path in tasks for pid in path.read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def training(place: Path) -> tuple[subprocess.Popen, int]:
    """A run in the middle of its steps, and the process of its second rank."""
    process = begin(place, *SMOKE, *LONG, "--device", "cpu", "--ranks", "2")
    end = time.monotonic() + 120
    while not list(place.glob("runs/*/last.pt")):
        assert time.monotonic() < end, (place / "said").read_text()
        time.sleep(0.1)
    (second,) = followers(process)
    return process, second


def ended(process: subprocess.Popen, second: int, seconds: float = 60.0) -> int:
    """The exit code; nothing may be left over, and nothing hang."""
    end = time.monotonic() + seconds
    code = process.wait(seconds)
    while alive(second):
        assert time.monotonic() < end
        time.sleep(0.1)
    return code


def cell_of(place: Path) -> Cell:
    return checkpoint.cell_of(only(place, "last.pt"))


def test_a_signal_to_the_second_rank_stops_the_cell(tmp_path):
    process, second = training(tmp_path)
    os.kill(second, signal.SIGTERM)
    assert ended(process, second) == 130
    assert "interrupted: stopped at step" in (tmp_path / "said").read_text()
    assert store.status(cell_of(tmp_path), tmp_path / "runs") == "interrupted"


@pytest.mark.slow
@pytest.mark.parametrize("who", ["first", "second", "all"])
def test_a_killed_rank_ends_the_others_and_the_cell_goes_on(who, tmp_path):
    """With one rank or two: bit for bit as one that nobody killed."""
    process, second = training(tmp_path)
    for pid in {"first": [process.pid], "second": [second], "all": [process.pid, second]}[who]:
        os.kill(pid, signal.SIGKILL)
    code = ended(process, second)
    cell, runs = cell_of(tmp_path), tmp_path / "runs"
    assert (code, store.status(cell, runs)) in {(1, "failed"), (-signal.SIGKILL, "interrupted")}
    step = checkpoint.read(only(tmp_path, "last.pt"))["step"]
    said = run(tmp_path, *SMOKE, *LONG, "--device", "cpu", *["--ranks", "2"] * (who != "all"))
    assert f"continuing at step {step}" in said
    straight = tmp_path / "straight"
    straight.mkdir()
    run(straight, *SMOKE, *LONG, "--device", "cpu")
    model, expected = (checkpoint.read(only(p, "last.pt"))["model"] for p in (tmp_path, straight))
    for key, value in expected.items():
        if ".running_" not in key:
            assert value.equal(model[key]), key


def reached(place: Path, there: Callable[[], bool], *words: str) -> tuple[subprocess.Popen, int]:
    """A run of two ranks once something is there, and the process of its second rank."""
    process = begin(place, *words, "--device", "cpu", "--ranks", "2")
    end = time.monotonic() + 400
    while not there():
        assert time.monotonic() < end, (place / "said").read_text()
        time.sleep(0.1)
    (second,) = followers(process)
    return process, second


@pytest.mark.slow
@pytest.mark.parametrize("who", ["first", "second"])
def test_a_rank_that_is_killed_in_the_evaluation_ends_the_other(who, tmp_path):
    words = (*SMOKE, "--set", "recipe.data.val_scenes=200", "--set", "recipe.optim.steps=2")

    def evaluates() -> bool:
        told = tmp_path.glob("runs/*/progress.json")
        return any('"stage": "evaluate"' in path.read_text() for path in told)

    process, second = reached(tmp_path, evaluates, *words)
    os.kill(process.pid if who == "first" else second, signal.SIGKILL)
    code = ended(process, second)
    cell = cell_of(tmp_path)
    expected = (-signal.SIGKILL, "interrupted") if who == "first" else (1, "failed")
    assert (code, store.status(cell, tmp_path / "runs")) == expected
    said = run(tmp_path, *words, "--device", "cpu", "--ranks", "2")
    assert "continuing at step 2 of 2" in said
    assert store.status(cell, tmp_path / "runs") == "done"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("who", "number", "expected"),
    [
        ("first", signal.SIGTERM, 130),
        ("second", signal.SIGTERM, 130),
        ("second", signal.SIGKILL, 1),
    ],
)
def test_labels_stay_when_a_rank_ends_among_them(who, number, expected, tmp_path):
    """And the other one ends, too. Frames are large, for batches of eight."""
    words = [*SMOKE, "--video", "--device", "cpu", "--set", "recipe.optim.steps=2"]
    for setting in ("height=128", "width=256", "train_scenes=20", "val_scenes=1"):
        words += ["--set", f"recipe.data.{setting}"]
    words += ["--set", "recipe.pseudo.scales=[1.0, 1.5, 2.0]"]

    def labels() -> bool:
        return any(tmp_path.glob("runs/*/pseudo_labels/gtFine/*/*/*_instanceIds.png"))

    process, second = reached(tmp_path, labels, *words)
    os.kill(process.pid if who == "first" else second, number)
    assert ended(process, second) == expected
    folder = only(tmp_path, "pseudo_labels")
    made = contents(folder)
    said = run(tmp_path, *words, "--ranks", "2")
    (line,) = (line for line in said.splitlines() if line.startswith("labelled"))
    assert int(line.split()[1]) < 40
    kept = contents(folder)
    assert len(kept) == 1 + 2 * 40
    assert all(kept[name] == text for name, text in made.items() if name in kept)


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_two_gpus_are_one(tmp_path):
    losses = []
    for number in ("1", "2"):
        (tmp_path / number).mkdir()
        run(tmp_path / number, *SMOKE, "--device", "cuda", "--ranks", number)
        losses.append(
            [float(row["total"]) for row in curve(only(tmp_path / number, "curve.csv").parent)]
        )
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)


@pytest.mark.slow
def test_a_grid_of_cells_on_two_ranks(tmp_path):
    (tmp_path / "mine.toml").write_text(
        'recipe = "smoke"\n[axes]\nmethod = ["fixed"]\nbackbone = ["tiny"]\n'
    )
    run(tmp_path, "ablate", "--grid", "mine.toml", *PARTS, "--ranks", "2", "--device", "cpu")
    assert read_json(only(tmp_path, "row.json"))["env"]["ranks"] == 2


@pytest.mark.slow
def test_a_stopped_rank_is_missed(tmp_path):
    process, second = training(tmp_path)
    os.kill(second, signal.SIGSTOP)
    assert ended(process, second) == 1
    assert "rank 1 of 2 is not to be heard any more" in (tmp_path / "said").read_text()


@pytest.mark.slow
def test_processes_of_torchrun_are_ranks(tmp_path):
    words = ["--standalone", "--nproc-per-node=2", "-m", "mtl_bench", *SMOKE, "--device", "cpu"]
    command = [sys.executable, "-m", "torch.distributed.run", *words]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=300)
    assert read_json(only(tmp_path, "row.json"))["env"]["ranks"] == 2


lacking = slurm_node.why_not()


@pytest.mark.slow
@pytest.mark.skipif(bool(lacking), reason=lacking or "it is here")
def test_tasks_of_slurm_are_ranks(tmp_path_factory):
    place = tmp_path_factory.mktemp("shared")
    recipe = override(
        Cell(load_recipe("smoke"), "tiny", "fixed"), ["recipe.optim.micro_batch=2"]
    ).recipe
    assert recipe.optim.batch == 2 * recipe.optim.micro_batch
    text = '[axes]\nmethod = ["fixed"]\nbackbone = ["tiny"]\n'
    (place / "mine.toml").write_text(f'recipe = "smoke"\n{text}')
    words = ["--grid", "mine.toml", *PARTS, "--on", "slurm", "--slurm", "time=10,ntasks=2"]
    with slurm_node.running(tmp_path_factory.mktemp("slurm")):
        run(place, "ablate", *words, "--device", "cpu")
        end = time.monotonic() + 200
        while not list(place.glob("runs/*/row.json")):
            assert time.monotonic() < end, [p.read_text() for p in place.glob("runs/*/log.txt")]
            time.sleep(0.5)
    assert json.loads(only(place, "row.json").read_text())["env"]["ranks"] == 2
