"""What a viewer sees of one frame's result: pictures, files, and what a point cloud is made of.

A task makes a `View` of its results (`Task.view`). What shows predictions knows no task: it looks
for the kind of view that it needs, `Segments` or `Surface`. H x W pixels.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.canvas import Image, LogScale
from mtl_bench.core.labels import LabelSet

METRES = "m"
STEPS = 256


@dataclass(frozen=True)
class Key:
    """What explains pictures: it stands over and below a column of them."""

    title: str
    swatches: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)  # names of colours
    scale: LogScale | None = None
    marks: Mapping[float, str] = field(default_factory=dict)  # on the scale's bar, from 0 to 1


@dataclass(frozen=True)
class View:
    """One frame's result of a task: a dataclass of maps [H,W] of one size, and of facts."""

    task: ClassVar[str]

    def map(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Self:
        """The same with every map changed, such as resized."""
        maps = {name: change(v) for name, v in vars(self).items() if isinstance(v, np.ndarray)}
        return dataclasses.replace(self, **maps)

    def picture(self, image_HW3: Image) -> Image:
        """The result alone, of the size of the image, which may shine through."""
        raise NotImplementedError

    def explained(self, image_HW3: Image, whole: bool = False) -> Image:
        """The picture, enlarged where it is tiny, above what explains its colours.

        Args:
            image_HW3: of the maps' size.
            whole: of a video: the pictures of all its frames have one size.
        """
        raise NotImplementedError

    def files(self, kind: str, image_HW3: Image) -> dict[str, NDArray[Any]]:
        """PNG files of a kind, none where it is another task's: ending -> pixels."""
        raise NotImplementedError

    @classmethod
    def key(cls, views: Sequence["View"]) -> Key:
        """What explains the pictures of these views of the task, which share it."""
        raise NotImplementedError


@dataclass(frozen=True)
class Segments(View):
    """A view that says which segment each pixel belongs to."""

    ids_HW: NDArray[np.int32]  # instance ids, see core.labels; 0 is void
    labels: LabelSet


@dataclass(frozen=True)
class Surface(View):
    """A view that says how far away what each pixel sees is."""

    depth_HW: NDArray[np.float32]  # in `unit`; 0 = no value
    unit: str
    source: str = ""  # of its scale, in a word
    camera_height: float | None = None  # above the ground, in `unit`; None without a scale

    @property
    def steps(self) -> int:
        """Of a unit in a file of 16-bit pixels; 256 as KITTI has them."""
        return STEPS

    def scale(self, depth: NDArray[np.floating[Any]]) -> LogScale:
        """Colours of such depths."""
        raise NotImplementedError
