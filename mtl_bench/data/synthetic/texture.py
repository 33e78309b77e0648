"""Materials: from a point on a solid to its colour before light.

Every material is a function of a `Patch` (the visible samples of one material) to albedo [N,3].
`PATCHES` maps each to its function and to the strength of its noise at every wavelength of
`noise.WAVELENGTHS_M`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mtl_bench.data.synthetic.camera import FloatArray
from mtl_bench.data.synthetic.noise import band, cell_random, mix, pulses


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

    lines: list[tuple[float, float, float, float]] = field(default_factory=list)  # x, width, period, duty
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


def _rgb(*color: float) -> FloatArray:
    return np.array(color, np.float32)


_WHITE, _DARK, _GLASS = _rgb(0.9, 0.9, 0.88), _rgb(0.06, 0.06, 0.07), _rgb(0.1, 0.13, 0.17)


def _plain(s: Patch) -> FloatArray:
    return s.color_N3


def _facade(s: Patch) -> FloatArray:
    """Storeys of windows over a ground floor of another colour; a cornice; a flat dark roof."""
    storey, bay, wide, tall = s.params_N4.T
    up, along, w, wide_w = s.up_N, s.along_N + 40.0, s.footprint_N, s.stretched_N
    column, row = along / bay, (up - 3.6) / storey
    window = pulses(column, wide, wide_w / bay) * pulses(row - 0.28, tall, w / storey)
    frame = pulses(column + 0.06, wide + 0.12, wide_w / bay) * pulses(row - 0.2, tall + 0.14, w / storey)
    upper, ground = band(up, 3.6, 1e3, w), band(up, 0.5, 2.8, w)
    lit = cell_random(np.floor(column), np.floor(row - 0.28))
    shown = np.clip(2 - 4 * wide_w / bay, 0, 1)  # single windows melt into their mean when far
    pane = _GLASS * (1 + 1.2 * shown * (lit - 0.4) + 0.5)[:, None]
    color = mix(s.color2_N3, s.color_N3, upper)
    color = mix(color, s.color_N3 * 0.5 + 0.42, frame * upper * 0.8)
    color = mix(color, pane, window * upper)
    shop = pulses(along / (bay * 1.6), 0.7, wide_w / (bay * 1.6)) * ground
    color = mix(color, _GLASS * 1.6, shop * 0.85)
    color = mix(color, s.color_N3 * 0.6, band(up, 3.3, 3.65, w))
    color = mix(color, s.color_N3 * 1.25, band(up - 2 * s.half_N3[:, 1], -0.5, 0.1, w))
    return mix(color, np.broadcast_to(_rgb(0.25, 0.2, 0.19), color.shape), s.top_N)


def _asphalt(s: Patch) -> FloatArray:
    x, z, w, long_w = s.world_N3[:, 0], s.world_N3[:, 2], s.footprint_N, s.stretched_N
    marks, paint = s.markings, np.zeros(len(x), np.float32)
    for at, width, period, duty in marks.lines:
        paint += band(x, at - width / 2, at + width / 2, w) * pulses(z / period, duty, long_w / period)
    for low, high in marks.free:
        paint *= 1 - band(z, low, high, long_w)
    on_road = band(x, *marks.x_range, w)
    for low, high in marks.zebras:
        paint = np.maximum(paint, band(z, low, high, long_w) * pulses(x / 1.0, 0.5, w) * on_road)
    rails = sum((band(x, at - 0.06, at + 0.06, w) for at in marks.rails), np.zeros_like(x))
    worn = np.clip(0.85 + 0.6 * s.noise_N, 0.4, 1) * np.clip(paint, 0, 1)
    tyres = 0.5 + 0.5 * np.cos((x - 0.75) * np.float32(2 * np.pi / 1.5))
    color = s.color_N3 * (1 - 0.1 * tyres * np.clip(1 - np.abs(x) / 8, 0, 1))[:, None]
    color = mix(color, np.broadcast_to(_rgb(0.12, 0.11, 0.11), color.shape), np.clip(rails, 0, 1))
    return mix(color, np.broadcast_to(_WHITE, color.shape), worn)


def _paving(s: Patch) -> FloatArray:
    slab = s.params_N4[:, 0]
    joint = 0.94
    x, z = s.world_N3[:, 0] / slab, s.world_N3[:, 2] / slab
    w, long_w = s.footprint_N / slab, s.stretched_N / slab
    solid = pulses(x, joint, w) * pulses(z, joint, long_w)
    tone = 0.16 * (cell_random(np.floor(x), np.floor(z)) - 0.5) * np.clip(1.5 - 8 * long_w, 0, 1)
    color = s.color_N3 * (0.75 + 0.25 * solid + tone)[:, None]
    edge = s.half_N3[:, 0] - np.abs(s.p_N3[:, 0])
    kerb = np.maximum(band(edge, -0.1, 0.18, s.footprint_N), 1 - s.top_N)
    return mix(color, s.color2_N3, kerb)


def _grass(s: Patch) -> FloatArray:
    return mix(s.color_N3, s.color2_N3, np.clip(0.5 + 0.8 * s.noise_N, 0, 1))


def _foliage(s: Patch) -> FloatArray:
    """Bright outside and on top, dark gaps between clumps of leaves."""
    clumps = np.clip(0.5 + 0.9 * s.noise_N, 0, 1)
    height = 0.75 - 0.3 * s.p_N3[:, 1] / s.half_N3[:, 1]
    return mix(s.color2_N3, s.color_N3, clumps) * height[:, None]


def _slats(s: Patch) -> FloatArray:
    period, duty, lying = s.params_N4[:, :3].T
    w = np.where(lying > 0, s.footprint_N, s.stretched_N) / period
    x = np.where(lying > 0, s.up_N, s.along_N) / period
    slat = pulses(x, duty, w)
    up, height = s.up_N, 2 * s.half_N3[:, 1]
    rails = band(up, height - 0.12, height, s.footprint_N) + band(up, 0.1, 0.2, s.footprint_N)
    posts = pulses(s.along_N / 2.4, 0.06, s.stretched_N / 2.4)
    share = np.clip(slat + rails + posts, 0, 1) * (1 - s.top_N) + s.top_N
    return mix(s.color2_N3, s.color_N3, share)


def _masonry(s: Patch) -> FloatArray:
    """Courses of blocks under a lighter coping."""
    course = s.params_N4[:, 0]
    w, wide_w = s.footprint_N / course, s.stretched_N / course
    row = s.up_N / course
    column = s.along_N / (2.2 * course) + 0.5 * (np.floor(row) % 2)
    solid = pulses(row, 0.88, w) * pulses(column, 0.94, wide_w / 2.2)
    tone = 0.25 * (cell_random(np.floor(column), np.floor(row)) - 0.5) * np.clip(1.5 - 6 * wide_w, 0, 1)
    color = mix(s.color2_N3, s.color_N3 * (1 + tone)[:, None], solid)
    height = 2 * s.half_N3[:, 1]
    coping = np.maximum(band(s.up_N, height - 0.16, height + 1, s.footprint_N), s.top_N)
    return mix(color, s.color_N3 * 0.6 + 0.3, coping)


def _body(s: Patch) -> FloatArray:
    """Sheet metal over a dark sill; lamps, grille and number plate at the ends (front = +z)."""
    w, up, height = s.footprint_N, s.up_N, 2 * s.half_N3[:, 1]
    share, ws = up / height, w / height
    color = mix(s.color_N3, _DARK * 2 + 0 * s.color_N3, band(share, -1, 0.16, ws))
    side = np.abs(s.face_N3[:, 0]) > 0.7
    doors = pulses((s.p_N3[:, 2] + 0.55) / 1.1, 0.04, s.stretched_N / 1.1) * side
    color = mix(color, color * 0.55, doors * 0.8)
    across = np.abs(s.p_N3[:, 0]) / s.half_N3[:, 0]
    wx = w / s.half_N3[:, 0]
    front, rear = (s.face_N3[:, 2] > 0.7).astype(w.dtype), (s.face_N3[:, 2] < -0.7).astype(w.dtype)
    lamps = band(across, 0.62, 0.97, wx) * band(share, 0.5, 0.82, ws) * s.params_N4[:, 0]
    middle = band(across, -1, 0.3, wx) * band(share, 0.34, 0.6, ws) * s.params_N4[:, 0]
    color = mix(color, _rgb(0.72, 0.05, 0.04) + 0 * color, lamps * rear)
    color = mix(color, _rgb(0.95, 0.95, 0.85) + 0 * color, lamps * front)
    color = mix(color, _WHITE + 0 * color, middle * rear)
    return mix(color, _DARK + 0 * color, middle * front)


def _cabin(s: Patch) -> FloatArray:
    """Windows all around between pillars, under a painted roof."""
    low, high, pillar = s.params_N4[:, :3].T
    w, height = s.footprint_N, 2 * s.half_N3[:, 1]
    across = np.abs(s.along_N) / np.where(np.abs(s.face_N3[:, 0]) > np.abs(s.face_N3[:, 2]),
                                          s.half_N3[:, 2], s.half_N3[:, 0])
    pane = band(s.up_N / height, low, high, w / height) * band(across, -1, 1 - pillar, w)
    split = pulses(s.p_N3[:, 2] / 1.2 + 0.05, 0.1, s.stretched_N / 1.2) * (np.abs(s.face_N3[:, 0]) > 0.5)
    glass = np.clip(pane - split, 0, 1) * (np.abs(s.face_N3[:, 1]) < 0.9)
    return mix(s.color_N3, _GLASS * 1.2 + 0 * s.color_N3, glass)


def _coach(s: Patch) -> FloatArray:
    """A long row of windows over a stripe; a full-width windscreen at the ends."""
    low, high, bay, stripe = s.params_N4.T
    w, height = s.footprint_N, 2 * s.half_N3[:, 1]
    share, ws = s.up_N / height, w / height
    side = (np.abs(s.face_N3[:, 0]) > 0.7).astype(w.dtype)
    color = mix(s.color_N3, s.color2_N3, band(share, 0.06, 0.06 + stripe, ws))
    row = band(share, low, high, ws) * pulses(s.along_N / bay, 0.86, s.stretched_N / bay) * side
    across = np.abs(s.p_N3[:, 0]) / s.half_N3[:, 0]
    ends = (1 - side) * band(across, -1, 0.9, w)
    screen = band(share, low - 0.06, high + 0.02, ws) * ends
    board = band(share, high + 0.04, high + 0.12, ws) * ends
    color = mix(color, _GLASS + 0 * color, np.clip(row + screen, 0, 1) * (1 - s.top_N))
    color = mix(color, _rgb(0.95, 0.7, 0.1) + 0 * color, board * (1 - s.top_N) * 0.8)
    lamp = band(across, 0.6, 0.9, w) * band(share, 0.08, 0.15, ws) * (1 - side) * (1 - s.top_N)
    red = (s.face_N3[:, 2] < 0)[:, None]
    return mix(color, np.where(red, _rgb(0.8, 0.05, 0.05), _WHITE), lamp)


def _sign(s: Patch) -> FloatArray:
    """Red ring, blue arrow, yellow diamond, red-white no-entry, or a blue-white board."""
    half = s.half_N3[:, 0]
    disc = s.half_N3[:, 1] < 0.1  # a cylinder whose axis, its own y, points along the street
    unit = s.p_N3 / s.half_N3
    x, y = np.where(disc, unit[:, 2], unit[:, 0]), np.where(disc, unit[:, 0], unit[:, 1])
    w = s.footprint_N / half
    radius = np.where(disc, np.sqrt(x * x + y * y), np.maximum(np.abs(x), np.abs(y)))
    inner, bar = band(radius, -1, 0.68, w), band(np.abs(y), -1, 0.22, w) * band(np.abs(x), -1, 0.7, w)
    stroke = band(np.abs(x), -1, 0.16, w) * band(np.abs(y), -1, 0.62, w)
    design = s.params_N4[:, 0].astype(np.int64)[:, None]
    red, blue, yellow = _rgb(0.82, 0.06, 0.07), _rgb(0.05, 0.22, 0.7), _rgb(0.98, 0.78, 0.08)
    base = np.choose(design, [red, blue, _WHITE, red, blue])
    first = np.choose(design, [_WHITE, blue, yellow, red, _WHITE])
    second = np.choose(design, [_DARK, _WHITE, yellow, _WHITE, blue])
    detail = np.where(design[:, 0] == 3, bar, stroke * (design[:, 0] != 2))
    return mix(mix(base, first, inner), second, detail).astype(np.float32)


def _lamps(s: Patch) -> FloatArray:
    height, width = 2 * s.half_N3[:, 1], s.half_N3[:, 0]
    third = s.up_N / height * 3
    w = s.footprint_N / width
    number = np.clip(np.floor(third), 0, 2)
    x, y = s.p_N3[:, 0] / width, (third - number - 0.5) * height / 3 / width
    lamp = band(np.sqrt(x * x + y * y), -1, 0.72, w) * (np.abs(s.face_N3[:, 2]) > 0.7)
    colors = np.array([[0.1, 0.85, 0.4], [1.0, 0.7, 0.1], [1.0, 0.12, 0.08]], np.float32)
    lit = np.where(number == s.params_N4[:, 0], 1.5, 0.35)
    glow = colors[number.astype(np.int64)] * lit[:, None].astype(np.float32)
    return mix(s.color_N3, glow, lamp)


def _person(s: Patch) -> FloatArray:
    return s.color_N3 * (0.9 + 0.12 * np.sign(s.noise_N))[:, None]


def _wheel(s: Patch) -> FloatArray:
    radius = np.sqrt((s.p_N3[:, 0] ** 2 + s.p_N3[:, 2] ** 2)) / s.half_N3[:, 0]
    hub = band(radius, -1, 1 - s.params_N4[:, 0], s.footprint_N / s.half_N3[:, 0]) * s.top_N
    return mix(_DARK + 0 * s.color_N3, s.color_N3, hub)


def _head(s: Patch) -> FloatArray:
    """Hair above and behind, skin elsewhere."""
    hair = band(s.p_N3[:, 1] / s.half_N3[:, 1] + 0.5 * s.p_N3[:, 2] / s.half_N3[:, 2], -3, -0.15,
                s.footprint_N / s.half_N3[:, 1])
    return mix(s.color_N3, s.color2_N3, hair)


def _roof(s: Patch) -> FloatArray:
    rows = pulses(s.up_N / 0.4, 0.75, s.footprint_N / 0.4)
    return s.color_N3 * (0.8 + 0.25 * rows)[:, None]


#: function, noise strength per wavelength (6.4, 2.3, .85, .32, .12, .045 m)
PATCHES: dict[Material, tuple[Callable[[Patch], FloatArray], tuple[float, ...]]] = {
    Material.PLAIN: (_plain, (0.1, 0.2, 0.25, 0.25, 0.2, 0.15)),
    Material.FACADE: (_facade, (0.9, 0.7, 0.35, 0.25, 0.2, 0.2)),
    Material.ASPHALT: (_asphalt, (0.8, 1.3, 0.5, 0.35, 0.3, 0.25)),
    Material.PAVING: (_paving, (0.5, 0.9, 0.4, 0.3, 0.25, 0.2)),
    Material.GRASS: (_grass, (0.5, 0.9, 0.6, 0.5, 0.45, 0.4)),
    Material.FOLIAGE: (_foliage, (0.1, 0.5, 0.8, 0.7, 0.55, 0.4)),
    Material.SLATS: (_slats, (0.25, 0.3, 0.3, 0.25, 0.2, 0.15)),
    Material.MASONRY: (_masonry, (0.35, 0.4, 0.4, 0.3, 0.25, 0.2)),
    Material.BODY: (_body, (0.0, 0.15, 0.2, 0.15, 0.1, 0.05)),
    Material.CABIN: (_cabin, (0.0, 0.15, 0.2, 0.15, 0.1, 0.05)),
    Material.COACH: (_coach, (0.1, 0.2, 0.22, 0.16, 0.1, 0.05)),
    Material.SIGN: (_sign, (0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.LAMPS: (_lamps, (0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.PERSON: (_person, (0.0, 0.1, 0.2, 0.25, 0.25, 0.15)),
    Material.WHEEL: (_wheel, (0.0, 0.0, 0.1, 0.1, 0.1, 0.1)),
    Material.HEAD: (_head, (0.0, 0.0, 0.05, 0.05, 0.05, 0.05)),
    Material.ROOF: (_roof, (0.25, 0.3, 0.3, 0.25, 0.2, 0.15)),
}
#: share of the street's direction in the noise: wear runs along the road, and a pixel is long there
STRETCH = {Material.ASPHALT: 0.35, Material.PAVING: 0.35, Material.GRASS: 0.35}
STRETCH |= dict.fromkeys((Material.FACADE, Material.SLATS, Material.MASONRY), 0.6)
OCTAVES = np.array([PATCHES[m][1] for m in Material], np.float32)
ALONG = np.array([STRETCH.get(m, 1.0) for m in Material], np.float32)
