"""Pictures of predictions: panoptic maps, depth and point clouds as RGB arrays; NumPy and OpenCV.

Images are uint8 [H,W,3] RGB. Whatever has text on it is drawn at `canvas.MIN_WIDTH` pixels or more,
so that it can be read over inputs of any size.
"""

from mtl_bench.show.render.canvas import Image, beside, enlarge, stack
from mtl_bench.show.render.depth import (
    NO_DEPTH,
    depth_colors,
    depth_picture,
    depth_range,
    scale_bar,
)
from mtl_bench.show.render.panoptic import legend, overlay, panoptic_picture, segment_colors
from mtl_bench.show.render.points import View, points_view

__all__ = ["NO_DEPTH", "Image", "View", "beside", "depth_colors", "depth_picture", "depth_range"]
__all__ += ["enlarge", "legend", "overlay", "panoptic_picture", "points_view", "scale_bar"]
__all__ += ["segment_colors", "stack"]
