"""Samples: a data set's frames as the network and the tasks want them.

In training a sample is an augmented frame, its neighbours in time where a task needs them, and
what tasks make of its fields; in evaluation it is the plain frame with the truth at its own size.
"""

import copy
import functools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Self

import torch
from torch import Generator, Tensor

from mtl_bench.core.batch import Batch, Camera, collate
from mtl_bench.core.dataset import NEIGHBOURS, Dataset, DecodedFrame, dataset_of
from mtl_bench.core.labels import OUTSIDE
from mtl_bench.core.recipe import Augment, Recipe
from mtl_bench.core.task import Task
from mtl_bench.data.augment import augment

Targets = Callable[[Batch], dict[str, Tensor]]

# Of a data set that has none: what no task reads needs no value
NO_CAMERA = Camera(torch.full((3, 3), torch.nan), *torch.full((2,), torch.nan))


def open_samples(
    recipe: Recipe,
    tasks: Sequence[Task],
    split: str,
    root: Path,
    training: bool,
    further_labels: Path | None = None,
    truth: str = "default",
) -> "Samples":
    """The split as a recipe and tasks want it.

    Args:
        further_labels: of the video stage, where the data set takes some.
        truth: which of the data set's truths to evaluate on.

    Raises:
        ValueError: an unknown data set, or one that lacks what the tasks need.
    """
    kind = dataset_of(recipe)
    for task in tasks:
        if task.reads_camera and not kind.has_camera:
            raise ValueError(
                f"task '{task.name}' reads the camera, and {recipe.data.dataset} has none"
            )
    needs = frozenset().union(*(task.needs if training else task.truth for task in tasks))
    dataset = kind(
        root,
        split,
        recipe.data,
        needs=needs,
        training=training,
        truth=truth,
        further_labels=further_labels,
    )
    targets = [task.targets for task in tasks]
    keep = frozenset().union(*(task.reads for task in tasks))
    return Samples(dataset, recipe.augment if training else None, targets, keep)


class Samples:
    """One split.

    Args:
        augment: random changes of training samples; None for evaluation samples.
        targets: what makes further fields of a training sample.
        keep: the data set's fields that a training sample has also after that; others, as large as
            what was made of them, go.
    """

    def __init__(
        self,
        dataset: Dataset,
        augment: Augment | None = None,
        targets: Sequence[Targets] = (),
        keep: Collection[str] = (),
    ) -> None:
        self.dataset, self.names = dataset, dataset.names
        self._augment, self._targets, self._keep = augment, tuple(targets), frozenset(keep)
        self._kept: dict[int, DecodedFrame] | None = {} if dataset.data.cache else None

    def __len__(self) -> int:
        return len(self.names)

    def uncached(self) -> Self:
        """The same split, remembering nothing: for worker processes, which would each hold it."""
        other = copy.copy(self)
        other._kept = None
        return other

    def sample(self, index: int, generator: Generator | None) -> Batch:
        """One sample, tensors without the B axis.

        Args:
            index: position in `names`.
            generator: source of the augmentation; None for an evaluation sample.

        Raises:
            ValueError: a file of the frame is missing, damaged or does not fit the others.
        """
        name = self.names[index]
        frame = self._kept.get(index) if self._kept is not None else None
        if frame is None:
            frame = self.dataset.read(name)
            if self._kept is not None:
                self._kept[index] = frame
        if generator is not None and not self.fixed:
            return self._training(self._augmented(name, frame, generator))
        image = frame.images_N3HW[0].contiguous().float() / 255
        sample = Batch([name], image, _camera(frame, frame.K_33), dict(frame.fields))
        return sample if generator is None else self._training(sample)

    @property
    def fixed(self) -> bool:
        """Whether nothing is random about a training sample."""
        assert self._augment is not None
        return self._augment.nothing and NEIGHBOURS not in self.dataset.needs

    @functools.cached_property
    def whole(self) -> Batch | None:
        """All training samples at once, where they are fixed and may stay in memory."""
        if self._kept is None or not self.fixed:
            return None
        return collate([self.sample(index, Generator()) for index in range(len(self))])

    def _training(self, sample: Batch) -> Batch:
        """With what tasks make of its fields, and without those that they do not read."""
        for make in self._targets:
            sample.fields |= make(sample)
        for name in self.dataset.fields.keys() - self._keep:
            sample.fields.pop(name, None)
        return sample

    def _augmented(self, name: str, frame: DecodedFrame, generator: Generator) -> Batch:
        assert self._augment is not None
        static = frame.static
        if static is None:  # nothing is known of any pixel, but padding must be marked
            static = torch.zeros(frame.images_N3HW[0].shape[-2:], dtype=torch.int32)
        needs = self.dataset.needs
        kinds = {key: kind for key, kind in self.dataset.fields.items() if key in frame.fields}
        view = augment(
            frame.images_N3HW, frame.K_33, static, frame.fields, kinds, self._augment, generator
        )
        sample = Batch([name], view.jittered_N3HW[0], _camera(frame, view.K_33), view.fields)
        if NEIGHBOURS in needs:
            unmoved = torch.tensor([*self.dataset.static_ids, OUTSIDE])
            sample.fields |= {
                "neighbours": view.jittered_N3HW[1:],  # jittered like the image
                "clean": view.clean_N3HW[0],  # without jitter: what frames are compared by
                "clean_neighbours": view.clean_N3HW[1:],
                "reprojection_mask": ~torch.isin(view.static_HW, unmoved),
            }
        return sample


def _camera(frame: DecodedFrame, K_33: Tensor | None) -> Camera:
    if K_33 is None:
        return NO_CAMERA
    height, pitch = frame.camera_height_m, frame.camera_pitch_rad
    return Camera(K_33, torch.tensor(height), torch.tensor(pitch))
