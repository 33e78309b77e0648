"""Data sets that are made in memory, from a recipe's settings alone: no file is read."""

import json
from pathlib import Path
from typing import ClassVar

from mtl_bench.core.dataset import Dataset
from mtl_bench.core.recipe import Data

IN_MEMORY = Path(__file__).resolve().parent  # stands for a folder; nothing is read from it


class InMemory(Dataset):
    """One split, which a subclass makes in `open_split`."""

    built_in: ClassVar[bool] = True
    has_camera: ClassVar[bool] = False
    # Settings of `recipe.data` that the samples depend on
    made_of: ClassVar[tuple[str, ...]] = (
        *("height", "width", "train_scenes", "val_scenes", "test_scenes"),
        "seed",
    )
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {"show": ("made_of",)}

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return root.resolve() == IN_MEMORY

    @classmethod
    def made_from(cls, data: Data, root: Path | None) -> str:
        return json.dumps([cls.name, *(getattr(data, key) for key in cls.made_of)])

    @classmethod
    def render(cls, data: Data, quiet: bool = False) -> Path:
        return IN_MEMORY

    def paths(self) -> list[Path]:
        return []
