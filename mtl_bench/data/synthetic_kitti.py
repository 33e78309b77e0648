"""The built-in scenes in KITTI's layout.

Source: `scenes/`, rendered into the user's cache by seed and number of the scene.
"""

from mtl_bench.data._rendered import Rendered
from mtl_bench.data.kitti import Kitti


class SyntheticKitti(Rendered, Kitti):
    """Street scenes as videos, rendered on first use; what the numbers say is of them alone."""
