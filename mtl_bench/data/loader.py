"""Batches: in training a pure function of seed and step, in evaluation the split in order.

Which samples a step gets follows from (seed, epoch), what happens to them from (seed, step, slot).
A run that starts at any step, in one process or several, therefore sees the same batches.
"""

import dataclasses
import hashlib
import itertools
import math
import signal
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any

import cv2
import torch
from torch import Generator, Tensor

from mtl_bench.core.batch import Batch, collate
from mtl_bench.core.ranks import Ranks
from mtl_bench.data.samples import Samples

# Batches that each worker has ready or under way. One is enough: a worker goes on as soon as its
# batch is fetched, and every further one takes a batch's memory (1.3 GB at the paper's size).
AHEAD = 1
_DIED = "DataLoader worker (pid"  # how torch's error begins


def train_batches(
    samples: Samples,
    batch_size: int,
    seed: int,
    start_step: int = 0,
    workers: int = 0,
    pinned: bool = False,
    share: tuple[int, int] = (0, 1),
) -> Iterator[Batch]:
    """Batches of step `start_step`, `start_step + 1`, ... without end.

    Every epoch is a new order of the whole split; what is left of it after full batches is dropped.

    Args:
        samples: of a training split.
        batch_size: samples a batch.
        seed: the run's seed.
        start_step: the first batch to yield; how a stopped run goes on.
        workers: processes that prepare batches; they keep no decoded frames. 0: this one.
        pinned: with workers, batches in memory from which a GPU copies by itself.
        share: which of how many equal shares of each batch's samples, of consecutive ones; the
            workers are shared, too.

    Raises:
        ValueError: a batch larger than the split; while iterating, a broken file, or workers that
            the system ended.
    """
    if not 0 < batch_size <= len(samples):
        raise ValueError(
            f"a batch of {batch_size} from {len(samples)} frames; set recipe.optim.batch to at "
            f"most that"
        )
    steps = _Steps(len(samples), batch_size, seed, start_step, share)
    workers = math.ceil(workers / share[1])
    if workers == 0:
        return (_batch(samples, slots) for slots in steps)
    return _from_workers(samples.uncached(), steps, workers, pinned)


def eval_batches(samples: Samples, batch_size: int) -> Iterator[Batch]:
    """The whole split in order, without augmentation.

    A batch is smaller where the split ends, or where the next frame's truth has another size.
    """
    taken: list[Batch] = []
    for index in range(len(samples)):
        sample = samples.sample(index, None)
        if taken and (len(taken) == batch_size or _sizes(sample) != _sizes(taken[0])):
            yield collate(taken)
            taken = []
        taken.append(sample)
    if taken:
        yield collate(taken)


def eval_rounds(
    samples: Samples, batch_size: int, ranks: Ranks
) -> Iterator[list[tuple[int, Batch]]]:
    """The batches of `eval_batches`, shared by ranks: of every round those of this rank.

    Each rank reads as many frames a round as a batch has, so as a rule it has one batch, in the
    order of the ranks. Where the truth's size changes within them it may have none or several; a
    batch is of the rank that has read its first frame.

    Yields:
        Batches, each with the place of its first frame in the split.
    """
    start = 0
    while start < len(samples):
        first = start + ranks.rank * batch_size
        own = range(first, min(first + batch_size, len(samples)))
        read = {index: samples.sample(index, None) for index in own}
        shapes = ranks.gather([_sizes(sample) for sample in read.values()])
        cuts = _cuts([shape for of_rank in shapes for shape in of_rank], batch_size)
        if cuts[-1] - cuts[-2] < batch_size and start + cuts[-1] < len(samples):
            cuts.pop()  # the last one may go on in frames that nobody has read yet
        spans = [range(start + a, start + b) for a, b in itertools.pairwise(cuts)]
        yield [
            (span[0], collate([read[i] if i in read else samples.sample(i, None) for i in span]))
            for span in spans
            if span[0] in read
        ]
        start += cuts[-1]


def _cuts(shapes: list[Any], batch_size: int) -> list[int]:
    """Where batches begin, and the last one ends, by the shapes of consecutive frames' truths."""
    cuts = [0]
    for index, shape in enumerate(shapes):
        if index - cuts[-1] == batch_size or shape != shapes[cuts[-1]]:
            cuts.append(index)
    return [*cuts, len(shapes)]


def _sizes(sample: Batch) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in sample.fields.items()}


# Index of a sample; what the seed of its augmentation is made of, where it has any
Slot = tuple[int, tuple[str, int, int, int]]


def _batch(samples: Samples, slots: list[Slot]) -> Batch:
    """One step's samples; taken out of a tensor of all where they are the same every time."""
    whole = samples.whole
    if whole is None:
        return collate(list(_drawn(samples, slots)))
    indices = [index for index, _ in slots]
    chosen = torch.tensor(indices)
    names = [whole.names[index] for index in indices]
    return dataclasses.replace(whole.map(lambda value: value[chosen]), names=names)


def _drawn(samples: Samples, slots: list[Slot]) -> Iterator[Batch]:
    return (samples.sample(index, Generator().manual_seed(_hash(*key))) for index, key in slots)


def _from_workers(samples: Samples, steps: "_Steps", workers: int, pinned: bool) -> Iterator[Batch]:
    loader = torch.utils.data.DataLoader(
        _Batches(samples),
        sampler=steps,
        batch_size=None,  # an item is a whole batch
        num_workers=workers,
        prefetch_factor=AHEAD,
        pin_memory=pinned,
        worker_init_fn=_begin_worker,
        generator=Generator(),  # else it draws a seed from the global one, which training uses
    )
    batches = iter(loader)
    while True:
        try:
            fields = next(batches)
        except RuntimeError as error:
            if not str(error).startswith(_DIED):
                raise
            raise ValueError(
                f"a data-loading process was ended ({str(error).splitlines()[0]}): lower "
                f"recipe.data.workers, or give it more memory and /dev/shm more room"
            ) from error
        if isinstance(fields, ValueError):
            raise fields
        yield Batch.from_tensors(*fields)


class _Batches(torch.utils.data.Dataset[Any]):
    def __init__(self, samples: Samples) -> None:
        self.samples = samples

    def __getitem__(self, slots: list[Slot]) -> tuple[list[str], dict[str, Tensor]] | ValueError:
        """A batch's names and tensors, or what is wrong with a file: torch would bury that line in
        a traceback. Plain lists and dictionaries are what torch knows how to pin."""
        try:
            return _collate_shared(_drawn(self.samples, slots), len(slots))
        except ValueError as error:
            return error


def _collate_shared(samples: Iterable[Batch], count: int) -> tuple[list[str], dict[str, Tensor]]:
    """As `collate`, but straight into the memory that processes share, and sample by sample: one
    copy less, and not all samples beside the batch, which takes a gigabyte of Cityscapes' frames.
    """
    names: list[str] = []
    tensors: dict[str, Tensor] = {}
    for slot, sample in enumerate(samples):
        names += sample.names
        for name, value in sample.tensors().items():
            if slot == 0:
                tensors[name] = _shared(count, value)
            tensors[name][slot] = value
    return names, tensors


def _shared(count: int, like: Tensor) -> Tensor:
    """Room for so many such tensors, got in the way of torch's own default_collate."""
    storage = torch.UntypedStorage._new_shared(count * like.nbytes)
    return like.new_empty(0).set_(storage).view(count, *like.shape)


def _begin_worker(worker: int) -> None:
    """A queue sends its signals to every process of a cell; the main one alone answers them."""
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    _one_thread(worker)


def _one_thread(worker: int) -> None:
    """As torch does in its workers: more threads than cores would fight over them.

    0 means none beside this one. 1 would too, but first ends the threads of the pool, which a fork
    of a process that has used its own does not have, and waits for them forever.
    """
    cv2.setNumThreads(0)


class _Steps:
    """Iterates over what each step's batch, or a share of it, is made of, without end."""

    def __init__(
        self, samples: int, batch_size: int, seed: int, start_step: int, share: tuple[int, int]
    ) -> None:
        self.samples, self.batch_size, self.seed = samples, batch_size, seed
        self.start_step, size = start_step, batch_size // share[1]
        self.own = slice(share[0] * size, (share[0] + 1) * size)

    def __iter__(self) -> Iterator[list[Slot]]:
        step = self.start_step
        while True:
            epoch, position = divmod(step, self.samples // self.batch_size)
            first = position * self.batch_size
            indices = _order(self.samples, self.seed, epoch)[first : first + self.batch_size]
            slots: list[Slot] = [
                (index, ("augment", self.seed, step, slot)) for slot, index in enumerate(indices)
            ]
            yield slots[self.own]
            step += 1


@lru_cache(maxsize=2)
def _order(samples: int, seed: int, epoch: int) -> list[int]:
    generator = Generator().manual_seed(_hash("order", seed, epoch))
    return torch.randperm(samples, generator=generator).tolist()


def _hash(*parts: object) -> int:
    """A generator's seed; neighbouring steps get unrelated ones."""
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:8]) >> 1
