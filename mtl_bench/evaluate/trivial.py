"""Trivial predictors: what a row must beat before it has learned anything from the image.

Made from the ground truth of the training split alone, and the same for every image; what they are
is each task's own. Of frames that differ in size the nearest pixels count.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from mtl_bench.core import config
from mtl_bench.core.batch import Batch
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.files import write_json
from mtl_bench.core.task import Results, Task, Trivial, tasks_of
from mtl_bench.data.loader import eval_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate.walk import (
    Evaluation,
    Progress,
    frame_truth,
    measure,
    open_walks,
    true_size,
)

VERSION = 2  # raised when the predictors change
BATCH = 8


def baselines(
    cell: config.Cell,
    root: Path,
    cache_dir: Path,
    split: str | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """The trivial predictors' metrics, keyed as `evaluate`'s, of the cell's tasks that have one.

    Kept in `cache_dir`, one file for each data set and protocol.
    """
    recipe = cell.recipe
    tasks = tasks_of(recipe, cell.tasks, dataset_of(recipe).labels)
    walks = open_walks(recipe, tasks, root, split)
    if not walks:
        return measure(cell, walks, lambda batch, asked: {}, torch.device("cpu"))
    for walk in walks:
        walk.samples = walk.samples.uncached()
    training = open_samples(recipe, tasks, "train", root, training=False).uncached()
    settings = {
        "version": [VERSION, config.PROTOCOL],
        "root": str(root.resolve()),
        "data": config.to_dict(dataclasses.replace(recipe.data, cache=False, workers=0)),
        "evaluate": config.to_dict(recipe.evaluate),
        "labels": dataset_of(recipe).labels.name,
        "tasks": list(cell.tasks),
        "frames": [*training.names, *([walk.split, *walk.samples.names] for walk in walks)],
    }
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    path = cache_dir / f"baselines-{key}.json"
    if path.is_file():
        return Evaluation(**json.loads(path.read_text()))

    total = len(training) + sum(len(walk.samples) for walk in walks)
    made: dict[str, Trivial] = {}
    done = 0
    for batch in eval_batches(training, BATCH):
        for task in tasks:
            if task.name not in made:
                predictor = task.trivial(true_size(batch))
                if predictor is not None:
                    made[task.name] = predictor
            for slot in range(len(batch.names) if task.name in made else 0):
                made[task.name].add(frame_truth(task, batch, slot))
        done += len(batch.names)
        if progress:
            progress(done, total)
    if not made:
        raise ValueError("the training split is empty, or no task has a trivial predictor")

    def results(batch: Batch, asked: Sequence[Task]) -> dict[str, Results]:
        count, size = len(batch.names), true_size(batch)
        return {task.name: made[task.name].result(count, size) for task in asked}

    for walk in walks:
        walk.measured = [(task, metric) for task, metric in walk.measured if task.name in made]
        walk.tasks = tuple(task for task in walk.tasks if task.name in made)
    further = None if progress is None else lambda n, of: progress(len(training) + n, total)
    evaluation = measure(cell, walks, results, torch.device("cpu"), BATCH, further)
    evaluation.protocol["engine"] = "none"
    for predictor in made.values():
        evaluation.protocol |= predictor.protocol
    evaluation.samples = {}
    cache_dir.mkdir(parents=True, exist_ok=True)
    write_json(path, {"metrics": evaluation.metrics, "protocol": evaluation.protocol})
    return evaluation
