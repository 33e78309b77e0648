"""Depth as a viewer sees it: colours, near bright and far dark, and in which unit it is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core import canvas
from mtl_bench.core.canvas import Image, LogScale
from mtl_bench.core.view import METRES, STEPS, Key, Surface, View

HEIGHTS, UNSCALED = "camera heights", "network units"
RANGES = {METRES: (2.0, 80.0), HEIGHTS: (1.5, 60.0)}  # ends of the colours, by unit
LARGEST = 2**16 - 1  # value of a depth file
_TABLE = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[::-1, None], cv2.COLORMAP_INFERNO)
TABLE = np.asarray(_TABLE[:, 0, ::-1], np.uint8)  # RGB, near first


def scale_of(depth: NDArray[np.floating[Any]], unit: str) -> LogScale:
    """Colours from the nearest to the farthest: fixed for a known unit, else this map's own."""
    if unit in RANGES:
        return LogScale(*RANGES[unit], unit, TABLE)
    known = depth[depth > 0]
    if not known.size:
        return LogScale(1.0, 10.0, unit, TABLE)
    near, far = np.percentile(known, (2, 98)).tolist()
    return LogScale(near, max(far, 1.5 * near), unit, TABLE)


@dataclass(frozen=True)
class DepthView(Surface):
    """Depth in metres, or in camera heights; in the network's unit where no ground was found."""

    task = "depth"

    @property
    def steps(self) -> int:
        """Without a scale the largest power of 2 that the farthest pixel allows."""
        if self.unit in RANGES:
            return STEPS
        return int(2 ** np.floor(np.log2(LARGEST / max(self.depth_HW.max(), 1))))

    def scale(self, depth: NDArray[np.floating[Any]]) -> LogScale:
        return scale_of(depth, self.unit)

    def picture(self, image_HW3: Image) -> Image:
        colors = scale_of(self.depth_HW, self.unit).colors
        return colors(canvas.nearest(self.depth_HW, image_HW3))

    def explained(self, image_HW3: Image, whole: bool = False) -> Image:
        """The colours, enlarged where the map is tiny, above the bar."""
        scale, times = scale_of(self.depth_HW, self.unit), canvas.factor(self.depth_HW.shape[1])
        colors = canvas.enlarge(scale.colors(self.depth_HW), times)
        return canvas.stack([colors, scale.bar(colors.shape[1])])

    def files(self, kind: str, image_HW3: Image) -> dict[str, NDArray[Any]]:
        """`depth_colors` with a scale bar; `depth`, 16 bits in 1/`steps` of the unit, 0 = none."""
        if kind != "depth":
            return {}
        steps_HW = np.rint(self.depth_HW * self.steps).clip(0, LARGEST)
        return {"depth_colors": self.explained(image_HW3), "depth": steps_HW.astype(np.uint16)}

    @classmethod
    def key(cls, views: Sequence[View]) -> Key:
        """One scale for all maps where they have one unit and that has a scale."""
        units = {view.unit for view in views if isinstance(view, cls)}
        unit = units.pop() if len(units) == 1 else ""
        if unit not in RANGES:
            ends = {0.0: "near", 1.0: "far"}
            return Key("Depth, near to far in each", scale=LogScale(1, 100, "", TABLE), marks=ends)
        scale = LogScale(*RANGES[unit], unit, TABLE)
        marks = {scale.place(value): f"{value:g}" for value in scale.ticks()}
        return Key(f"Depth [{unit}]", scale=scale, marks=marks)
