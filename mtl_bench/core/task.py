"""What a task is: its head, targets, loss terms, post-processing, metrics and picture.

A task is a file in `mtl_bench/tasks/` (or in `tasks/` of a plug-in folder) with one subclass of
`Task`. The network, the loop, the evaluation, the engines and the report know tasks by this
contract alone; nothing else names one.

Shapes: B images, H x W input pixels, h x w cells of the finest feature map.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core import plugins
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.config import Cell
from mtl_bench.core.dataset import Dataset, LabelFrames, dataset_of
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Network, Recipe
from mtl_bench.core.terms import Term
from mtl_bench.core.view import View

Maps = dict[str, Tensor]  # by name, [B,C,H,W]; of a number of the whole image [B,C]
Results = dict[str, Tensor]  # by name, the first axis is B
Size = tuple[int, int]  # height, width
Frame = Mapping[str, Any]  # one frame's arrays, by name


@dataclass(frozen=True)
class MapInfo:
    """What a map is to engines and exported files.

    Attributes:
        exported: its name in an exported file.
        classes: whether post-processing reads nothing but the index of its largest channel.
        words: what its differences are called, where engines are compared.
        ids: the result that holds ids of what these classes are; engines have to agree on them.
        quantity: what this map is the inverse of; engines have to agree on it by ratio.
    """

    exported: str
    classes: bool = False
    words: str = ""
    ids: str = ""
    quantity: str = ""


class TaskHead(nn.Module):
    """What a task adds to the network: decoders and heads, which are its own alone.

    `decoders` and `heads` become the network's under the same names, which must be the task's.
    """

    decoders: nn.ModuleDict
    heads: nn.ModuleDict

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        """Features, finest first -> raw maps [B,C,h,w].

        Args:
            auxiliary: also those maps that only the losses read.
        """
        raise NotImplementedError


class Metric:
    """Adds up one task's results over the frames of a split."""

    split: str = "val"
    truth: str = "default"  # which of the data set's truths
    reads_others: bool = True  # whether the result depends on the tasks in `after`
    prefix: str = ""  # before its keys in a row: "" for the main one

    def update(self, truth: Frame, result: Frame) -> Frame:
        """Add a frame: arrays without the B axis, all of the truth's size.

        Returns:
            What a report may show of it: arrays [H,W,...]; and under the name of a column the
            frame's own score, by which reports pick the worst and the best.
        """
        raise NotImplementedError

    def state(self) -> dict[str, NDArray[Any]]:
        """What `compute` and `record` need, as arrays that add up over frames.

        Ranks share an evaluation by it: the states of metrics that have seen one frame each, added
        in the frames' order, give bit for bit what `update` by these frames gives.
        """
        raise NotImplementedError

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Add another one's state."""
        raise NotImplementedError

    def compute(self) -> dict[str, float]:
        """Flat, dotted keys of a row; what is undefined is absent."""
        raise NotImplementedError

    def record(self) -> dict[str, Any]:
        """What a row keeps of how it was measured."""
        return {}


class Trivial:
    """What a task's row must beat: a result made of the training split's truth alone."""

    def add(self, truth: Frame) -> None:
        """Learn from a frame's truth."""
        raise NotImplementedError

    def result(self, count: int, size: Size) -> Results:
        """The same answer for so many frames, under the names that `Task.finish` gives."""
        raise NotImplementedError

    protocol: Mapping[str, Any] = {}


class Task:
    """Base of every task.

    Args:
        recipe: sizes, switches of losses, settings of the post-processing.
        labels: the data set's classes.
        field: of the data set, where `of_field`: what it predicts, needs and is compared with.
    """

    name: str = ""  # the file's stem; with its field `stem:field`
    terms: tuple[Term, ...]  # one that is of a field has one, which gets its name
    of_field: ClassVar[bool] = False  # whether a cell says of which field of the data set it is
    kind: ClassVar[str] = "regression"  # the likelihood behind most of the sum of its terms
    needs: frozenset[str] = frozenset()  # fields of a training sample, beside the image
    reads: frozenset[str] = frozenset()  # those of them that `losses` itself reads
    truth: frozenset[str] = frozenset()  # fields of an evaluation sample
    after: ClassVar[tuple[str, ...]] = ()  # tasks whose results `finish` may read
    columns: ClassVar[tuple[Column, ...]] = ()  # of its metrics
    maps: ClassVar[Mapping[str, MapInfo]] = {}  # that `finish` reads, by the head's names
    exported: ClassVar[tuple[str, ...]] = ()  # results that an exported file gives
    # Of those, of its maps and of "points" in such a file: what they are, their unit, and what
    # stands where there is no value
    meaning: ClassVar[Mapping[str, str]] = {}
    has_points: ClassVar[bool] = False  # whether `points` gives any
    reads_camera: ClassVar[bool] = False  # whether `finish` or `points` does
    reads_pyramid: ClassVar[bool] = True  # else its head reads the context, one vector, alone
    makes_labels: ClassVar[bool] = False  # whether the video stage's labels come from it
    averages_flip: ClassVar[bool] = False  # whether `flip_averaged` does anything
    # The kinds of files that `predict` can write of a frame, the picture first; "points" is the
    # cloud that is made of a Surface
    files: ClassVar[tuple[str, ...]] = ()
    # Endings of files that `read_result` reads, the most telling first
    scored: ClassVar[tuple[str, ...]] = ()
    # Maps that `Metric.update` gives and reports draw beside "true_<name>": the captions' words
    drawn: ClassVar[Mapping[str, str]] = {}
    agreement: ClassVar[tuple[Column, ...]] = ()  # of how near an engine's results are
    counts: ClassVar[Mapping[str, str]] = {}  # keys of a row that count frames: what they are
    # What reports say of it: "trivial", the trivial predictor's result, and a sentence on it in
    # "trivial_note"; "timed", what stands at the end of what is timed; "random", what random
    # weights change of that; "counted", what the frames of `counts` are
    words: ClassVar[Mapping[str, str]] = {}
    # Which of a task's members make the numbers of each stage; the others make none
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {
        "train": (
            "terms",
            "kind",
            "reads_pyramid",
            "needs",
            "reads",
            "head",
            "activate",
            "extra",
            "begin",
            "targets",
            "training_maps",
            "losses",
        ),
        "evaluate": (
            "truth",
            "after",
            "head",
            "activate",
            "averages_flip",
            "flip_averaged",
            "resized",
            "finish",
            "metrics",
        ),
        "time": ("after", "maps", "head", "activate", "finish", "points"),
        "label": ("head", "activate", "resized", "label"),
        "show": (
            "name",
            "columns",
            "makes_labels",
            "training_protocol",
            "protocol",
            "trivial",
            "write_results",
            "exported",
            "meaning",
            "reads_camera",
            "has_points",
            "like_trained",
            "at_size",
            "view_of",
            "files",
            "scored",
            "read_result",
            "drawn",
            "drawn_view",
            "agreement",
            "counts",
            "words",
        ),
    }

    def __init__(self, recipe: Recipe, labels: LabelSet, field: str = "") -> None:
        self.recipe, self.labels, self.field = recipe, labels, field
        if field:
            self.name = f"{self.name}:{field}"
            self.needs = self.reads = self.truth = frozenset({field})
            self.terms = tuple(replace(term, name=self.name, task=self.name) for term in self.terms)

    # --- network ----------------------------------------------------------------------------------

    def head(self, inputs: tuple[int, ...], sizes: Network) -> TaskHead:
        """Decoders and heads.

        Args:
            inputs: channels of the features, finest first; none where a backbone gives a vector.
            sizes: `channels` is the context's width.
        """
        raise NotImplementedError

    def activate(self, maps: Maps) -> Maps:
        """Raw maps -> maps in their own units, still [B,C,h,w]."""
        return maps

    def extra(self, sizes: Network, pretrained: bool) -> dict[str, nn.Module]:
        """Networks that only training needs, by name."""
        return {}

    # --- training ---------------------------------------------------------------------------------

    def begin(self, dataset: Dataset) -> None:
        """Learn what matters of the training data before the first step."""

    def targets(self, sample: Batch) -> dict[str, Tensor]:
        """Further fields of a training sample, made of those it has; called by loading workers."""
        return {}

    def training_maps(self, extra: Mapping[str, nn.Module], batch: Batch) -> Maps:
        """What the networks of `extra` predict; runs under the training's precision."""
        return {}

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        """Unweighted terms by name; one without labels, or without a pixel of them, is absent."""
        raise NotImplementedError

    def training_protocol(self, dataset: Dataset) -> dict[str, Any]:
        """What a row says of how the task was trained."""
        return {}

    # --- results ----------------------------------------------------------------------------------

    def resized(self, maps: Maps, size: Size) -> Maps:
        """Maps at another size: bilinear, corners not aligned."""
        return {
            name: F.interpolate(map_.float(), size, mode="bilinear", align_corners=False)
            if map_.dim() == 4
            else map_
            for name, map_ in maps.items()
        }

    def flip_averaged(self, maps: Maps, mirrored: Maps) -> Maps:
        """Maps averaged with those of the mirrored image, where that means something."""
        return maps

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """Maps -> results: the only post-processing, of evaluation, prediction, timing and export.

        Args:
            maps: at the network's input size; a categorical one may be its argmax [B,H,W] instead.
            camera: of the network's input.
            done: results of the tasks in `after`, as far as they are there.
            size: of the results; None: the maps' own.
        """
        raise NotImplementedError

    def like_trained(self, head: TaskHead, maps: Maps) -> None:
        """Give random weights what the time of post-processing depends on.

        Args:
            maps: that they predict, at the input's size.
        """

    def points(self, results: Mapping[str, Results], camera: Camera) -> Tensor | None:
        """Where `has_points`: 3D points [B,3,H,W] in the camera's frame, metres, NaN for none."""
        return None

    def metrics(self, split: str | None = None) -> list[Metric]:
        """The main one first.

        Args:
            split: in place of the recipe's.
        """
        raise NotImplementedError

    def protocol(self, tasks: Collection[str]) -> dict[str, Any]:
        """What a row says of how results are made.

        Args:
            tasks: those that are evaluated together.
        """
        return {}

    def label(
        self,
        model: nn.Module,
        frames: LabelFrames,
        device: torch.device,
        progress: Callable[[int, int], None] | None = None,
    ) -> Path:
        """Write pseudo labels of frames, where `makes_labels`; the folder that holds them.

        Args:
            model: with this task, in evaluation mode.
            progress: told how many frames have labels, at the start and after each.
        """
        raise NotImplementedError

    def write_results(
        self, out: Path, split: str, frames: Iterable[tuple[str, Results]]
    ) -> Path | None:
        """Results of named frames as files of an official evaluator; None where there is none."""
        return None

    def read_result(self, path: Path, size: Size) -> Results:
        """What the metrics read of one frame, from a file that may have been made elsewhere.

        Args:
            size: of the truth.

        Raises:
            ValueError: a file that does not fit.
        """
        raise NotImplementedError

    def trivial(self, size: Size) -> Trivial | None:
        """The trivial predictor for frames of this size, where there is one."""
        return None

    # --- for a viewer -----------------------------------------------------------------------------

    def at_size(self, size: Size) -> "Task":
        """This task, with the lengths and areas of its post-processing made for another size.

        In the recipe they are pixels of the recipe's size.
        """
        return self

    def view_of(self, results: Mapping[str, Results], camera_height_m: float | None) -> View | None:
        """What a viewer sees of the results of a batch of one, where there is something to see.

        Args:
            camera_height_m: None where it is not known: `finish` was told 1.
        """
        return None

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> View:
        """The view of a map of `drawn`, or of its truth."""
        raise NotImplementedError


def tasks_of(recipe: Recipe, names: Iterable[str], labels: LabelSet) -> tuple[Task, ...]:
    """Tasks by name, each behind those whose results it reads, else in the order of their names.

    Raises:
        ValueError: an unknown task.
    """
    return tuple(
        plugins.load("tasks", name)(recipe, labels, plugins.stem_and_field(name)[1])
        for name in plugins.ordered(names)
    )


def tasks_of_cell(cell: Cell) -> tuple[Task, ...]:
    """A cell's tasks, with the classes of its data set."""
    return tasks_of(cell.recipe, cell.tasks, dataset_of(cell.recipe).labels)


def terms_of(tasks: Sequence[Task], granularity: str = "terms") -> tuple[Term, ...]:
    """What a method weighs: the terms of these tasks, or the tasks as sums of them."""
    if granularity == "tasks":
        return tuple(Term(task.name, task.name, task.kind, 1.0, task.terms) for task in tasks)
    return tuple(term for task in tasks for term in task.terms)


def loss_names() -> set[str]:
    """Of all tasks that are found: their own names and their terms'."""
    kinds = {name: plugins.load("tasks", name) for name in plugins.files("tasks")}
    return {*kinds, *(term.name for kind in kinds.values() for term in kind.terms)}


def finish(
    tasks: Iterable[Task],
    maps: Mapping[str, Maps],
    camera: Camera,
    size: Size | None = None,
) -> dict[str, Results]:
    """Every task's results, by task, in the tasks' order."""
    done: dict[str, Results] = {}
    for task in tasks:
        done[task.name] = task.finish(maps[task.name], camera, done, size)
    return done
