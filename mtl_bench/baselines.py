"""Trivial predictors: what a row must beat before it has learned anything from the image.

Made from the ground truth of the training split alone, and the same for every image: the mean depth
of each pixel, and the class that each pixel has most often. Things become one instance a class.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from mtl_bench import config, postprocess
from mtl_bench.data.labels import CITYSCAPES20, IGNORE, LabelSet
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.data.targets import class_of_instance_id
from mtl_bench.evaluate import Collector, Evaluation, Prediction, Progress
from mtl_bench.metrics.depth import evaluation_mask

VERSION = 1  # raised when the predictors change
BATCH = 8


def baselines(
    cell: config.Cell,
    root: Path,
    cache_dir: Path,
    split: str | None = None,
    progress: Progress | None = None,
    labels: LabelSet = CITYSCAPES20,
) -> Evaluation:
    """The trivial predictors' metrics, keyed as `evaluate`'s, whatever the cell's tasks are.

    `depth_median` scales the mean depth image like any prediction. `depth_dgc` leaves it as it is:
    it is in metres already. Kept in `cache_dir`, one file for each data set and protocol.
    """
    cell = _plain(cell)
    split = split or cell.recipe.evaluate.split
    training = open_dataset(cell, "train", root, training=False)
    dataset = open_dataset(cell, split, root, training=False)
    settings = {
        "version": [VERSION, config.PROTOCOL],
        "root": str(root.resolve()),
        "data": config.to_dict(cell.recipe.data),
        "evaluate": config.to_dict(cell.recipe.evaluate),
        "labels": labels.name,
        "frames": [split, *training.names, *dataset.names],
    }
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    path = cache_dir / f"baselines-{key}.json"
    if path.is_file():
        return Evaluation(**json.loads(path.read_text()))

    total = len(training) + len(dataset)
    class_HW, depth_m_HW = average(training, cell, labels, progress, total)
    collector = Collector(cell, labels, len(dataset))
    for batch in eval_batches(dataset, BATCH):
        count = len(batch.names)
        collector.update(batch, _constant(class_HW, depth_m_HW, count, cell, labels))
        if progress:
            progress(len(training) + collector.seen, total)
    evaluation = collector.result(split, torch.device("cpu"))
    evaluation.protocol |= {"engine": "none", "dgc_ground": "none: the mean depth is in metres"}
    evaluation.samples = {}
    cache_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.part")
    partial.write_text(
        json.dumps({"metrics": evaluation.metrics, "protocol": evaluation.protocol}, indent=1)
    )
    partial.replace(path)
    return evaluation


def average(
    training: Any, cell: config.Cell, labels: LabelSet, progress: Progress | None, total: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The most frequent class (IGNORE where none was ever seen) and the mean depth of each pixel.

    Ties go to the lowest class. A pixel that never had a valid depth takes its nearest neighbour's.

    Raises:
        ValueError: frames of different sizes, or no valid depth at all.
    """
    ev = config.Evaluate(
        min_depth_m=cell.recipe.evaluate.min_depth_m, max_depth_m=cell.recipe.evaluate.max_depth_m
    )
    class_of_id = class_of_instance_id(labels)
    votes = depth_sum = depth_count = None
    done = 0
    for batch in eval_batches(training, BATCH):
        for name, ids, depth in zip(
            batch.names, batch.instance_ids_BHW, batch.depth_m_BHW, strict=True
        ):
            class_HW, depth_HW = class_of_id[ids.numpy()], depth.numpy()
            if votes is None:
                votes = np.zeros((len(labels), *class_HW.shape), np.int32)
                depth_sum, depth_count = (
                    np.zeros(depth_HW.shape),
                    np.zeros(depth_HW.shape, np.int32),
                )
            if class_HW.shape != votes.shape[1:]:
                raise ValueError(
                    f"{name} is {class_HW.shape}, frames before it {votes.shape[1:]}: "
                    "an average image needs frames of one size"
                )
            for index in np.unique(class_HW[class_HW != IGNORE]):
                votes[index] += class_HW == index
            valid_HW = evaluation_mask(depth_HW, ev)
            depth_sum += np.where(valid_HW, depth_HW, 0)
            depth_count += valid_HW
        done += len(batch.names)
        if progress:
            progress(done, total)
    if votes is None or not depth_count.any():
        raise ValueError("the training split has no frame with a valid depth")
    most_HW = votes.argmax(0).astype(np.uint8)
    most_HW[votes.max(0) == 0] = IGNORE
    nearest = ndimage.distance_transform_edt(
        depth_count == 0, return_distances=False, return_indices=True
    )
    mean_HW = depth_sum / np.maximum(depth_count, 1)
    return most_HW, mean_HW[tuple(nearest)].astype(np.float32)


def _constant(
    class_HW: NDArray, depth_m_HW: NDArray, count: int, cell: config.Cell, labels: LabelSet
) -> Prediction:
    """The same prediction for `count` frames, through the same post-processing as a network's."""
    class_BHW = torch.from_numpy(class_HW).long().expand(count, -1, -1)
    nothing_B1HW = torch.zeros(count, 1, *class_HW.shape)
    panoptic_BHW = postprocess.panoptic(
        class_BHW,
        nothing_B1HW,
        nothing_B1HW.expand(-1, 2, -1, -1),
        labels.things,
        cell.recipe.evaluate,
    )
    return Prediction(
        class_BHW=class_BHW,
        instance_ids_BHW=postprocess.to_instance_ids(panoptic_BHW, labels),
        depth_B1HW=torch.from_numpy(depth_m_HW).expand(count, 1, -1, -1),
        dgc_scale_B=torch.ones(count),
        dgc_source_B=torch.full((count,), postprocess.ROAD),
    )


def _plain(cell: config.Cell) -> config.Cell:
    """The cell with both tasks and without video: the truth is wanted, neighbours are not."""
    return config.from_dict(
        config.Cell, {**config.to_dict(cell), "tasks": list(config.TASKS), "video": False}
    )
