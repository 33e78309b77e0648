"""The loop: it learns, it stops on nonsense, and a killed run ends as if it had not been killed."""

import csv
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.training import CPU, curve, run

from mtl_bench.core.config import Optim, load_recipe, to_dict
from mtl_bench.core.device import Compute, choose_device, seed_for
from mtl_bench.core.files import write_json
from mtl_bench.data.loader import train_batches
from mtl_bench.train import checkpoint
from mtl_bench.train.curve import data_share
from mtl_bench.train.loop import build, schedule, train
from mtl_bench.train.progress import Interrupted, Progress
from mtl_bench.train.tracking import Tracker


def states(run_dir: Path) -> dict[str, torch.Tensor]:
    """Every tensor of a checkpoint, by its path in it."""
    flat: dict[str, torch.Tensor] = {}

    def walk(value, where):
        if isinstance(value, torch.Tensor):
            flat[where] = value
        elif isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{where}/{key}")

    walk(checkpoint.read(run_dir / "last.pt"), "")
    return flat


def assert_same_state(one: Path, other: Path) -> None:
    first, second = states(one), states(other)
    assert first.keys() == second.keys()
    assert len(first) > 100
    different = [key for key in first if not torch.equal(first[key], second[key])]
    assert different == []


# Dies by SIGKILL, as a machine does, when step 5 is done and the last checkpoint is of step 3.
KILLED = """
import json, os, signal, sys
from pathlib import Path
import torch
from mtl_bench.core.config import Cell, from_dict
from mtl_bench.core.device import Compute
from mtl_bench.train.progress import Progress
from mtl_bench.train.tracking import Tracker
from mtl_bench.train.loop import train

class Dies(Progress):
    def update(self, stage, step, steps, note=""):
        if step == 5:
            os.kill(os.getpid(), signal.SIGKILL)

run_dir, root = Path(sys.argv[1]), Path(sys.argv[2])
cell = from_dict(Cell, json.loads((run_dir / "cell.json").read_text()))
train(cell, root, run_dir, Compute(torch.device("cpu")), Dies(run_dir, print),
      Tracker("off", cell, run_dir))
"""


OTHERS = ("fixed", "uncertainty", "famo", "auto_lambda", "fixed_uncertainty+pcgrad")


@pytest.mark.parametrize(
    "method",
    [
        *("fixed_uncertainty", "modo"),  # own parameters; three batches a step
        *(pytest.param(method, marks=pytest.mark.slow) for method in OTHERS),
    ],
)
def test_killed_and_resumed_equals_straight_bit_for_bit(method, smoke_cell, smoke_root, tmp_path):
    cell = replace(smoke_cell, method=method)
    assert (cell.recipe.optim.steps, cell.recipe.optim.checkpoint_every) == (6, 3)
    run(cell, smoke_root, tmp_path / "straight")

    killed = tmp_path / "killed"
    killed.mkdir()
    write_json(killed / "cell.json", to_dict(cell))
    arguments = [sys.executable, "-c", KILLED, str(killed), str(smoke_root)]
    done = subprocess.run(arguments, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()[-2000:]
    assert checkpoint.read(killed / "last.pt")["step"] == 3
    run(cell, smoke_root, killed)

    assert_same_state(tmp_path / "straight", killed)
    for name in ("straight", "killed"):
        with (tmp_path / name / "curve.csv").open() as file:
            assert [int(row["step"]) for row in csv.DictReader(file)] == [1, 2, 3, 4, 5, 6]


def test_a_request_to_stop_saves_and_the_run_goes_on(smoke_cell, smoke_root, tmp_path):
    class Asked(Progress):
        def update(self, stage, step, steps, note=""):
            self.stop_asked = step == 2

    run(smoke_cell, smoke_root, tmp_path / "straight")
    stopped = tmp_path / "stopped"
    stopped.mkdir()
    with pytest.raises(Interrupted, match="stopped at step 2 of 6"):
        run(smoke_cell, smoke_root, stopped, Asked(stopped, print))
    run(smoke_cell, smoke_root, stopped)
    assert_same_state(tmp_path / "straight", stopped)


def test_killed_just_after_a_checkpoint_the_curve_has_every_step(
    smoke_cell, smoke_root, tmp_path, monkeypatch
):
    """What is on disk at the moment the checkpoint is complete is all that a resumed run gets."""
    save, on_disk = checkpoint.save, tmp_path / "as_killed"

    def save_and_copy(path, step, *state):
        save(path, step, *state)
        if step == 3:
            shutil.copytree(path.parent, on_disk)

    monkeypatch.setattr(checkpoint, "save", save_and_copy)
    run(smoke_cell, smoke_root, tmp_path / "straight")
    monkeypatch.undo()
    run(smoke_cell, smoke_root, on_disk)
    with (on_disk / "curve.csv").open() as file:
        assert [int(row["step"]) for row in csv.DictReader(file)] == [1, 2, 3, 4, 5, 6]


def test_time_spent_waiting_for_batches_is_measured(smoke_cell, smoke_root, tmp_path, monkeypatch):
    def slow(*given):
        for batch in train_batches(*given):
            time.sleep(0.2)
            yield batch

    monkeypatch.setattr("mtl_bench.train.loop.train_batches", slow)
    run(smoke_cell, smoke_root, tmp_path / "run")
    rows = curve(tmp_path / "run")
    assert all(200 <= float(row["data_ms"]) < float(row["step_ms"]) for row in rows)
    waited, took = (sum(float(row[key]) for row in rows) for key in ("data_ms", "step_ms"))
    share = data_share(tmp_path / "run" / "curve.csv")
    assert share == pytest.approx(waited / took)
    assert 0 < share < 1


def test_seeds_differ_and_a_seed_repeats(smoke_cell, smoke_root, tmp_path):
    run(smoke_cell, smoke_root, tmp_path / "one")
    run(smoke_cell, smoke_root, tmp_path / "again")
    run(replace(smoke_cell, seed=1), smoke_root, tmp_path / "other")
    assert_same_state(tmp_path / "one", tmp_path / "again")
    key = "/model/net.heads.semantic.1.weight"
    assert not torch.equal(states(tmp_path / "one")[key], states(tmp_path / "other")[key])


def test_losses_fall(smoke_cell, smoke_root, tmp_path, with_optim):
    cell = with_optim(replace(smoke_cell, method="fixed"), steps=60, checkpoint_every=60)
    run(cell, smoke_root, tmp_path / "run")
    with (tmp_path / "run" / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))

    def mean(column, part):
        return sum(float(row[column]) for row in part) / len(part)

    for column in ("loss.semantic", "loss.center", "loss.photometric", "total"):
        assert mean(column, rows[-10:]) < 0.9 * mean(column, rows[:10]), column


@pytest.mark.parametrize(
    ("tasks", "terms"),
    [
        (("panoptic",), {"semantic", "center", "offset"}),
        (("depth",), {"photometric", "smoothness"}),
    ],
)
def test_single_tasks_train_their_terms_only(tasks, terms, smoke_cell, smoke_root, tmp_path):
    run(replace(smoke_cell, tasks=tasks), smoke_root, tmp_path / "run")
    with (tmp_path / "run" / "curve.csv").open() as file:
        columns = next(csv.DictReader(file))
    assert {name.removeprefix("loss.") for name in columns if name.startswith("loss.")} == terms


def test_nan_stops_with_the_terms_name(smoke_cell, smoke_root, tmp_path, with_optim):
    cell = with_optim(smoke_cell, lr=1e30, clip=None, warmup_steps=0)
    with pytest.raises(FloatingPointError, match=r"loss term '\w+' is (nan|-?inf) at step \d"):
        run(cell, smoke_root, tmp_path / "run")
    assert not (tmp_path / "run" / "row.json").exists()


def test_learning_rates_of_the_three_groups(smoke_cell, with_optim):
    cell = with_optim(smoke_cell, lr=1e-4, head_lr_factor=10.0, method_lr=3e-4, weight_decay=0.1)
    model, method, optimizer = build(cell, Compute(CPU))
    by_parameter = {id(p): group for group in optimizer.param_groups for p in group["params"]}
    heads = {id(p) for p in model.head_parameters()}
    for parameter in model.parameters():
        expected = 1e-3 if id(parameter) in heads else 1e-4
        assert by_parameter[id(parameter)]["lr"] == pytest.approx(expected)
    for parameter in method.parameters():
        group = by_parameter[id(parameter)]
        assert (group["lr"], group["weight_decay"]) == (3e-4, 0.0)


def test_schedule_is_the_papers():
    expected = {0: 0.1, 1: 0.1008985, 500: 0.5458733, 999: 0.9841159, 1000: 0.9849874}
    expected |= {30000: 0.5358867, 59999: 5.008e-5}
    for step, factor in expected.items():
        assert schedule(step, Optim()) == pytest.approx(factor, rel=1e-4)


@pytest.mark.parametrize("recipe", ["small", "medium", "kitti-small", "kitti", "cityscapes"])
def test_log_variances_move_no_further_than_the_papers(recipe):
    """By 3.1 in each of two trainings: the weight of a loss that can be driven to 0, as smoothness
    can by a flat depth, grows for as long as it may."""
    optim = load_recipe(recipe).optim
    assert optim.method_lr * sum(schedule(step, optim) for step in range(optim.steps)) < 3.2


def test_engine_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="fp16 trains on CUDA only"):
        Compute(CPU, "fp16")
    with pytest.raises(ValueError, match="no precision 'fp8'"):
        Compute(CPU, "fp8")
    with pytest.raises(ValueError, match="no device 'tpu'"):
        choose_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="use --device cpu"):
            choose_device("cuda")


def test_seeds_of_purposes_are_independent():
    purposes = ("data", "method", "initial weights")
    assert len({seed_for(seed, purpose) for seed in range(3) for purpose in purposes}) == 9


def test_damaged_checkpoint_is_named(tmp_path):
    path = tmp_path / "last.pt"
    with pytest.raises(ValueError, match=r"no checkpoint .*last\.pt"):
        checkpoint.read(path)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match=r"last\.pt is not a readable checkpoint"):
        checkpoint.read(path)
    torch.save({"weights": torch.ones(1)}, path)
    with pytest.raises(ValueError, match="is not a checkpoint of format"):
        checkpoint.read(path)


def test_bfloat16_trains(smoke_cell, smoke_root, tmp_path):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    compute = Compute(CPU, "bf16")
    progress = Progress(run_dir, print)
    tracker = Tracker("off", smoke_cell, run_dir)
    train(smoke_cell, smoke_root, run_dir, compute, progress, tracker)
    assert all(t.isfinite().all() for t in states(run_dir).values() if t.is_floating_point())


# --- what a second training starts from, parts of a batch, diagnostics ----------------------------


def test_a_second_training_goes_on_from_weights_and_method_alone(
    smoke_cell, smoke_root, tmp_path, with_optim
):
    run(smoke_cell, smoke_root, tmp_path / "first")
    still = with_optim(smoke_cell, steps=1, lr=0.0, method_lr=0.0)
    run(still, smoke_root, tmp_path / "second", start=tmp_path / "first" / "last.pt")
    first, second = states(tmp_path / "first"), states(tmp_path / "second")
    kept = [key for key in first if key.startswith("/model") and "running" not in key]
    kept = [key for key in kept if "num_batches" not in key]
    assert len(kept) > 50
    assert all(torch.equal(first[key], second[key]) for key in kept)
    key = "/method/log_variance_T"
    assert torch.equal(first[key], second[key])
    assert (first[key] != 0).all()
    assert second["/optimizer/state/0/step"] == 1  # the optimiser begins anew


def test_an_own_checkpoint_wins_over_the_start(smoke_cell, smoke_root, tmp_path):
    run(smoke_cell, smoke_root, tmp_path / "first")
    other = replace(smoke_cell, seed=1)
    run(other, smoke_root, tmp_path / "second")
    before = states(tmp_path / "second")
    run(other, smoke_root, tmp_path / "second", start=tmp_path / "first" / "last.pt")
    assert all(
        torch.equal(before[key], value) for key, value in states(tmp_path / "second").items()
    )


@pytest.mark.parametrize("method", ["fixed_uncertainty", "gls", "cagrad", "mgda_ub"])
def test_a_batch_in_parts_trains(method, smoke_cell, smoke_root, tmp_path, with_optim):
    cell = with_optim(replace(smoke_cell, method=method), micro_batch=2)
    run(cell, smoke_root, tmp_path / "parts")
    assert all(float(row["total"]) == float(row["total"]) for row in curve(tmp_path / "parts"))


def test_parts_that_do_not_fill_a_batch_are_refused(smoke_cell, smoke_root, tmp_path, with_optim):
    with pytest.raises(ValueError, match=r"recipe\.optim\.micro_batch"):
        run(with_optim(smoke_cell, micro_batch=3), smoke_root, tmp_path / "run")


def test_tasks_in_place_of_terms(smoke_cell, smoke_root, tmp_path):
    run(replace(smoke_cell, method="fixed", granularity="tasks"), smoke_root, tmp_path / "tasks")
    run(replace(smoke_cell, method="fixed"), smoke_root, tmp_path / "terms")
    rows = curve(tmp_path / "tasks")
    assert [name for name in rows[0] if name.startswith("weight.")] == [
        *("weight.panoptic", "weight.depth")
    ]
    assert {row["weight_sum"] for row in rows} == {"2"}
    first, second = float(rows[0]["total"]), float(curve(tmp_path / "terms")[0]["total"])
    assert first == pytest.approx(second, rel=1e-5)


def test_cosines_are_logged_where_asked_and_change_nothing(
    smoke_cell, smoke_root, tmp_path, with_optim
):
    cell = replace(smoke_cell, granularity="tasks")
    run(cell, smoke_root, tmp_path / "without")
    run(with_optim(cell, cosine_every=3), smoke_root, tmp_path / "with")
    assert_same_state(tmp_path / "without", tmp_path / "with")
    cosines = [row["cosine.panoptic.depth"] for row in curve(tmp_path / "with")]
    assert [bool(text) for text in cosines] == [True, False, False, True, False, False]
    assert all(-1 <= float(text) <= 1 for text in cosines if text)


def test_without_labels_depth_is_masked_automatically(smoke_cell, smoke_root, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(smoke_root, root, ignore=shutil.ignore_patterns("gtFine"))
    depth = replace(smoke_cell, tasks=("depth",), method="fixed")
    assert not depth.recipe.loss.automask
    asked = replace(depth.recipe, loss=replace(depth.recipe.loss, automask=True))
    run(depth, root, tmp_path / "forced")
    run(replace(depth, recipe=asked), root, tmp_path / "asked")
    assert_same_state(tmp_path / "forced", tmp_path / "asked")


def test_two_loss_methods_do_not_compose(smoke_cell):
    with pytest.raises(ValueError, match="is not a loss-value method"):
        build(replace(smoke_cell, method="fixed+uncertainty"), Compute(CPU))
