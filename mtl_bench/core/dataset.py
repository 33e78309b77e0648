"""What a data set is: frames with typed fields, cut into splits, read into samples.

A data set is a file in `mtl_bench/data/` (or in `datasets/` of a plug-in folder) with one subclass
of `Dataset`; its name is the file's stem. A subclass says which frames there are (`names`) and
reads one (`read`). What is random about a training sample is no business of a data set:
`data/samples.py` does it by the kind of each field.

Shapes: N frames (a frame and its neighbours in time), H x W pixels.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core import plugins
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Data, Recipe

if TYPE_CHECKING:
    from mtl_bench.core.task import Task


class Kind(Enum):
    """What a field is, which says how a flip, a resize and a crop act on it."""

    IDS = "label map or instance ids [H,W]"  # nearest pixel; OUTSIDE on padding
    DEPTH = "depth [H,W]"  # nearest pixel; a zoom divides it; 0 on padding
    INVERSE_DEPTH = "inverse depth or disparity [H,W]"  # nearest pixel; a zoom multiplies it
    NORMALS = "unit normals [3,H,W], x right, y down, z forward"  # nearest pixel; a flip negates x
    MASK = "true or false [H,W]"  # nearest pixel; false on padding
    PICTURE = "grey levels [H,W]"  # nearest pixel; 0 on padding
    VECTOR = "numbers of the whole image"  # nothing changes them


NEIGHBOURS = "neighbours"  # what a task needs that compares a frame with those beside it in time


@dataclass(frozen=True)
class DecodedFrame:
    """What is kept of a decoded frame; everything random comes later."""

    images_N3HW: Sequence[Tensor]  # uint8, input size; in training then those before and after
    K_33: Tensor | None = None  # not known
    camera_height_m: float = 0.0
    camera_pitch_rad: float = 0.0
    # By name; at the input's size in training, at their own in evaluation
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    static: Tensor | None = None  # ids [H,W] in training: tells what does not move with the scene


class LabelGroup(NamedTuple):
    """Frames of one size, in order."""

    names: list[str]
    size: tuple[int, int]  # height, width of the network's input at scale 1


class LabelFrames(Protocol):
    """Frames that get pseudo labels, and where those go."""

    names: list[str]  # of the frames to label
    out: Path  # where the record lies
    folder: Path  # where the labels lie, for whoever reads them

    def groups(self) -> Iterator[LabelGroup]: ...
    def image(self, name: str) -> Path: ...
    def done(self) -> set[str]:
        """Names of the frames that are labelled."""
        ...

    def stranger(self) -> Path | None:
        """A label file in `out`, where there is one."""
        ...

    def record(self) -> dict[str, Any]:
        """What tells these labels from those of other frames or of another input."""
        ...

    def write(self, name: str, ids_HW: NDArray[np.uint16]) -> None: ...


class Report(Protocol):
    """What a look over a folder has found."""

    @property
    def dataset(self) -> str:
        """The data set whose recipes it can run."""
        ...

    @property
    def problems(self) -> Sequence[Any]: ...
    def summary(self) -> list[str]:
        """Lines for a terminal."""
        ...

    def recipe_lines(self, recipe: Recipe, tasks: "Sequence[Task]") -> Iterator[str]:
        """What stands between the folder and a recipe, task by task."""
        ...


class Dataset:
    """Base of every data set: one split of it.

    Args:
        root: the folder that holds it.
        split: train, val or test.
        data: input size and whether decoded frames stay in memory.
        needs: fields that tasks ask for, and NEIGHBOURS.
        training: whether training samples are made of it, or the frames are only evaluated.
        truth: one of `truths`, or "default".
        further_labels: where `takes_further_labels`, a folder of labels of further frames.

    Raises:
        ValueError: no such split, no frames, or frames that lack a file, the first one named.
    """

    labels: ClassVar[LabelSet]
    fields: ClassVar[Mapping[str, Kind]]
    splits: ClassVar[tuple[str, ...]] = ("train", "val", "test")
    truths: ClassVar[tuple[str, ...]] = ()  # kinds of depth truth; empty: there is but one
    static_ids: ClassVar[tuple[int, ...]] = ()  # instance ids that do not move with the scene
    name: ClassVar[str] = ""  # the file's stem
    takes_further_labels: ClassVar[bool] = False  # the video stage's
    layout: ClassVar[str] = ""  # what its files look like, in a sentence
    marks: ClassVar[str] = ""  # what a folder of it has, such as "leftImg8bit/"
    built_in: ClassVar[bool] = False  # rendered on first use; others need --data
    published: ClassVar[Mapping[str, int]] = {}  # frames of each split, as papers report it
    has_camera: ClassVar[bool] = True  # whether frames have intrinsics
    # Tasks that are of one field: which of its fields they can be of
    predicts: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    names: list[str]
    # Which members make no numbers of a cell, or those of its pseudo labels alone
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {
        "label": ("frames_to_label",),
        "show": (
            "name",
            "layout",
            "marks",
            "built_in",
            "published",
            "predicts",
            "takes_further_labels",
            "recognises",
            "render",
            "example",
            "check",
            "image_files",
            "sources",
            "paths",
            "made_from",
            "described",
        ),
    }

    def __init__(
        self,
        root: Path,
        split: str,
        data: Data,
        *,
        needs: Collection[str] = (),
        training: bool = False,
        truth: str = "default",
        further_labels: Path | None = None,
    ) -> None:
        self.root, self.split, self.data = root, split, data
        self.needs, self.training, self.truth = frozenset(needs), training, truth
        self.further_labels = further_labels
        self.split_index(split)  # it is one
        unknown = self.needs - {NEIGHBOURS} - self.fields.keys()
        if unknown:
            raise ValueError(
                f"{data.dataset} has no {', '.join(sorted(unknown))}: it has "
                f"{', '.join(sorted(self.fields))}"
            )
        if truth != "default" and self.truths and truth not in self.truths:
            raise ValueError(
                f"{data.dataset} has no depth truth '{truth}': it has {', '.join(self.truths)}"
            )
        self.open_split()

    # --- what a subclass says ---------------------------------------------------------------------

    def open_split(self) -> None:
        """Look up or make the split's frames: give them `names`, and keep what `read` needs."""
        raise NotImplementedError

    def read(self, name: str) -> DecodedFrame:
        """Decode a frame: all at the input's size in training; truth at its own in evaluation."""
        raise NotImplementedError

    @classmethod
    def split_index(cls, split: str) -> int:
        """Its place in `splits`.

        Raises:
            ValueError: no such split.
        """
        if split not in cls.splits:
            raise ValueError(
                f"{cls.name.replace('_', '-') or cls.layout} has no split '{split}': it has "
                f"{', '.join(cls.splits)}"
            )
        return cls.splits.index(split)

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Whether a folder is in this data set's layout."""
        raise NotImplementedError

    @classmethod
    def example(cls, root: Path, data: Data) -> bool:
        """Write a few frames of the splits train and val in this layout, for `mtl-bench check`.

        Returns:
            Whether it did: a data set may do without.
        """
        return False

    @classmethod
    def render(cls, data: Data, quiet: bool = False) -> Path:
        """Of built-in data: the folder that it is in, rendered where it is not there yet."""
        raise NotImplementedError

    @classmethod
    def made_from(cls, data: Data, root: Path | None) -> str | None:
        """Of generated data: what their bytes depend on; None: they are not, or it is not known.

        Args:
            root: a folder; None: the one that `render` gives.
        """
        return None

    @classmethod
    def check(cls, root: Path, deep: bool = False) -> Report:
        """Look over a folder: what it holds and lacks.

        Args:
            deep: decode every file, too.

        Raises:
            ValueError: the data set does without.
        """
        raise ValueError(
            f"'{root}': the data set '{cls.name}' has no check; `mtl-bench check {cls.name}` tests "
            "how it reads frames"
        )

    @classmethod
    def image_files(cls, root: Path, split: str) -> dict[str, Path]:
        """Names and image files of a split's frames, in order; no ground truth is needed."""
        raise NotImplementedError

    @classmethod
    def frames_to_label(
        cls, root: Path, out: Path | None, split: str, recipe: Recipe
    ) -> LabelFrames:
        """The frames of a split that get pseudo labels.

        Args:
            out: where labels go; None: beside the images.

        Raises:
            ValueError: no frame to label, or no place for labels.
        """
        raise ValueError(f"{cls.layout or cls.name} has no frames to label")

    on_disk: Any = None  # the FrameCache that `mtl-bench data cache` fills, where there is one

    def sources(self) -> list[Any]:
        """Files that it can hold."""
        return []

    def paths(self) -> Iterable[Path]:
        """What its samples are made of: files, or folders with all that is in them."""
        return [self.root]

    @property
    def static_from(self) -> str:
        """What the training frames' masks of static pixels come from."""
        return "none"

    @property
    def knows_static(self) -> bool:
        """Whether those masks leave out all that does not move with the scene."""
        return False

    @property
    def described(self) -> dict[str, Any]:
        """What a row says of the training frames."""
        return {}

    @property
    def needs_camera(self) -> bool:
        """Whether what is asked for takes the frames' intrinsics: all does but labels alone."""
        return not self.needs or any(self.fields.get(name) is not Kind.IDS for name in self.needs)

    def __len__(self) -> int:
        return len(self.names)


def dataset_of(recipe: Recipe) -> type[Dataset]:
    """The data set that a recipe names.

    Raises:
        ValueError: no such data set.
    """
    found: type[Dataset] = plugins.load("datasets", recipe.data.dataset.replace("-", "_"))
    return found


def dataset_in(root: Path) -> type[Dataset] | None:
    """The data set whose layout a folder has; built-in ones have that of another."""
    kinds = (plugins.load("datasets", name) for name in plugins.files("datasets"))
    return next((kind for kind in kinds if not kind.built_in and kind.recognises(root)), None)


def layouts() -> list[str]:
    """What tells the known layouts, for a message."""
    kinds = (plugins.load("datasets", name) for name in plugins.files("datasets"))
    return [f"{kind.marks} ({kind.layout})" for kind in kinds if not kind.built_in]
