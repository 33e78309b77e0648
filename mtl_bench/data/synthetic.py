"""The built-in scenes in Cityscapes' layout.

Source: `scenes/`, rendered into the user's cache by seed and number of the scene.
"""

from mtl_bench.data._rendered import Rendered
from mtl_bench.data.cityscapes import Cityscapes


class Synthetic(Rendered, Cityscapes):
    """Street scenes as videos, rendered on first use; what the numbers say is of them alone."""
