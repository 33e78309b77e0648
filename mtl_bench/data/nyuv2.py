"""NYUv2 as multi-task papers train on it: 13 classes, depth and surface normals of indoor rooms.

Source: Silberman et al., Indoor Segmentation and Support Inference from RGBD Images, ECCV 2012, in
the arrays of MTAN (Liu, Johns, Davison, CVPR 2019), 288 x 384: `{train,val}/{image,label,depth,
normal}/N.npy`, 795 and 654 frames. Label -1, depth 0 and a normal of zeros mean none.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from mtl_bench.core.dataset import Kind
from mtl_bench.core.labels import GROUND, Label, LabelSet
from mtl_bench.data._array_folders import ArrayFolders

ROOMS13 = LabelSet(
    "nyuv2-13",
    tuple(
        Label(name, index, False, color, role=GROUND if name == "floor" else "")
        for index, (name, color) in enumerate(
            {
                "bed": (0, 0, 255),
                "books": (232, 88, 47),
                "ceiling": (0, 217, 0),
                "chair": (148, 0, 240),
                "floor": (222, 241, 23),
                "furniture": (255, 205, 205),
                "objects": (0, 223, 228),
                "picture": (106, 135, 204),
                "sofa": (116, 28, 41),
                "table": (240, 35, 235),
                "tv": (0, 166, 156),
                "wall": (249, 139, 0),
                "window": (225, 228, 194),
            }.items()
        )
    ),
)


class Nyuv2(ArrayFolders):
    """One split; "val" is a fifth of the folder `train`, "test" is the folder `val`."""

    labels = ROOMS13
    fields: ClassVar[Mapping[str, Kind]] = {
        "instance_ids": Kind.IDS,
        "depth_m": Kind.DEPTH,
        "normals": Kind.NORMALS,
    }
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "instance_ids": ("label",),
        "depth_m": ("depth",),
        "normals": ("normal",),
    }
    layout = "NYUv2 arrays"
    marks = "train/normal/*.npy"
    published: ClassVar[Mapping[str, int]] = {"train": 795, "test": 654}

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return (root / "train" / "image").is_dir() and (root / "train" / "normal").is_dir()
