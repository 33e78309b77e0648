"""One cell, whole: train, evaluate, time, and the row that says so."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mtl_bench import checkpoint, provenance, results
from mtl_bench.config import Cell, to_dict
from mtl_bench.curve import training_time
from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.data.loader import open_dataset
from mtl_bench.engine import Engine, choose_device
from mtl_bench.evaluate import Evaluation, evaluate
from mtl_bench.export_predictions import export_predictions
from mtl_bench.latency import measure
from mtl_bench.model import Model
from mtl_bench.progress import Progress
from mtl_bench.tracking import Tracker
from mtl_bench.train import build, train

LABELS = CITYSCAPES20


def run_cell(
    cell: Cell,
    run_dir: Path,
    root: Path,
    device: str = "auto",
    wandb: str = "off",
    echo: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Run what is left of a cell and write its row; every stage can be killed and run again.

    Args:
        run_dir: the cell's folder, which exists (see `results.begin`).
        root: the data set.
        echo: where lines of text go.

    Returns:
        The row, as `row.json` has it.
    """
    engine = Engine(choose_device(device), cell.recipe.optim.precision)
    progress = Progress(run_dir, echo)
    progress.catch_signals()
    tracker = Tracker(wandb, cell, run_dir)
    environment = provenance.environment(engine.device)
    results.write_json(run_dir / "env.json", environment)

    model = train(cell, LABELS, root, run_dir, engine, progress, tracker)
    train_s, step_ms = training_time(run_dir / "curve.csv")
    echo(f"trained {cell.recipe.optim.steps} steps in {train_s:.0f} s ({step_ms:.0f} ms a step)")

    start = time.perf_counter()
    evaluation = evaluate(
        model, cell, root, engine.device, progress=lambda n, of: progress.update("evaluate", n, of)
    )
    eval_s = time.perf_counter() - start
    echo(f"evaluated in {eval_s:.0f} s: {results.headline(evaluation.metrics)}")
    _save_samples(run_dir / "samples.npz", evaluation.samples)

    start = time.perf_counter()
    timing = time_cell(model, cell, root, engine)
    latency_s = time.perf_counter() - start
    echo(f"timed in {latency_s:.0f} s: {timing['latency.mean_ms']:.1f} ms a frame")

    row = {
        **_identity(cell),
        "metric": {**evaluation.metrics, **timing},
        "protocol": evaluation.protocol,
        "time": {"train_s": train_s, "step_ms": step_ms, "eval_s": eval_s, "latency_s": latency_s},
        "code": provenance.code(cell),
        "env": environment,
    }
    tracker.log({key: value for key, value in row["metric"].items() if not isinstance(value, str)})
    tracker.finish()
    results.write_json(run_dir / "row.json", row)
    return row


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


def load_model(cell: Cell, path: Path, engine: Engine, labels: LabelSet = LABELS) -> Model:
    """A cell's model with the weights of a checkpoint.

    Raises:
        ValueError: no readable checkpoint there, or one of another model.
    """
    state = checkpoint.read(path)
    model = build(cell, labels, engine)[0]
    try:
        model.load_state_dict(state["model"])
    except RuntimeError as error:
        why = str(error).splitlines()[1].strip()
        raise ValueError(f"{path} is not of this cell's model: {why}") from None
    return model


def time_cell(model: Model, cell: Cell, root: Path, engine: Engine) -> dict[str, Any]:
    """The latency protocol over the evaluation split's frames."""
    recipe = cell.recipe
    dataset = open_dataset(cell, recipe.evaluate.split, root, training=False)
    batches = [dataset.sample(index, None) for index in range(len(dataset))]
    return measure(
        model,
        (sample.image_B3HW for sample in batches),
        batches[0].K_B33,
        float(batches[0].camera_height_m_B),
        LABELS.things,
        recipe.evaluate,
        recipe.latency,
        engine.device,
        engine.precision,
    )


def _identity(cell: Cell) -> dict[str, Any]:
    """What a row says of its cell; rows travel, so a weights file goes without its folder."""
    values = to_dict(cell)
    if cell.pretrained is not None:
        values["pretrained"] = Path(cell.pretrained).name
    return {
        "cell_id": cell.id,
        "slug": cell.slug,
        "status": "done",
        "method": cell.method,
        "backbone": cell.backbone,
        "tasks": list(cell.tasks),
        "seed": cell.seed,
        "video": cell.video,
        "pretrained": values["pretrained"],
        "recipe": cell.recipe.name,
        "smoke": cell.recipe.smoke,
        "cell": values,
    }


def _save_samples(path: Path, samples: dict[str, Any]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **samples)
    temporary.replace(path)
