"""Batches: in training a pure function of seed and step, in evaluation the split in order.

Which samples a step gets follows from (seed, epoch), what happens to them from (seed, step, slot).
A run that starts at any step, in one process or several, therefore sees the same batches.
"""

import hashlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import cv2
import torch
from torch import Generator

from mtl_bench.config import Cell, did_you_mean
from mtl_bench.data.batch import Batch, collate
from mtl_bench.data.cityscapes import Cityscapes

DATASETS = ("synthetic", "cityscapes")  # two names of one layout


def open_dataset(
    cell: Cell, split: str, root: Path, training: bool, sequence_labels: Path | None = None
) -> Cityscapes:
    """The split as the cell's recipe and tasks want it.

    Raises:
        ValueError: an unknown data set, or a folder that lacks what the tasks need.
    """
    recipe = cell.recipe
    if recipe.data.dataset not in DATASETS:
        known = did_you_mean(recipe.data.dataset, DATASETS)
        raise ValueError(f"no data set called '{recipe.data.dataset}'{known}")
    return Cityscapes(
        root,
        split,
        recipe.data,
        video="depth" in cell.tasks,
        panoptic="panoptic" in cell.tasks,
        augment=recipe.augment if training else None,
        loss=recipe.loss,
        sequence_labels=sequence_labels,
    )


def train_batches(
    dataset: Cityscapes, batch_size: int, seed: int, start_step: int = 0, workers: int = 0
) -> Iterator[Batch]:
    """Batches of step `start_step`, `start_step + 1`, ... without end.

    Every epoch is a new order of the whole split; what is left of it after full batches is dropped.

    Args:
        dataset: a training split.
        batch_size: samples a batch.
        seed: the run's seed.
        start_step: the first batch to yield; how a stopped run goes on.
        workers: processes that prepare batches; they keep no decoded frames. 0: this one.

    Raises:
        ValueError: a batch larger than the split.
    """
    if not 0 < batch_size <= len(dataset):
        raise ValueError(
            f"a batch of {batch_size} from {len(dataset)} frames; set recipe.optim.batch to at "
            f"most that"
        )
    steps = _Steps(len(dataset), batch_size, seed, start_step)
    if workers == 0:
        return (_make_batch(dataset, slots) for slots in steps)
    return _from_workers(dataset.uncached(), steps, workers)


def eval_batches(dataset: Cityscapes, batch_size: int) -> Iterator[Batch]:
    """The whole split in order, without augmentation; the last batch may be smaller."""
    for start in range(0, len(dataset), batch_size):
        indices = range(start, min(start + batch_size, len(dataset)))
        yield collate([dataset.sample(index, None) for index in indices])


Slot = tuple[int, int]  # index of a sample, seed of its augmentation


def _make_batch(dataset: Cityscapes, slots: list[Slot]) -> Batch:
    return collate([dataset.sample(index, Generator().manual_seed(seed)) for index, seed in slots])


def _from_workers(dataset: Cityscapes, steps: "_Steps", workers: int) -> Iterator[Batch]:
    loader = torch.utils.data.DataLoader(
        _Batches(dataset),
        sampler=steps,
        batch_size=None,  # an item is a whole batch
        num_workers=workers,
        worker_init_fn=_one_thread,
        generator=Generator(),  # else it draws a seed from the global one, which training uses
    )
    for batch in loader:
        if isinstance(batch, ValueError):
            raise batch
        yield batch


class _Batches(torch.utils.data.Dataset):
    def __init__(self, dataset: Cityscapes) -> None:
        self.dataset = dataset

    def __getitem__(self, slots: list[Slot]) -> Batch | ValueError:
        """A batch, or what is wrong with a file: torch would bury that line in a traceback."""
        try:
            return _make_batch(self.dataset, slots)
        except ValueError as error:
            return error


def _one_thread(worker: int) -> None:
    """As torch does in its workers: more threads than cores would fight over them."""
    cv2.setNumThreads(1)


class _Steps:
    """Iterates over what each step's batch is made of, without end."""

    def __init__(self, samples: int, batch_size: int, seed: int, start_step: int) -> None:
        self.samples, self.batch_size, self.seed = samples, batch_size, seed
        self.start_step = start_step

    def __iter__(self) -> Iterator[list[Slot]]:
        step = self.start_step
        while True:
            epoch, position = divmod(step, self.samples // self.batch_size)
            first = position * self.batch_size
            indices = _order(self.samples, self.seed, epoch)[first : first + self.batch_size]
            yield [
                (index, _hash("augment", self.seed, step, slot))
                for slot, index in enumerate(indices)
            ]
            step += 1


@lru_cache(maxsize=2)
def _order(samples: int, seed: int, epoch: int) -> list[int]:
    generator = Generator().manual_seed(_hash("order", seed, epoch))
    return torch.randperm(samples, generator=generator).tolist()


def _hash(*parts: object) -> int:
    """A generator's seed; neighbouring steps get unrelated ones."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:8]) >> 1
