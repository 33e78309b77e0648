"""Batches: in training a pure function of seed and step, in evaluation the split in order.

Which samples a step gets follows from (seed, epoch), what happens to them from (seed, step, slot).
A run that starts at any step, in one process or several, therefore sees the same batches.
"""

import hashlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

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
    if workers == 0:
        return _in_process(dataset, batch_size, seed, start_step)
    loader = torch.utils.data.DataLoader(
        _Slots(dataset.uncached()),
        batch_sampler=_Steps(len(dataset), batch_size, seed, start_step),
        num_workers=workers,
        collate_fn=collate,
    )
    return iter(loader)


def eval_batches(dataset: Cityscapes, batch_size: int) -> Iterator[Batch]:
    """The whole split in order, without augmentation; the last batch may be smaller."""
    for start in range(0, len(dataset), batch_size):
        indices = range(start, min(start + batch_size, len(dataset)))
        yield collate([dataset.sample(index, None) for index in indices])


Slot = tuple[int, int]  # index of a sample, seed of its augmentation


def _in_process(
    dataset: Cityscapes, batch_size: int, seed: int, start_step: int
) -> Iterator[Batch]:
    slots = _Slots(dataset)
    for step in _Steps(len(dataset), batch_size, seed, start_step):
        yield collate([slots[slot] for slot in step])


class _Slots(torch.utils.data.Dataset):
    def __init__(self, dataset: Cityscapes) -> None:
        self.dataset = dataset

    def __getitem__(self, slot: Slot) -> Batch:
        index, augment_seed = slot
        return self.dataset.sample(index, Generator().manual_seed(augment_seed))


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
