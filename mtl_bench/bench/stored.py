"""What a finished cell can be asked again: its model, its metrics on any split, its latency."""

import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mtl_bench.bench import store
from mtl_bench.bench.jobs import load_run
from mtl_bench.core import plugins, provenance
from mtl_bench.core.batch import collate
from mtl_bench.core.config import Cell
from mtl_bench.core.device import Compute, choose_device
from mtl_bench.core.files import write_json
from mtl_bench.core.locks import SIDE_BY_SIDE, Quiet
from mtl_bench.core.recipe import NOTHING, Latency
from mtl_bench.core.task import Results
from mtl_bench.data.loader import eval_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.deploy.timer import measure
from mtl_bench.evaluate.walk import Evaluation, evaluate, evaluating, predict, true_size
from mtl_bench.model import Model, side_by_side
from mtl_bench.train import checkpoint
from mtl_bench.train.loop import CHECKPOINT, build

TRIED = 10  # passes of each number of threads
FRAMES = 100  # that are timed in turn: all are held in memory, 6 MB each at 1024x2048


def reevaluate(
    cell: Cell,
    checkpoint_path: Path,
    root: Path,
    device: str = "auto",
    split: str | None = None,
    export: Path | None = None,
) -> Evaluation:
    """Evaluate a stored checkpoint again, on any split.

    Args:
        export: folder for the panoptic predictions, in Cityscapes' format.
    """
    compute = Compute(choose_device(device), cell.recipe.optim.precision)
    model = load_model(cell, checkpoint_path, compute)
    if export is not None:
        export_predictions(model, cell, root, export, compute.device, split)
    return evaluate(model, cell, root, compute.device, split)


def export_predictions(
    model: Model, cell: Cell, root: Path, out: Path, device: torch.device, split: str | None = None
) -> None:
    """Predict a split (None: the recipe's) and write it as official evaluators read it.

    Raises:
        ValueError: no task of the cell has such files.
    """
    split = split or cell.recipe.evaluate.split
    samples = open_samples(cell.recipe, model.tasks, split, root, training=False)

    def frames(name: str) -> Iterator[tuple[str, Results]]:
        for batch in eval_batches(samples, 8):
            found = predict(model, batch.to(device), model.tasks, true_size(batch))[name]
            for slot, frame in enumerate(batch.names):
                yield frame, {key: value[slot].cpu() for key, value in found.items()}

    with evaluating(model), torch.inference_mode():
        written = [task.write_results(out, split, frames(task.name)) for task in model.tasks]
    if not any(written):
        raise ValueError(f"no task of cell {cell.slug} has results to export")


def load_model(cell: Cell, path: Path, compute: Compute) -> Model:
    """A cell's model with the weights of a checkpoint.

    Args:
        path: the run's checkpoint. A single-task cell has none: its parents' are taken, in the
            folders beside that one.

    Raises:
        ValueError: no readable checkpoint there, or one of another model.
    """
    if cell.single_task:
        parents = {parent.tasks[0]: parent for parent in cell.parents}
        ordered = [parents[task] for task in plugins.ordered(parents)]
        paths = [path.parent.parent / parent.slug / CHECKPOINT for parent in ordered]
        pairs = zip(ordered, paths, strict=True)
        return side_by_side([load_model(parent, file, compute) for parent, file in pairs])
    state = checkpoint.read(path)
    whole = "constants" in state  # then it needs no initial weights, whose file may be elsewhere
    model = build(replace(cell, pretrained=None) if whole else cell, compute)[0]
    checkpoint.load(path, state, "model", model)
    return model


def deployed(path: Path, tasks: tuple[str, ...] | None) -> tuple[Cell, Model]:
    """A trained cell and its model, as it is deployed.

    Args:
        path: a run's folder, or its checkpoint.
        tasks: leave only these; None: all that it was trained for.

    Raises:
        ValueError: no checkpoint there, or it has not been trained for a task.
    """
    cell, weights = load_run(path)
    model = load_model(cell, weights, Compute(torch.device("cpu")))
    lacking = [task for task in tasks or () if task not in cell.tasks]
    if lacking:
        raise ValueError(f"{path} is trained for {', '.join(cell.tasks)}, not for {lacking[0]}")
    model.keep(tasks or cell.tasks)
    return cell, model


def time_cell(
    model: Model, cell: Cell, root: Path, compute: Compute, quiet: Quiet
) -> tuple[dict[str, Any], float]:
    """The latency protocol over the evaluation split's frames, nothing where it has no passes;
    seconds that it took.

    On as many threads of this process's cores as are quickest; cells that run side by side with
    this one hold still meanwhile.
    """
    recipe = cell.recipe
    if recipe.latency.passes == 0:
        return {}, 0.0
    measured = model.tasks if recipe.evaluate.split != NOTHING else ()  # else there is no truth
    samples = open_samples(recipe, measured, recipe.evaluate.images, root, training=False)
    frames = [samples.sample(index, None) for index in range(min(len(samples), FRAMES))]
    camera = collate(frames[:1]).camera
    assert camera is not None
    images = [(frame.image_B3HW * 255).round().to(torch.uint8) for frame in frames]

    def timed(latency: Latency) -> dict[str, Any]:
        return measure(model, images, camera, latency, compute.device, compute.precision)

    def of_threads(count: int) -> float:
        torch.set_num_threads(count)
        return float(timed(replace(recipe.latency, passes=TRIED))["latency.p50_ms"])

    threads = torch.get_num_threads()
    with quiet.alone(neighbours=SIDE_BY_SIDE in os.environ):
        start = time.perf_counter()
        torch.set_num_threads(quickest(max(threads, provenance.cores()), of_threads))
        timing = timed(recipe.latency)
        torch.set_num_threads(threads)
        return timing, time.perf_counter() - start


def quickest(most: int, ms: Callable[[int], float]) -> int:
    """Of 1, 2, 4 ... and `most` threads those that take the fewest milliseconds.

    Operators of a small network take less time than waking a second thread does: ResNet18 at 64x128
    took 40 ms on two threads, 26 on one.
    """
    counts = [*itertools.takewhile(lambda n: n < most, (2**k for k in itertools.count())), most]
    return min(counts, key=ms) if len(counts) > 1 else most


def time_again(
    cell: Cell, run_dir: Path, root: Path, device: str, echo: Callable[[str], None]
) -> None:
    """Replace the latency of a finished cell's row: for one that was taken on a busy machine."""
    compute = Compute(choose_device(device), cell.recipe.optim.precision)
    code, row = provenance.code(cell)["time"], store.load_row(run_dir)
    assert row is not None
    model = load_model(cell, run_dir / CHECKPOINT, compute)
    timing, latency_s = time_cell(model, cell, root, compute, Quiet(run_dir.parent))
    row["metric"] |= timing
    row["time"]["latency_s"] = latency_s
    if "time" in row["code"]:  # not so in a row that an older version stamped
        row["code"]["time"] = code
    row["env_of_latency"] = provenance.environment(compute.device)
    write_json(run_dir / "row.json", row)
    if timing:
        echo(f"timed again in {latency_s:.0f} s: {timing['latency.mean_ms']:.1f} ms a frame")
    else:
        echo("nothing to time: recipe.latency.passes is 0")
