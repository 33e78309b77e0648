"""What surfaces are made of: the materials, the road's paint, and what a material may look at."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mtl_bench.data.synthetic.camera import FloatArray


class Material(IntEnum):
    PLAIN = 0
    FACADE = 1  # params: storey m, bay m, window width share, window height share
    ASPHALT = 2
    PAVING = 3  # params: slab m
    GRASS = 4
    FOLIAGE = 5
    SLATS = 6  # params: period m, share of slat, 1 = horizontal
    MASONRY = 7  # params: course m
    BODY = 8  # vehicle: params: 1 = has front and rear lights
    CABIN = 9  # params: window from, to (share of the height), pillar share
    COACH = 10  # bus, tram: params: window from, to, bay m, stripe height share
    SIGN = 11  # params: design 0..4
    LAMPS = 12  # params: which lamp is lit 0..2
    PERSON = 13
    WHEEL = 14  # params: share of the radius that is tyre
    HEAD = 15
    ROOF = 16


@dataclass
class Markings:
    """Paint on the road, in world metres."""

    lines: list[tuple[float, float, float, float]] = field(
        default_factory=list
    )  # x, width, period, duty
    zebras: list[tuple[float, float]] = field(default_factory=list)  # z from, to
    free: list[tuple[float, float]] = field(default_factory=list)  # z from, to without lines
    rails: list[float] = field(default_factory=list)  # x
    x_range: tuple[float, float] = (-4.0, 4.0)


@dataclass
class Patch:
    """N samples: local metres p_N3 (y down) from the solid's middle, its half size and the like."""

    p_N3: FloatArray
    half_N3: FloatArray
    face_N3: FloatArray  # unit-space normal
    world_N3: FloatArray
    footprint_N: FloatArray  # width of the texture filter across the view, metres
    stretched_N: FloatArray  # the same along the surface's steepest way from the camera
    color_N3: FloatArray
    color2_N3: FloatArray
    params_N4: FloatArray
    noise_N: FloatArray
    markings: Markings

    @property
    def up_N(self) -> FloatArray:
        """Height above the solid's base, metres."""
        return self.half_N3[:, 1] - self.p_N3[:, 1]

    @property
    def along_N(self) -> FloatArray:
        """Horizontal position on a side face, metres."""
        on_side = np.abs(self.face_N3[:, 0]) > np.abs(self.face_N3[:, 2])
        return np.where(on_side, self.p_N3[:, 2], self.p_N3[:, 0])

    @property
    def top_N(self) -> FloatArray:
        return (np.abs(self.face_N3[:, 1]) > 0.7).astype(np.float32)


def rgb(*color: float) -> FloatArray:
    return np.array(color, np.float32)


WHITE, DARK, GLASS = rgb(0.9, 0.9, 0.88), rgb(0.06, 0.06, 0.07), rgb(0.1, 0.13, 0.17)
