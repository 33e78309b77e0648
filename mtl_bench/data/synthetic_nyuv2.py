"""The built-in scenes in the layout of NYUv2's arrays: 13 street classes, exact depth and normals.

Source: `scenes/`, rendered into the user's cache by seed and number of the scene. The folder
`train` holds the recipe's training and validation scenes, of which the reader's fifth is held out:
four times as many train_scenes as val_scenes make the counts true. The folder `val` holds the
test scenes.
"""

from typing import ClassVar

from mtl_bench.data._rendered import Rendered
from mtl_bench.data.nyuv2 import Nyuv2
from mtl_bench.data.scenes.arrays import STREET13


class SyntheticNyuv2(Rendered, Nyuv2):
    """Street scenes, rendered on first use; what the numbers say is of them alone."""

    labels = STREET13
    published: ClassVar[dict[str, int]] = {}
