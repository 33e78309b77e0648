"""The built-in scenes as data sets: `scenes/` writes them in the layout of a published one.

They are rendered into the user's cache by seed and number of the scene.
"""

from pathlib import Path
from typing import ClassVar

from mtl_bench.core.dataset import Dataset
from mtl_bench.core.recipe import Data


class Rendered(Dataset):
    """Street scenes in the layout of the reader beside it among a class's bases."""

    built_in: ClassVar[bool] = True

    @classmethod
    def made_from(cls, data: Data, root: Path | None) -> str | None:
        from mtl_bench.data import scenes

        return scenes.made_from(data, root, cls.layout)

    @classmethod
    def render(cls, data: Data, quiet: bool = False) -> Path:
        from mtl_bench.data import scenes

        return scenes.ensure(data, progress=not quiet, layout=cls.layout)
