"""What a finished cell can be asked again: its model, its metrics on any split, its latency."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mtl_bench.bench import results
from mtl_bench.core import provenance
from mtl_bench.core.config import Cell
from mtl_bench.core.device import Engine, choose_device
from mtl_bench.core.quiet import SIDE_BY_SIDE, Quiet
from mtl_bench.data.labels import labels_of
from mtl_bench.data.loader import open_dataset
from mtl_bench.evaluate.export_predictions import export_predictions
from mtl_bench.evaluate.walk import Evaluation, evaluate
from mtl_bench.latency import measure
from mtl_bench.model import Model, side_by_side
from mtl_bench.train import checkpoint
from mtl_bench.train.loop import CHECKPOINT, build

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
    engine = Engine(choose_device(device), cell.recipe.optim.precision)
    model = load_model(cell, checkpoint_path, engine)
    if export is not None:
        export_predictions(model, cell, root, export, engine.device, split)
    return evaluate(model, cell, root, engine.device, split)


def load_model(cell: Cell, path: Path, engine: Engine) -> Model:
    """A cell's model with the weights of a checkpoint.

    Args:
        path: the run's checkpoint. A single-task cell has none: its parents' are taken, in the
            folders beside that one.

    Raises:
        ValueError: no readable checkpoint there, or one of another model.
    """
    if cell.single_task:
        paths = [path.parent.parent / parent.slug / CHECKPOINT for parent in cell.parents]
        pairs = zip(cell.parents, paths, strict=True)
        return side_by_side([load_model(parent, file, engine) for parent, file in pairs])
    state = checkpoint.read(path)
    model = build(cell, labels_of(cell.recipe.data.dataset), engine)[0]
    try:
        model.load_state_dict(state["model"])
    except RuntimeError as error:
        why = str(error).splitlines()[1].strip()
        raise ValueError(f"{path} is not of this cell's model: {why}") from None
    return model


def time_cell(
    model: Model, cell: Cell, root: Path, engine: Engine, quiet: Quiet
) -> tuple[dict[str, Any], float]:
    """The latency protocol over the evaluation split's frames; seconds that it took.

    On all of this process's cores, which are more than its threads where cells run side by side;
    those hold still meanwhile.
    """
    recipe = cell.recipe
    dataset = open_dataset(cell, recipe.evaluate.split, root, training=False)
    first = dataset.sample(0, None)
    frames = (dataset.sample(index, None) for index in range(min(len(dataset), FRAMES)))
    images = [(frame.image_B3HW * 255).round().to(torch.uint8) for frame in frames]
    threads = torch.get_num_threads()
    with quiet.alone(neighbours=SIDE_BY_SIDE in os.environ):
        start = time.perf_counter()
        torch.set_num_threads(max(threads, provenance.cores()))
        timing = measure(
            model,
            images,
            first.K_B33,
            float(first.camera_height_m_B),
            labels_of(recipe.data.dataset).things,
            recipe.evaluate,
            recipe.latency,
            engine.device,
            engine.precision,
        )
        torch.set_num_threads(threads)
        return timing, time.perf_counter() - start


def time_again(
    cell: Cell, run_dir: Path, root: Path, device: str, echo: Callable[[str], None]
) -> None:
    """Replace the latency of a finished cell's row: for one that was taken on a busy machine."""
    engine = Engine(choose_device(device), cell.recipe.optim.precision)
    code, row = provenance.code(cell)["time"], results.load_row(run_dir)
    assert row is not None
    model = load_model(cell, run_dir / CHECKPOINT, engine)
    timing, latency_s = time_cell(model, cell, root, engine, Quiet(run_dir.parent))
    row["metric"] |= timing
    row["time"]["latency_s"] = latency_s
    if "time" in row["code"]:  # not so in a row that an older version stamped
        row["code"]["time"] = code
    row["env_of_latency"] = provenance.environment(engine.device)
    results.write_json(run_dir / "row.json", row)
    echo(f"timed again in {latency_s:.0f} s: {timing['latency.mean_ms']:.1f} ms a frame")
