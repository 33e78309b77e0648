"""Cityscapes as two-task papers train on it: 7 classes and inverse depth at 128 x 256.

Source: Cordts et al., The Cityscapes Dataset, CVPR 2016, in the arrays of MTAN (Liu, Johns,
Davison, CVPR 2019): `{train,val}/{image,label_7,label_19,depth}/N.npy`, 2975 and 500 frames; a
folder `label` is `label_7` renamed, as other readers want it. "Depth" is the raw disparity / 65535,
an inverse depth without metres: 0 means none. Label -1 means none. Which category each of the 7
numbers is, is not documented: the order of Cityscapes' category ids is assumed, for names alone.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from mtl_bench.core.dataset import Kind
from mtl_bench.core.labels import GROUND, NO_SURFACE, Label, LabelSet
from mtl_bench.data._array_folders import ArrayFolders

# Cityscapes' categories without void, in the order of their ids
CATEGORIES7 = LabelSet(
    "cityscapes-7",
    (
        Label("flat", 0, False, (128, 64, 128), role=GROUND),
        Label("construction", 1, False, (70, 70, 70)),
        Label("object", 2, False, (153, 153, 153)),
        Label("nature", 3, False, (107, 142, 35)),
        Label("sky", 4, False, (70, 130, 180), role=NO_SURFACE),
        Label("human", 5, False, (220, 20, 60)),
        Label("vehicle", 6, False, (0, 0, 142)),
    ),
)


class CityscapesMtan(ArrayFolders):
    """One split; "val" is a fifth of the folder `train`, "test" is the folder `val`."""

    labels = CATEGORIES7
    fields: ClassVar[Mapping[str, Kind]] = {
        "instance_ids": Kind.IDS,
        "inverse_depth": Kind.INVERSE_DEPTH,
    }
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "instance_ids": ("label_7", "label"),
        "inverse_depth": ("depth",),
    }
    layout = "Cityscapes arrays"
    marks = "train/label_7/*.npy"
    published: ClassVar[Mapping[str, int]] = {"train": 2975, "test": 500}

    @classmethod
    def recognises(cls, root: Path) -> bool:
        train = root / "train"
        labelled = any((train / name).is_dir() for name in ("label", "label_7", "label_19"))
        return (train / "image").is_dir() and labelled and not (train / "normal").is_dir()
