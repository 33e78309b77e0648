"""One cell, whole: train, evaluate, time, and the row that says so."""

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.jobs import CELLS
from mtl_bench.bench.stored import load_model, time_again, time_cell
from mtl_bench.core import provenance
from mtl_bench.core.config import Cell
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import Compute, choose_device
from mtl_bench.core.files import read_json, replacing, write_json
from mtl_bench.core.plain import from_dict, to_dict
from mtl_bench.core.ranks import ALONE, Processes, Ranks
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate.labels import label
from mtl_bench.evaluate.walk import (
    Evaluation,
    evaluate,
    evaluate_together,
    evaluating,
    open_walks,
    rehearse,
)
from mtl_bench.model import Model
from mtl_bench.train import checkpoint
from mtl_bench.train.curve import data_share, training_time
from mtl_bench.train.loop import CHECKPOINT, check_equal, train
from mtl_bench.train.progress import Interrupted, Listening, Progress
from mtl_bench.train.tracking import Tracker

CURVE = "curve.csv"
TAKEN = "taken.json"  # what training took beside the curve's steps, for a run that is continued


@dataclass
class Trained:
    """A cell's model, and what it took to get it."""

    model: Model
    time: dict[str, float]  # train_s, step_ms, data_share, peak_mib; of a video cell also pseudo_s
    protocol: dict[str, Any]


def run_cell(
    cell: Cell,
    run_dir: Path,
    root: Path,
    device: str = "auto",
    wandb: str = "off",
    echo: Callable[[str], None] = print,
    ranks: Ranks = ALONE,
) -> dict[str, Any]:
    """Run what is left of a cell and write its row; every stage can be killed and run again.

    Args:
        run_dir: the cell's folder, which exists (see `store.begin`).
        root: the data set.
        echo: where lines of text go.
        ranks: that run it together; this is their first, and the others `follow`.

    Returns:
        The row, as `row.json` has it.

    Raises:
        ValueError: a parent of the cell has no result or no checkpoint, or the data set lacks what
            its evaluation or the video stage needs.
    """
    compute = Compute(choose_device(device, ranks), cell.recipe.optim.precision)
    progress = Progress(run_dir, echo)
    progress.catch_signals()
    tracker = Tracker(wandb, cell, run_dir)
    code, environment = provenance.code(cell), provenance.environment(compute.device)
    environment["ranks"] = ranks.size
    write_json(run_dir / "env.json", environment)

    data, tasks = Data(root), tasks_of_cell(cell)
    open_walks(cell.recipe, tasks, root)  # what would stop the evaluation is told at once
    record = data.of(cell)
    if cell.video and not dataset_of(cell.recipe).takes_further_labels:
        raise ValueError(
            f"video trains on labels of further frames, and {cell.recipe.data.dataset} takes no "
            f"further labels; set video=false"
        )
    if cell.single_task:
        trained = _trained_apart(cell, run_dir, compute, data)
    else:
        trained = _train(cell, run_dir, root, compute, progress, tracker, data, ranks)
    model, took = trained.model, trained.time
    echo(f"trained in {took['train_s']:.0f} s ({took['step_ms']:.0f} ms a step)")

    _tell(ranks, "evaluate", cell, compute, root=root, run_dir=run_dir)
    evaluation, eval_s = _evaluate(model, cell, root, compute, progress, ranks)
    _save_samples(run_dir / "samples.npz", evaluation.samples)

    progress.update("latency", 0, 1)
    timing, latency_s = time_cell(model, cell, root, compute, progress.quiet)
    if timing:
        echo(f"timed in {latency_s:.0f} s: {timing['latency.mean_ms']:.1f} ms a frame")

    row = {
        **CELLS.identity(cell),
        "status": "done",
        "metric": {**evaluation.metrics, **timing},
        "protocol": {**evaluation.protocol, **_training_protocol(cell, root), **trained.protocol},
        "time": {**took, "eval_s": eval_s, "latency_s": latency_s},
        "code": code,
        "data": record,
        "env": environment,
    }
    tracker.log({key: value for key, value in row["metric"].items() if not isinstance(value, str)})
    tracker.finish()
    write_json(run_dir / "row.json", row)
    return row


def renew(
    cell: Cell, run_dir: Path, root: Path, device: str = "auto", echo: Callable[[str], None] = print
) -> None:
    """Evaluate and time a trained cell again, as far as its row is of other code or data; never
    train.

    A row that an older version stamped, or whose data's files were written anew, is stamped anew
    where its checkpoint gives back every metric (latency apart), bit for bit. Where it does not,
    the row is stale for training from then on.
    """
    row, data = store.load_row(run_dir), Data(root)
    assert row is not None
    code = provenance.code(cell)
    stale = store.changed({**row["code"], "data": row.get("data")}, cell, data)
    unsure = store.unsure(stale)
    if "evaluate" in stale:
        if cell.single_task:
            for parent in cell.parents:
                _result_of(parent, run_dir.parent, data)
        compute = Compute(choose_device(device), cell.recipe.optim.precision)
        if not cell.single_task:
            checkpoint.require(run_dir / CHECKPOINT, cell)
        model, progress = load_model(cell, run_dir / CHECKPOINT, compute), Progress(run_dir, echo)
        evaluation, eval_s = _evaluate(model, cell, root, compute, progress)
        timing = {k: v for k, v in row["metric"].items() if k.startswith("latency.")}
        before = {k: v for k, v in row["metric"].items() if k not in timing}
        after = {key: evaluation.metrics.get(key) for key in before}
        if unsure and json.dumps(before) != json.dumps(after):  # as text: NaN equals itself
            different = sum(json.dumps(before[k]) != json.dumps(after[k]) for k in before)
            row["code"] = {stage: {} for stage in code}
            write_json(run_dir / "row.json", row)
            echo(
                f"{different} of {len(before)} metrics differ from those of the row, which stays "
                f"as it is: stale, to be trained again"
            )
            return
        row["metric"] = {**evaluation.metrics, **timing}
        row["protocol"] |= evaluation.protocol
        if unsure:
            echo("every metric is that of the row, which is stamped anew")
        else:
            row["time"]["eval_s"] = eval_s
            row["env_of_evaluation"] = provenance.environment(compute.device)
            _save_samples(run_dir / "samples.npz", evaluation.samples)
    again = stale.get("time", provenance.STAMPED_BEFORE) != provenance.STAMPED_BEFORE
    row["data"] = data.of(cell)
    row["code"] = {**code, "time": row["code"]["time"]} if again else code
    write_json(run_dir / "row.json", row)
    if again:
        time_again(cell, run_dir, root, device, echo)


def _evaluate(
    model: Model,
    cell: Cell,
    root: Path,
    compute: Compute,
    progress: Progress,
    ranks: Ranks = ALONE,
) -> tuple[Evaluation, float]:
    """With the seconds that it took."""
    start = time.perf_counter()

    def note(done: int, of: int) -> None:
        progress.update("evaluate", done, of)

    if ranks.size == 1:
        evaluation = evaluate(model, cell, root, compute.device, progress=note)
    else:
        evaluation = _evaluate_together(model, cell, root, compute, ranks, note)
    eval_s = time.perf_counter() - start
    progress.say(f"evaluated in {eval_s:.0f} s: {CELLS.headline(evaluation.metrics)}")
    return evaluation, eval_s


def _evaluate_together(
    model: Model,
    cell: Cell,
    root: Path,
    compute: Compute,
    ranks: Ranks,
    note: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Of rank 0 the evaluation, of another one an empty one."""
    check_equal(model, ranks, cell.recipe.optim.steps)
    with ranks.sharing_cores():
        return evaluate_together(model, cell, root, compute.device, ranks, progress=note)


# --- training -------------------------------------------------------------------------------------


def _train(
    cell: Cell,
    run_dir: Path,
    root: Path,
    compute: Compute,
    progress: Progress,
    tracker: Tracker,
    data: Data,
    ranks: Ranks,
) -> Trained:
    """Train, from the parent's checkpoint on where there is one, or with the weights of its curve;
    a video cell also on labels that this one made."""
    taken: dict[str, Any] = read_json(run_dir / TAKEN) or {}
    start = record = further_labels = None
    protocol = {}
    for parent in cell.parents:
        of_parent = store.data_for(parent, cell, data)
        if cell.replay is not None:
            _, record = _result_of(parent, run_dir.parent, of_parent, CURVE)
        else:
            _, start = _result_of(parent, run_dir.parent, of_parent)
    if cell.video:
        assert start is not None
        _tell(ranks, "label", cell, compute, root=root, run_dir=run_dir, start=start)
        further_labels, frames = _pseudo_labels(
            cell, start, root, run_dir, compute, progress, taken, ranks
        )
        protocol = {"pseudo_frames": frames}
    if compute.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(compute.device)
    given = (cell, root, run_dir, compute, progress, tracker)
    rehearsal = partial(rehearse, cell=cell, root=root, device=compute.device)
    paths = {"start": start, "record": record, "further_labels": further_labels}
    _tell(ranks, "train", cell, compute, root=root, run_dir=run_dir, **paths)
    with ranks.sharing_cores():
        model = train(
            *given,
            ranks=ranks,
            start=start,
            further_labels=further_labels,
            record=record,
            rehearse=rehearsal,
        )
    taken["peak_mib"] = max(taken.get("peak_mib", 0.0), _peak_mib(compute.device))
    write_json(run_dir / TAKEN, taken)
    train_s, step_ms = training_time(run_dir / "curve.csv")
    waited = {"data_share": data_share(run_dir / "curve.csv")}
    return Trained(model, {"train_s": train_s, "step_ms": step_ms, **waited, **taken}, protocol)


def _pseudo_labels(
    cell: Cell,
    parent_checkpoint: Path,
    root: Path,
    run_dir: Path,
    compute: Compute,
    progress: Progress,
    taken: dict[str, Any],
    ranks: Ranks,
) -> tuple[Path, int]:
    """Make what labels are missing; their folder and number. `taken` gets the seconds."""
    model = load_model(cell.parents[0], parent_checkpoint, compute)
    counts: list[int] = []  # of labelled frames: at the start, and after each

    def note(done: int, of: int) -> None:
        counts.append(done)
        progress.update("pseudo-label", done, of)
        if progress.stop_asked:
            raise Interrupted(f"stopped at pseudo label {done} of {of}, kept in {run_dir}")

    began = time.perf_counter()
    kind = dataset_of(cell.recipe)
    frames = kind.frames_to_label(root, run_dir / "pseudo_labels", "train", cell.recipe)
    task = next(task for task in model.tasks if task.makes_labels)
    with evaluating(model), ranks.sharing_cores():
        folder = label(task, model, frames, compute.device, ranks, note)
    made = counts[-1] - counts[0]
    if made and ranks.first:  # a run that was killed here made the others, as fast
        taken["pseudo_s"] = (time.perf_counter() - began) * counts[-1] / made
        write_json(run_dir / TAKEN, taken)
        progress.say(f"labelled {made} frames in {taken['pseudo_s']:.0f} s")
    return folder, counts[-1]


def _trained_apart(cell: Cell, run_dir: Path, compute: Compute, data: Data) -> Trained:
    """The networks of a single-task cell's parents, side by side."""
    times = [_result_of(parent, run_dir.parent, data)[0]["time"] for parent in cell.parents]
    took = {key: sum(time[key] for time in times) for key in ("train_s", "step_ms")}
    took["peak_mib"] = max(time["peak_mib"] for time in times)
    return Trained(load_model(cell, run_dir / CHECKPOINT, compute), took, {})


def _result_of(
    parent: Cell, runs: Path, data: Data | None, file: str = CHECKPOINT
) -> tuple[dict[str, Any], Path]:
    """Row and checkpoint, or another file, of a cell that another needs.

    Raises:
        ValueError: it lacks one of them, or they are of other code or data.
    """
    state = store.stored(parent, runs, data)
    path = store.run_dir(parent, runs) / file
    if not state.trained or state.row is None or not path.is_file():
        word = f"here without its {file}" if state.trained else state.word
        why = f" ({state.why})" if state.why else ""
        remedy = "run that one again" + ", or collect it with that" * state.trained
        raise ValueError(f"this cell needs {path.parent}, which is {word}{why}: {remedy}")
    if file == CHECKPOINT:
        checkpoint.require(path, parent)
    return state.row, path


# --- several ranks --------------------------------------------------------------------------------


def _tell(ranks: Ranks, stage: str, cell: Cell, compute: Compute, **paths: Path | None) -> None:
    """Say to the ranks behind the first what this one is about to do."""
    told = {name: None if path is None else str(path.resolve()) for name, path in paths.items()}
    ranks.tell({"stage": stage, "cell": to_dict(cell), **told}, compute.device)


def follow(ranks: Processes, device: str = "auto") -> None:
    """Of a rank behind the first: do with it what it does, until it has ended."""
    while (told := ranks.told()) is not None:
        stage, cell = told.pop("stage"), from_dict(Cell, told.pop("cell"))
        root, run_dir = Path(told.pop("root")), Path(told.pop("run_dir"))
        paths = {name: None if path is None else Path(path) for name, path in told.items()}
        compute = Compute(choose_device(device, ranks), cell.recipe.optim.precision)
        progress = Listening(run_dir, print)
        progress.catch_signals()
        ranks.begin(compute.device)
        if stage == "label":
            start = paths["start"]
            assert start is not None
            _pseudo_labels(cell, start, root, run_dir, compute, progress, {}, ranks)
        elif stage == "train":
            train(
                *(cell, root, run_dir, compute, progress, Tracker("off", cell, run_dir)),
                ranks=ranks,
                start=paths["start"],
                further_labels=paths["further_labels"],
                record=paths["record"],
            )
        else:
            model = load_model(cell, run_dir / CHECKPOINT, compute)
            _evaluate_together(model, cell, root, compute, ranks)


# --- parts ----------------------------------------------------------------------------------------


def _peak_mib(device: torch.device) -> float:
    """Most memory that training held: of CUDA's allocator, or all that this process ever had."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def _training_protocol(cell: Cell, root: Path) -> dict[str, Any]:
    """What the data set and the tasks say of the training frames."""
    tasks = tasks_of_cell(cell)
    dataset = open_samples(cell.recipe, tasks, "train", root, training=True).dataset
    protocol: dict[str, Any] = {"training": dataset.described} if dataset.described else {}
    for task in tasks:
        protocol |= task.training_protocol(dataset)
    return protocol


def _save_samples(path: Path, samples: dict[str, Any]) -> None:
    with replacing(path) as file:
        np.savez_compressed(file, **samples)
