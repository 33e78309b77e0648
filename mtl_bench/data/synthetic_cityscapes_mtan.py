"""The built-in scenes in the layout of Cityscapes' arrays: 7 classes and exact inverse depth.

Source: `scenes/`, rendered into the user's cache by seed and number of the scene; splits as of
`synthetic-nyuv2`.
"""

from typing import ClassVar

from mtl_bench.data._rendered import Rendered
from mtl_bench.data.cityscapes_mtan import CityscapesMtan


class SyntheticCityscapesMtan(Rendered, CityscapesMtan):
    """Street scenes, rendered on first use; what the numbers say is of them alone."""

    published: ClassVar[dict[str, int]] = {}
