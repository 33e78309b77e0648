"""Classes: which exist, which are things, what part they play, and how label ids become indices.

A *label id* is what a data set writes into its files. A *class index* is what the network
predicts: contiguous, stuff before things. An *instance id* is a label id * 1000 + a number; below
1000 it is a plain label id. What other rooms need to know of a class is its *role*, never its name.
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NUMBERING = "Cityscapes"  # whose label and instance ids these are
IGNORE = 255  # class index of a pixel that has no label
DIVISOR = 1000  # instance id = label id * 1000 + number; below it: a plain label id
OUTSIDE = -1  # instance id of padding
LARGEST_ID = 2**16 - 1  # the files are 16-bit
GROUND = "ground"  # role: what the camera's height is above
NO_SURFACE = "no surface"  # role: nothing that has a depth, such as the sky


@dataclass(frozen=True)
class Label:
    name: str
    label_id: int  # in the files
    is_thing: bool
    color: tuple[int, int, int]  # RGB, 0..255
    evaluated: bool = True  # False: trained, but void in every metric
    role: str = ""  # GROUND, NO_SURFACE or none


@dataclass(frozen=True)
class LabelSet:
    """An ordered set of classes; a class index is a position in `labels`."""

    name: str
    labels: tuple[Label, ...]

    def __len__(self) -> int:
        return len(self.labels)

    def index(self, name: str) -> int:
        return [label.name for label in self.labels].index(name)

    def of_role(self, role: str) -> tuple[int, ...]:
        """Class indices that play a part, such as GROUND."""
        return tuple(i for i, label in enumerate(self.labels) if label.role == role)

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


@functools.cache
def class_of_instance_id(labels: LabelSet) -> NDArray[np.uint8]:
    """[65536] look-up table from a file's instance id to a class index or IGNORE."""
    ids = np.arange(LARGEST_ID + 1)
    return labels.class_of_label_id()[np.where(ids < DIVISOR, np.minimum(ids, 255), ids // DIVISOR)]
