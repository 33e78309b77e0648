"""What a rendered data set is made from: sizes, counts, a seed and a layout of files."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from mtl_bench.data import png
from mtl_bench.data.scenes.render import RENDERER_VERSION

CITYSCAPES, KITTI = "Cityscapes", "KITTI raw"  # layouts of files
NYUV2, CITYSCAPES_ARRAYS = "NYUv2 arrays", "Cityscapes arrays"
RECORD = "synthetic.json"  # in a data set's folder: its settings
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Settings:
    """What the bytes of a data set depend on."""

    height: int
    width: int
    train_scenes: int
    val_scenes: int
    test_scenes: int
    seed: int
    frames: int
    annotated: int  # index of the frame that has labels
    min_instance_area: int  # visible pixels below which a thing is written as a group
    renderer_version: int = RENDERER_VERSION
    layout: str = CITYSCAPES

    def __post_init__(self) -> None:
        """Raises: ValueError: sizes or counts that cannot be rendered."""
        if self.height < 16 or self.width < 16:
            raise ValueError(
                f"{self.height}x{self.width} is too small to render; use 16x16 or more"
            )
        if not 0 <= self.annotated < self.frames:
            raise ValueError(f"annotated frame {self.annotated} is not among {self.frames} frames")
        if min(self.counts) < 0 or sum(self.counts) == 0:
            raise ValueError(
                f"cannot render {self.counts} scenes; give counts >= 0, one of them > 0"
            )

    @property
    def counts(self) -> tuple[int, int, int]:
        return self.train_scenes, self.val_scenes, self.test_scenes

    @property
    def video(self) -> tuple[int, int, int, int]:
        """Height, width, number of frames and the annotated one, of every scene."""
        return self.height, self.width, self.frames, self.annotated

    @property
    def scenes(self) -> list[tuple[int, int]]:
        """(split, scene) of all scenes in a fixed order."""
        return [(split, i) for split, count in enumerate(self.counts) for i in range(count)]

    @property
    def values(self) -> dict[str, Any]:
        """As they are written down; Cityscapes' layout, once the only one, is not named."""
        values = asdict(self)
        if self.layout == CITYSCAPES:
            del values["layout"]
        return values

    @property
    def key(self) -> str:
        return key_of(self.values)

    def write(self, root: Path) -> None:
        """Leave beside the data set what it was made from."""
        (root / RECORD).write_text(json.dumps(self.values, indent=4) + "\n")


def key_of(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def write_png(path: Path, image: NDArray[Any]) -> None:
    path.write_bytes(png.encode(image, cv2.IMWRITE_PNG_COMPRESSION, 2))  # 2: fast
