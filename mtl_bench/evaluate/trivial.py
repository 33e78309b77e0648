"""Trivial predictors: what a row must beat before it has learned anything from the image.

Made from the ground truth of the training split alone, and the same for every image: the mean depth
of each pixel, and the class that each pixel has most often. Things become one instance a class.
Of frames that differ in size (KITTI's, by 2 %) the nearest pixels count.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from mtl_bench.core import config
from mtl_bench.data.batch import Batch
from mtl_bench.data.cityscapes import Cityscapes
from mtl_bench.data.labels import IGNORE, LabelSet, labels_of
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.evaluate.collector import DepthScore, add_depth
from mtl_bench.evaluate.walk import (
    Collector,
    Evaluation,
    Pass,
    Prediction,
    Progress,
    open_passes,
    true_size,
)
from mtl_bench.tasks.depth.errors import evaluation_mask
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.targets import class_of_instance_id

VERSION = 2  # raised when the predictors change
BATCH = 8


def baselines(
    cell: config.Cell,
    root: Path,
    cache_dir: Path,
    split: str | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """The trivial predictors' metrics, keyed as `evaluate`'s, of the cell's tasks.

    `depth_median` scales the mean depth image like any prediction. `depth_dgc` leaves it as it is:
    it is in metres already. Kept in `cache_dir`, one file for each data set and protocol.
    """
    cell = dataclasses.replace(cell, video=False, single_task=False)
    labels = labels_of(cell.recipe.data.dataset)
    main, *others = open_passes(cell, root, split)
    training = open_dataset(cell, "train", root, training=False).uncached()
    settings = {
        "version": [VERSION, config.PROTOCOL],
        "root": str(root.resolve()),
        "data": config.to_dict(dataclasses.replace(cell.recipe.data, cache=False, workers=0)),
        "evaluate": config.to_dict(cell.recipe.evaluate),
        "labels": labels.name,
        "tasks": list(cell.tasks),
        "frames": [
            *training.names,
            *([each.measured[0].split, *each.dataset.names] for each in (main, *others)),
        ],
    }
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    path = cache_dir / f"baselines-{key}.json"
    if path.is_file():
        return Evaluation(**json.loads(path.read_text()))

    done, total = 0, sum(map(len, (training, main.dataset, *(each.dataset for each in others))))

    def step(frames: int) -> None:
        nonlocal done
        done += frames
        if progress:
            progress(done, total)

    average = _average(training, cell, labels, step)

    def predictions(each: Pass) -> Iterator[tuple[Batch, Prediction]]:
        for batch in eval_batches(each.dataset.uncached(), BATCH):
            yield batch, _constant(average, batch, each.cell, labels)
            step(len(batch.names))

    collector = Collector(cell, labels, len(main.dataset), main.measured)
    for batch, prediction in predictions(main):
        collector.update(batch, prediction)
    further: list[DepthScore] = []
    for other in others:
        scores = [DepthScore(protocol) for protocol in other.measured]
        for batch, prediction in predictions(other):
            for slot in range(len(batch.names)):
                add_depth(scores, batch, prediction, slot)
        further += scores
    evaluation = collector.result(main.measured[0].split, torch.device("cpu"), further)
    evaluation.protocol |= {"engine": "none", "dgc_ground": "none: the mean depth is in metres"}
    evaluation.samples = {}
    cache_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.part")
    partial.write_text(
        json.dumps({"metrics": evaluation.metrics, "protocol": evaluation.protocol}, indent=1)
    )
    partial.replace(path)
    return evaluation


class Average:
    """The most frequent class and the mean depth of each pixel, frame by frame."""

    def __init__(self, labels: LabelSet, ev: config.Evaluate, size: tuple[int, ...]) -> None:
        self.class_of_id = class_of_instance_id(labels)
        self.ev = dataclasses.replace(ev, depth_crop="none")
        self.votes = np.zeros((len(labels), *size), np.int32)
        self.depth_sum = np.zeros(size)
        self.depth_count = np.zeros(size, np.int32)

    def add(self, instance_ids_HW: Tensor | None, depth_m_HW: Tensor | None) -> None:
        size = self.depth_sum.shape
        if instance_ids_HW is not None:
            class_HW = self.class_of_id[_nearest(instance_ids_HW.numpy(), size)]
            for index in np.unique(class_HW[class_HW != IGNORE]):
                self.votes[index] += class_HW == index
        if depth_m_HW is not None:
            depth_m = _nearest(depth_m_HW.numpy(), size)
            valid_HW = evaluation_mask(depth_m, self.ev)
            self.depth_sum += np.where(valid_HW, depth_m, 0)
            self.depth_count += valid_HW

    def class_HW(self) -> NDArray[np.uint8]:
        """IGNORE where no class was ever seen; ties go to the lowest."""
        most_HW = self.votes.argmax(0).astype(np.uint8)
        most_HW[self.votes.max(0) == 0] = IGNORE
        return most_HW

    def depth_m_HW(self) -> NDArray[np.float32]:
        """Where no depth was ever valid, the nearest pixel's that has one."""
        if not self.depth_count.any():
            raise ValueError("no frame of the training split has a valid depth")
        nearest = ndimage.distance_transform_edt(
            self.depth_count == 0, return_distances=False, return_indices=True
        )
        mean_HW = self.depth_sum / np.maximum(self.depth_count, 1)
        return mean_HW[tuple(nearest)].astype(np.float32)


def _average(
    training: Cityscapes, cell: config.Cell, labels: LabelSet, step: Callable[[int], None]
) -> Average:
    """Average a split's frames, at the first one's size."""
    average = None
    for batch in eval_batches(training, BATCH):
        ids = batch.instance_ids_BHW if "panoptic" in cell.tasks else None
        depth = batch.depth_m_BHW if "depth" in cell.tasks else None
        average = average or Average(labels, cell.recipe.evaluate, true_size(batch))
        for slot in range(len(batch.names)):
            average.add(None if ids is None else ids[slot], None if depth is None else depth[slot])
        step(len(batch.names))
    if average is None:
        raise ValueError("the training split is empty")
    return average


def _nearest(array_HW: NDArray, size: tuple[int, ...]) -> NDArray:
    """At another size: of each pixel the one that its middle falls on."""
    if array_HW.shape == size:
        return array_HW
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int)
        for new, old in zip(size, array_HW.shape, strict=True)
    )
    return array_HW[np.ix_(rows, columns)]


def _constant(average: Average, batch: Batch, cell: config.Cell, labels: LabelSet) -> Prediction:
    """The same prediction for every frame, through the same post-processing as a network's."""
    count, size = len(batch.names), true_size(batch)
    prediction = Prediction()
    if "panoptic" in cell.tasks:
        class_HW = _nearest(average.class_HW(), size)
        class_BHW = torch.from_numpy(class_HW).long().expand(count, -1, -1)
        nothing_B2HW = torch.zeros(count, 2, *class_BHW.shape[1:])
        panoptic_BHW = postprocess.panoptic(
            class_BHW, nothing_B2HW[:, :1], nothing_B2HW, labels.things, cell.recipe.evaluate
        )
        prediction.class_BHW = class_BHW
        prediction.instance_ids_BHW = postprocess.to_instance_ids(panoptic_BHW, labels)
    if "depth" in cell.tasks:
        depth_m_HW = torch.from_numpy(_nearest(average.depth_m_HW(), size))
        prediction.depth_B1HW = depth_m_HW.expand(count, 1, -1, -1)
        prediction.dgc_scale_B = torch.ones(count)
        prediction.dgc_source_B = torch.full((count,), postprocess.ROAD)
    return prediction
