"""A model on a split -> metrics, their protocol and a few pictures. Never trains, never picks.

Results are compared at the size of the ground truth, by the protocols that the recipe names. A walk
goes over one split with one truth; protocols that share both share the walk.
"""

import contextlib
import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.batch import Batch, collate
from mtl_bench.core.ranks import Ranks
from mtl_bench.core.recipe import NOTHING
from mtl_bench.core.task import Metric, Results, Size, Task, finish
from mtl_bench.data.loader import eval_batches, eval_rounds
from mtl_bench.data.samples import Samples, open_samples
from mtl_bench.model import Model

PICTURES = 4  # frames kept for the report, at fixed places of the split

Progress = Callable[[int, int], None]  # frames done, frames in all
Picture = dict[str, Any]  # a frame and its maps [H,W,...]


@dataclass
class Evaluation:
    """What an evaluation hands on: numbers, how they were made, and frames to look at."""

    metrics: dict[str, float]  # flat and dotted; undefined ones (no such class or pixel) are absent
    protocol: dict[str, Any]
    samples: dict[str, Any] = field(default_factory=dict)  # names, and arrays [n,H,W,...]; the
    # same with keys `extremes.*` for the worst and the best frame, with their score


@dataclass
class Walk:
    """One walk over a split."""

    split: str
    tasks: tuple[Task, ...]  # those that are measured, and those whose results they read
    measured: list[tuple[Task, Metric]]
    samples: Samples


def evaluate(
    model: Model,
    cell: config.Cell,
    root: Path,
    device: torch.device,
    split: str | None = None,
    batch_size: int = 8,
    progress: Progress | None = None,
) -> Evaluation:
    """Evaluate in float32 by the recipe's protocols.

    Args:
        split: in place of the protocols' own.
        progress: told the frames done and in all, over all walks.

    Raises:
        ValueError: a split without ground truth, or a prediction that is not finite.
    """
    walks = open_walks(cell.recipe, model.tasks, root, split)

    def results(batch: Batch, tasks: Sequence[Task]) -> dict[str, Results]:
        return predict(model, batch.to(device), tasks, true_size(batch))

    with evaluating(model), torch.inference_mode():
        return measure(cell, walks, results, device, batch_size, progress)


def rehearse(model: Model, cell: config.Cell, root: Path, device: torch.device) -> None:
    """Read every frame and its truth, and evaluate one of each walk: what would stop an evaluation.

    Worth a call before training.

    Raises:
        ValueError: as `evaluate`, or a file that is damaged.
    """
    with evaluating(model), torch.inference_mode():
        for walk in open_walks(cell.recipe, model.tasks, root):
            for index in range(len(walk.samples)):
                sample = walk.samples.sample(index, None)
                if index == 0:
                    batch = collate([sample])
                    found = predict(model, batch.to(device), walk.tasks, true_size(batch))
                    for task, metric in walk.measured:
                        truth = frame_truth(task, batch, 0)
                        metric.update(truth, frame_of(found[task.name], 0))


def open_walks(
    recipe: config.Recipe, tasks: Sequence[Task], root: Path, split: str | None = None
) -> list[Walk]:
    """The walks that an evaluation takes, the main one first, or none; decodes nothing.

    Raises:
        ValueError: a protocol that the data set cannot serve, or a split that lacks its files.
    """
    main = split or recipe.evaluate.split
    if main == NOTHING:
        return []
    metrics = [(task, metric) for task in tasks for metric in task.metrics(split)]
    mains = [metric for _, metric in metrics if not metric.prefix]
    truth = next((metric.truth for metric in mains if metric.truth != "default"), "default")
    groups: dict[tuple[str, str], list[tuple[Task, Metric]]] = {(main, truth): []}
    for task, metric in metrics:
        any_truth = metric.truth == "default"
        place = (metric.split, truth if any_truth else metric.truth)
        groups.setdefault(place, []).append((task, metric))
    return [
        Walk(
            place[0],
            needed,
            measured,
            open_samples(recipe, needed, place[0], root, False, truth=place[1]),
        )
        for place, measured in groups.items()
        for needed in [_needed(tasks, measured)]
    ]


def _needed(tasks: Sequence[Task], measured: Sequence[tuple[Task, Metric]]) -> tuple[Task, ...]:
    """The measured tasks and, where a metric depends on them, those whose results they read."""
    names = {task.name for task, _ in measured}
    for task, metric in measured:
        names |= set(task.after) if metric.reads_others else set()
    return tuple(task for task in tasks if task.name in names)


def predict(
    model: Model, batch: Batch, tasks: Sequence[Task], size: Size | None = None
) -> dict[str, Results]:
    """Run the network and the post-processing.

    Args:
        size: of the results; None: the input's.

    Raises:
        ValueError: a predicted map that is not a number.
    """
    assert batch.camera is not None
    maps = model.net(batch.image_B3HW).maps
    if any(task.recipe.evaluate.flip and task.averages_flip for task in tasks):
        mirrored = model.net(batch.image_B3HW.flip(-1)).maps
        averaged = {
            task.name: task.flip_averaged(maps[task.name], mirrored[task.name]) for task in tasks
        }
        maps = maps | averaged
    for task in tasks:
        if any(map_.isnan().any() for map_ in maps[task.name].values()):
            raise ValueError(f"the predicted {task.name} is not finite in a frame of {batch.names}")
    return finish(tasks, maps, batch.camera, size)


# --- adding up ------------------------------------------------------------------------------------


def measure(
    cell: config.Cell,
    walks: Sequence[Walk],
    results: Callable[[Batch, Sequence[Task]], dict[str, Results]],
    device: torch.device,
    batch_size: int = 8,
    progress: Progress | None = None,
) -> Evaluation:
    """Walk and compare with the truth.

    Args:
        results: a batch's results of some tasks, by task, at the size of its truth.
    """
    if not walks:
        return Evaluation({}, {"dataset": cell.recipe.data.dataset, "split": NOTHING})
    done, total = 0, sum(len(walk.samples) for walk in walks)
    gallery = Gallery(len(walks[0].samples))
    input_size: Size = (0, 0)
    sizes: dict[Size, None] = {}
    for walk in walks:
        main = walk is walks[0]
        for batch in eval_batches(walk.samples, batch_size):
            found = results(batch, walk.tasks)
            if main:
                input_size = (batch.image_B3HW.shape[2], batch.image_B3HW.shape[3])
                sizes[true_size(batch)] = None
            for slot, name in enumerate(batch.names):
                picture: Picture = {"names": name}
                for task, metric in walk.measured:
                    seen = metric.update(
                        frame_truth(task, batch, slot), frame_of(found[task.name], slot)
                    )
                    picture = {**seen, **picture}
                if main:
                    gallery.add({**picture, "image": _picture(batch, slot)})
            done += len(batch.names)
            if progress:
                progress(done, total)
    protocol = _protocol(cell, walks, input_size, sizes, device)
    return Evaluation(_numbers(walks), protocol, gallery.samples())


def _numbers(walks: Sequence[Walk]) -> dict[str, float]:
    found: dict[str, float] = {}
    for walk in walks:
        for _, metric in walk.measured:
            found |= metric.compute()
    return found


def frame_truth(task: Task, batch: Batch, slot: int) -> dict[str, NDArray[Any]]:
    """What a task is compared with, of one frame of a batch."""
    return {
        name: batch.fields[name][slot].cpu().numpy() for name in task.truth if name in batch.fields
    }


def frame_of(results: Results, slot: int) -> dict[str, NDArray[Any]]:
    """One frame's results."""
    return {name: value[slot].cpu().numpy() for name, value in results.items()}


class Gallery:
    """Frames to look at: some at fixed places of the split, and the worst and the best.

    Args:
        total: frames of the split.
    """

    def __init__(self, total: int) -> None:
        places = np.linspace(0, total - 1, min(PICTURES, total)).round().astype(int)
        self._places, self._seen = set(places.tolist()), 0
        self._chosen: list[Picture] = []
        self._extremes: list[Picture] = []  # ordered by score

    def add(self, picture: Picture) -> None:
        """The next frame; a number among its arrays is its score."""
        scores = [key for key, value in picture.items() if isinstance(value, float)]
        plain = {key: value for key, value in picture.items() if key not in scores}
        if self._seen in self._places:
            self._chosen.append(plain)
        if scores and not np.isnan(picture[scores[0]]):
            scored = {**plain, scores[0]: picture[scores[0]]}
            ordered = sorted([*self._extremes, scored], key=lambda frame: frame[scores[0]])
            self._extremes = [ordered[0], ordered[-1]] if len(ordered) > 2 else ordered
        self._seen += 1

    def samples(self) -> dict[str, Any]:
        extremes = {f"extremes.{key}": value for key, value in _stacked(self._extremes).items()}
        return _stacked(self._chosen) | extremes


def _protocol(
    cell: config.Cell,
    walks: Sequence[Walk],
    input_size: Size,
    sizes: Iterable[Size],
    device: torch.device,
) -> dict[str, Any]:
    main, dataset, ev = walks[0], walks[0].samples.dataset, cell.recipe.evaluate
    compared = [list(size) for size in sizes]
    protocol: dict[str, Any] = {
        "name": ev.protocol,
        "dataset": cell.recipe.data.dataset,
        "split": main.split,
        "published_frames": dataset.published.get(main.split),
    }
    for _, metric in main.measured:
        if not metric.prefix:
            protocol |= metric.record()
    protocol |= {
        "split": main.split,
        "frames": len(main.samples),
        "input": list(input_size),
        "compared_at": compared[0] if len(compared) == 1 else compared,
        "engine": "eager",
        "precision": "fp32",
        "device": device.type,
        "ignored_classes": [label.name for label in dataset.labels.labels if not label.evaluated],
    }
    for task in main.tasks:
        protocol |= task.protocol([other.name for other in main.tasks])
    others = [(walk, metric) for walk in walks for _, metric in walk.measured if metric.prefix]
    if others:
        protocol["also"] = {m.prefix.removesuffix("."): m.record() for _, m in others}
    return protocol


# --- adding up, by several ranks -----------------------------------------------------------------


def evaluate_together(
    model: Model,
    cell: config.Cell,
    root: Path,
    device: torch.device,
    ranks: Ranks,
    batch_size: int = 8,
    progress: Progress | None = None,
) -> Evaluation:
    """As `evaluate`, bit for bit, by several ranks, of which each takes batches.

    What a frame adds to a metric is the state of one that has seen this frame alone. Rank 0 adds
    these in the order of the split, which are the additions of one process.

    Args:
        progress: of rank 0.

    Returns:
        At rank 0 what `evaluate` does, at the others an empty evaluation.
    """
    walks = open_walks(cell.recipe, model.tasks, root)
    if not walks:
        return evaluate(model, cell, root, device)
    done, total = 0, sum(len(walk.samples) for walk in walks)
    frames = len(walks[0].samples)
    gallery, chosen = Gallery(frames), Candidates(frames)
    input_size: Size = (0, 0)
    sizes: dict[Size, None] = {}
    with evaluating(model), torch.inference_mode():
        for walk in walks:
            main = walk is walks[0]
            empty = [copy.deepcopy(metric) for _, metric in walk.measured]
            for batches in eval_rounds(walk.samples, batch_size, ranks):
                own = [
                    _seen(model, walk, empty, batch, device, first, chosen if main else None)
                    for first, batch in batches
                ]
                for seen in (batch for of_rank in ranks.to_first(own) for batch in of_rank):
                    if main:
                        input_size = (seen["input"][0], seen["input"][1])
                        sizes[seen["truth"][0], seen["truth"][1]] = None
                    for frame in seen["frames"]:
                        for (_, metric), state in zip(walk.measured, frame["states"], strict=True):
                            metric.add(state)
                        if main:
                            gallery.add(frame["picture"])
                    done += len(seen["frames"])
                    if progress:
                        progress(done, total)
    if not ranks.first:
        return Evaluation({}, {})
    protocol = _protocol(cell, walks, input_size, sizes, device)
    return Evaluation(_numbers(walks), protocol, gallery.samples())


def _seen(
    model: Model,
    walk: Walk,
    empty: Sequence[Metric],
    batch: Batch,
    device: torch.device,
    first: int,
    chosen: "Candidates | None",
) -> dict[str, Any]:
    """What a batch adds, of plain values and arrays: its sizes, and of every frame the metrics'
    states and the picture, empty where no report will show it."""
    found = predict(model, batch.to(device), walk.tasks, true_size(batch))
    frames = []
    for slot, name in enumerate(batch.names):
        states: list[dict[str, NDArray[Any]]] = []
        picture: Picture = {"names": name}
        for (task, _), metric in zip(walk.measured, empty, strict=True):
            own = copy.deepcopy(metric)
            seen = own.update(frame_truth(task, batch, slot), frame_of(found[task.name], slot))
            states.append({key: np.asarray(value) for key, value in own.state().items()})
            picture = {**seen, **picture}
        if chosen is not None and chosen.takes(first + slot, picture):
            picture["image"] = _picture(batch, slot)
        else:
            picture = {}
        plain = {key: float(v) if isinstance(v, float) else v for key, v in picture.items()}
        frames.append({"states": states, "picture": plain})
    size = list(batch.image_B3HW.shape[2:])
    return {"input": size, "truth": list(true_size(batch)), "frames": frames}


class Candidates(Gallery):
    """Which of a rank's frames the gallery of all frames may show."""

    def takes(self, index: int, picture: Picture) -> bool:
        """Whether it may show this frame, which is behind those that were asked for before.

        Args:
            index: its place in the split.
        """
        self._seen = index
        self.add({key: v for key, v in picture.items() if not isinstance(v, np.ndarray)})
        kept = [*self._chosen, *self._extremes]
        return picture["names"] in [frame["names"] for frame in kept]


# --- parts ----------------------------------------------------------------------------------------


def true_size(batch: Batch) -> Size:
    """Of the truth, height and width; of one that has none, such as a class, the image's.

    Raises:
        ValueError: there is none.
    """
    for truth in batch.fields.values():
        if truth.dim() >= 3:
            return int(truth.shape[-2]), int(truth.shape[-1])
    if batch.fields:
        return int(batch.image_B3HW.shape[-2]), int(batch.image_B3HW.shape[-1])
    raise ValueError(f"no ground truth for {batch.names[0]}: choose a split that has it")


@contextlib.contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Evaluation mode inside; every module's own mode as it was after."""
    modes = [(module, module.training) for module in model.modules()]
    model.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


def _picture(batch: Batch, slot: int) -> NDArray[np.uint8]:
    """The input image [H,W,3] at the size of the ground truth."""
    image: Tensor = batch.image_B3HW[slot : slot + 1]
    if true_size(batch) != tuple(image.shape[2:]):
        image = F.interpolate(image, true_size(batch), mode="bilinear", align_corners=False)
    return (image[0] * 255).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy()


def _stacked(pictures: list[Picture]) -> dict[str, Any]:
    """What all have, key by key: lists of names and numbers, arrays of one size."""
    keys = [key for key in (pictures or [{}])[0] if all(key in picture for picture in pictures)]
    columns = {key: [picture[key] for picture in pictures] for key in keys}
    return {
        key: np.stack(_of_one_size(values)) if isinstance(values[0], np.ndarray) else values
        for key, values in columns.items()
    }


def _of_one_size(pictures: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """All at the first one's size: frames may differ by some pixels, a report's must not."""
    height, width = pictures[0].shape[:2]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    return [p[rows * p.shape[0] // height, columns * p.shape[1] // width] for p in pictures]
