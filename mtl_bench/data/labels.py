"""The label table: which classes exist, which are things, and how label ids become class indices.

A *label id* is what Cityscapes writes into its files (7 = road). A *class index* is what the
network predicts: contiguous, stuff before things. Source: Cityscapes' label definitions; the
20th training class `ego vehicle` and the order (class index 0, the rest shifted) are MGNet's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

IGNORE = 255  # class index of a pixel that has no label


@dataclass(frozen=True)
class Label:
    name: str
    label_id: int  # in the files
    is_thing: bool
    color: tuple[int, int, int]  # RGB, 0..255
    evaluated: bool = True  # False: trained, but void in every metric


@dataclass(frozen=True)
class LabelSet:
    """An ordered set of classes; a class index is a position in `labels`."""

    name: str
    labels: tuple[Label, ...]

    def __len__(self) -> int:
        return len(self.labels)

    def index(self, name: str) -> int:
        return [label.name for label in self.labels].index(name)

    @property
    def things(self) -> tuple[int, ...]:
        return tuple(i for i, label in enumerate(self.labels) if label.is_thing)

    @property
    def evaluated(self) -> tuple[int, ...]:
        return tuple(i for i, label in enumerate(self.labels) if label.evaluated)

    @property
    def colors(self) -> NDArray[np.uint8]:
        """[C,3] RGB."""
        return np.array([label.color for label in self.labels], np.uint8)

    def class_of_label_id(self) -> NDArray[np.uint8]:
        """[256] look-up table from a file's label id to a class index, or IGNORE."""
        table = np.full(256, IGNORE, np.uint8)
        for index, label in enumerate(self.labels):
            table[label.label_id] = index
        return table

    def label_id_of_class(self) -> NDArray[np.uint8]:
        """[256] look-up table from a class index to the file's label id, 0 for IGNORE."""
        table = np.zeros(256, np.uint8)
        for index, label in enumerate(self.labels):
            table[index] = label.label_id
        return table


_EGO = Label("ego vehicle", 1, False, (72, 209, 204), evaluated=False)
_EVALUATED = (
    Label("road", 7, False, (128, 64, 128)),
    Label("sidewalk", 8, False, (244, 35, 232)),
    Label("building", 11, False, (70, 70, 70)),
    Label("wall", 12, False, (102, 102, 156)),
    Label("fence", 13, False, (190, 153, 153)),
    Label("pole", 17, False, (153, 153, 153)),
    Label("traffic light", 19, False, (250, 170, 30)),
    Label("traffic sign", 20, False, (220, 220, 0)),
    Label("vegetation", 21, False, (107, 142, 35)),
    Label("terrain", 22, False, (152, 251, 152)),
    Label("sky", 23, False, (70, 130, 180)),
    Label("person", 24, True, (220, 20, 60)),
    Label("rider", 25, True, (255, 0, 0)),
    Label("car", 26, True, (0, 0, 142)),
    Label("truck", 27, True, (0, 0, 70)),
    Label("bus", 28, True, (0, 60, 100)),
    Label("train", 31, True, (0, 80, 100)),
    Label("motorcycle", 32, True, (0, 0, 230)),
    Label("bicycle", 33, True, (119, 11, 32)),
)

CITYSCAPES20 = LabelSet("cityscapes20", (_EGO, *_EVALUATED))
CITYSCAPES19 = LabelSet("cityscapes19", _EVALUATED)
_WITHOUT_EGO = ("kitti", "synthetic-kitti")  # their cameras do not see the car they are mounted on


def labels_of(dataset: str) -> LabelSet:
    """What a network for this data set predicts (`recipe.data.dataset`)."""
    return CITYSCAPES19 if dataset in _WITHOUT_EGO else CITYSCAPES20


# Every label id that Cityscapes' files may hold; those in no LabelSet are void. -1 is not written.
KNOWN_LABEL_IDS = frozenset(range(34))
