"""The built-in scenes in Cityscapes' layout.

Source: `scenes/`, rendered into the user's cache by seed and number of the scene.
"""

from pathlib import Path
from typing import ClassVar

from mtl_bench.core.recipe import Data
from mtl_bench.data.cityscapes import Cityscapes


class Synthetic(Cityscapes):
    """Street scenes as videos, rendered on first use; what the numbers say is of them alone."""

    built_in: ClassVar[bool] = True

    @classmethod
    def made_from(cls, data: Data, root: Path | None) -> str | None:
        from mtl_bench.data import scenes

        return scenes.made_from(data, root, cls.layout)

    @classmethod
    def render(cls, data: Data, quiet: bool = False) -> Path:
        from mtl_bench.data import scenes

        return scenes.ensure(data, progress=not quiet, layout=cls.layout)
