"""What surfaces look like: the materials, and the colour of each one at a point.

Textures neither swim nor alias. Noise and patterns are functions of a point fixed to the object, so
every view of a surface sees the same texture; both take the pixel's footprint (metres on the
surface) and blur themselves to it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.scenes.rays import FloatArray


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

    #: x, width, period, duty
    lines: list[tuple[float, float, float, float]] = field(default_factory=list)
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
    def height_N(self) -> FloatArray:
        """Of the solid, metres."""
        return 2 * self.half_N3[:, 1]

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


# --- noise and box-filtered patterns --------------------------------------------------------------

WAVELENGTHS_M = (17.0, 6.4, 2.3, 0.85, 0.32, 0.12, 0.045)
_PERIOD = 32  # lattice cells until the noise repeats
_BITS = 5


def _lattice() -> FloatArray:
    """[32^3,8] values in [-1,1] at the corners of every cell; one fixed table for all scenes."""
    values = np.random.default_rng(0).uniform(-1, 1, (_PERIOD,) * 3).astype(np.float32)
    shifts = [(i, j, k) for i in (0, -1) for j in (0, -1) for k in (0, -1)]
    return np.stack([np.roll(values, s, (0, 1, 2)).ravel() for s in shifts], 1)


_CORNERS = _lattice()


def lattice_noise(points_N3: FloatArray) -> FloatArray:
    """Smooth noise [N] of unit wavelength, about [-1,1]."""
    cell = np.floor(points_N3)
    f = points_N3 - cell
    f = f * f * (3 - 2 * f)
    i = cell.astype(np.int32) & (_PERIOD - 1)
    c = _CORNERS[(i[:, 0] << 2 * _BITS) | (i[:, 1] << _BITS) | i[:, 2]]
    c = c[:, :4] + (c[:, 4:] - c[:, :4]) * f[:, 0, None]
    c = c[:, :2] + (c[:, 2:] - c[:, :2]) * f[:, 1, None]
    found: FloatArray = c[:, 0] + (c[:, 1] - c[:, 0]) * f[:, 2]
    return found


def fractal_noise(
    points_N3: FloatArray, amplitude_NK: FloatArray, footprint_N: FloatArray
) -> FloatArray:
    """Sum of octaves [N]; an octave fades out while its wavelength shrinks from 9 to 3 pixels."""
    total = np.zeros(len(points_N3), np.float32)
    for k, wavelength in enumerate(WAVELENGTHS_M):
        weight = amplitude_NK[:, k] * np.clip(np.log2(wavelength / (3 * footprint_N)) / 1.6, 0, 1)
        seen = np.flatnonzero(weight)
        if len(seen):
            shifted = points_N3[seen] * np.float32(1 / wavelength) + np.float32(7.31 * k)
            total[seen] += weight[seen] * lattice_noise(shifted)
    return total


def pulses(x: FloatArray, duty: FloatArray | float, width: FloatArray) -> FloatArray:
    """Coverage of a pulse train (1 on [0, duty), 0 on [duty, 1)) seen through a box of `width`."""
    width = np.maximum(width, 1e-3)

    def area(x: FloatArray) -> FloatArray:
        whole = np.floor(x)
        return whole * duty + np.minimum(x - whole, duty)

    return (area(x + width / 2) - area(x - width / 2)) / width


def band(
    x: FloatArray, low: FloatArray | float, high: FloatArray | float, width: FloatArray
) -> FloatArray:
    """Coverage of the interval [low, high] with edges that rise smoothly over 1.8 `width`."""
    width = np.maximum(1.8 * width, 1e-4)

    def edge(t: FloatArray) -> FloatArray:
        t = np.clip(t + 0.5, 0, 1)
        return t * t * (3 - 2 * t)

    return edge((x - low) / width) - edge((x - high) / width)


def mix(a: FloatArray, b: FloatArray, share_N: FloatArray) -> FloatArray:
    """Colours a [.,3] where the share is 0, b where it is 1."""
    return a + (b - a) * share_N[:, None]


def cell_random(a: NDArray[Any], b: NDArray[Any]) -> FloatArray:
    """A number in [0,1) for every integer pair: which window is lit."""
    h = (a.astype(np.int64) * 73856093) ^ (b.astype(np.int64) * 19349663)
    return (((h * 2654435761) >> 8) & 1023).astype(np.float32) / 1024


# --- albedo: a patch's colours [N,3] --------------------------------------------------------------


def plain(s: Patch) -> FloatArray:
    return s.color_N3


def facade(s: Patch) -> FloatArray:
    """Storeys of windows over a ground floor of another colour; a cornice; a flat dark roof."""
    storey, bay, wide, tall = s.params_N4.T
    up, along, w, wide_w = s.up_N, s.along_N + 40.0, s.footprint_N, s.stretched_N
    column, row = along / bay, (up - 3.6) / storey
    w_bay, w_storey = wide_w / bay, w / storey
    window = pulses(column, wide, w_bay) * pulses(row - 0.28, tall, w_storey)
    frame = pulses(column + 0.06, wide + 0.12, w_bay) * pulses(row - 0.2, tall + 0.14, w_storey)
    upper, ground = band(up, 3.6, 1e3, w), band(up, 0.5, 2.8, w)
    lit = cell_random(np.floor(column), np.floor(row - 0.28))
    shown = np.clip(2 - 4 * wide_w / bay, 0, 1)  # single windows melt into their mean when far
    pane = GLASS * (1 + 1.2 * shown * (lit - 0.4) + 0.5)[:, None]
    color = mix(s.color2_N3, s.color_N3, upper)
    color = mix(color, s.color_N3 * 0.5 + 0.42, frame * upper * 0.8)
    color = mix(color, pane, window * upper)
    shop = pulses(along / (bay * 1.6), 0.7, wide_w / (bay * 1.6)) * ground
    color = mix(color, GLASS * 1.6, shop * 0.85)
    color = mix(color, s.color_N3 * 0.6, band(up, 3.3, 3.65, w))
    color = mix(color, s.color_N3 * 1.25, band(up - s.height_N, -0.5, 0.1, w))
    return mix(color, rgb(0.25, 0.2, 0.19), s.top_N)


def _stripes(x: FloatArray, w: FloatArray) -> FloatArray:
    """Zebra stripes of half a metre, filtered more smoothly than by one box."""
    return (pulses(x - w / 2, 0.5, w) + 2 * pulses(x, 0.5, w) + pulses(x + w / 2, 0.5, w)) / 4


def asphalt(s: Patch) -> FloatArray:
    x, z, w, long_w = s.world_N3[:, 0], s.world_N3[:, 2], s.footprint_N, s.stretched_N
    marks, paint = s.markings, np.zeros(len(x), np.float32)
    for at, width, period, duty in marks.lines:
        dashes = pulses(z / period, duty, long_w / period)
        paint += band(x, at - width / 2, at + width / 2, w) * dashes
    for low, high in marks.free:
        paint *= 1 - band(z, low, high, long_w)
    on_road = band(x, *marks.x_range, w)
    for low, high in marks.zebras:
        paint = np.maximum(paint, band(z, low, high, long_w) * _stripes(x, w) * on_road)
    rails = sum((band(x, at - 0.06, at + 0.06, w) for at in marks.rails), np.zeros_like(x))
    worn = np.clip(0.85 + 0.6 * s.noise_N, 0.4, 1) * np.clip(paint, 0, 1)
    tyres = 0.5 + 0.5 * np.cos((x - 0.75) * np.float32(2 * np.pi / 1.5))
    color = s.color_N3 * (1 - 0.1 * tyres * np.clip(1 - np.abs(x) / 8, 0, 1))[:, None]
    color = mix(color, rgb(0.12, 0.11, 0.11), np.clip(rails, 0, 1))
    return mix(color, WHITE, worn)


def paving(s: Patch) -> FloatArray:
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


def grass(s: Patch) -> FloatArray:
    return mix(s.color_N3, s.color2_N3, np.clip(0.5 + 0.8 * s.noise_N, 0, 1))


def foliage(s: Patch) -> FloatArray:
    """Bright outside and on top, dark gaps between clumps of leaves."""
    clumps = np.clip(0.5 + 0.9 * s.noise_N, 0, 1)
    height = 1.15 - 0.35 * s.p_N3[:, 1] / s.half_N3[:, 1]
    return mix(s.color2_N3, s.color_N3, clumps) * height[:, None]


def slats(s: Patch) -> FloatArray:
    period, duty, lying = s.params_N4[:, :3].T
    w = np.where(lying > 0, s.footprint_N, s.stretched_N) / period
    x = np.where(lying > 0, s.up_N, s.along_N) / period
    slat = pulses(x, duty, w)
    up, height = s.up_N, s.height_N
    rails = band(up, height - 0.12, height, s.footprint_N) + band(up, 0.1, 0.2, s.footprint_N)
    posts = pulses(s.along_N / 2.4, 0.06, s.stretched_N / 2.4)
    share = np.clip(slat + rails + posts, 0, 1) * (1 - s.top_N) + s.top_N
    return mix(s.color2_N3, s.color_N3, share)


def masonry(s: Patch) -> FloatArray:
    """Courses of blocks under a lighter coping."""
    course = s.params_N4[:, 0]
    w, wide_w = s.footprint_N / course, s.stretched_N / course
    row = s.up_N / course
    column = s.along_N / (2.2 * course) + 0.5 * (np.floor(row) % 2)
    solid = pulses(row, 0.88, w) * pulses(column, 0.94, wide_w / 2.2)
    block = cell_random(np.floor(column), np.floor(row))
    tone = 0.25 * (block - 0.5) * np.clip(1.5 - 6 * wide_w, 0, 1)
    color = mix(s.color2_N3, s.color_N3 * (1 + tone)[:, None], solid)
    height = s.height_N
    coping = np.maximum(band(s.up_N, height - 0.16, height + 1, s.footprint_N), s.top_N)
    return mix(color, s.color_N3 * 0.6 + 0.3, coping)


def roof(s: Patch) -> FloatArray:
    rows = pulses(s.up_N / 0.4, 0.75, s.footprint_N / 0.4)
    return s.color_N3 * (0.8 + 0.25 * rows)[:, None]


def body(s: Patch) -> FloatArray:
    """Sheet metal over a dark sill; lamps, grille and number plate at the ends (front = +z)."""
    w = s.footprint_N
    share, ws = s.up_N / s.height_N, w / s.height_N
    color = mix(s.color_N3, DARK * 2, band(share, -1, 0.16, ws))
    side = np.abs(s.face_N3[:, 0]) > 0.7
    doors = pulses((s.p_N3[:, 2] + 0.55) / 1.1, 0.04, s.stretched_N / 1.1) * side
    color = mix(color, color * 0.55, doors * 0.8)
    across = np.abs(s.p_N3[:, 0]) / s.half_N3[:, 0]
    wx = w / s.half_N3[:, 0]
    front, rear = (s.face_N3[:, 2] > 0.7).astype(w.dtype), (s.face_N3[:, 2] < -0.7).astype(w.dtype)
    lamps = band(across, 0.62, 0.97, wx) * band(share, 0.5, 0.82, ws) * s.params_N4[:, 0]
    middle = band(across, -1, 0.3, wx) * band(share, 0.34, 0.6, ws) * s.params_N4[:, 0]
    color = mix(color, rgb(0.72, 0.05, 0.04), lamps * rear)
    color = mix(color, rgb(0.95, 0.95, 0.85), lamps * front)
    color = mix(color, WHITE, middle * rear)
    return mix(color, DARK, middle * front)


def cabin(s: Patch) -> FloatArray:
    """Windows all around between pillars, under a painted roof."""
    low, high, pillar = s.params_N4[:, :3].T
    w, height = s.footprint_N, s.height_N
    on_side = np.abs(s.face_N3[:, 0]) > np.abs(s.face_N3[:, 2])
    across = np.abs(s.along_N) / np.where(on_side, s.half_N3[:, 2], s.half_N3[:, 0])
    pane = band(s.up_N / height, low, high, w / height) * band(across, -1, 1 - pillar, w)
    split = pulses(s.p_N3[:, 2] / 1.2 + 0.05, 0.1, s.stretched_N / 1.2)
    pane = pane - split * (np.abs(s.face_N3[:, 0]) > 0.5)
    glass = np.clip(pane, 0, 1) * (np.abs(s.face_N3[:, 1]) < 0.9)
    return mix(s.color_N3, GLASS * 1.2, glass)


def coach(s: Patch) -> FloatArray:
    """A long row of windows over a stripe; a full-width windscreen at the ends."""
    low, high, bay, stripe = s.params_N4.T
    w, height = s.footprint_N, s.height_N
    share, ws = s.up_N / height, w / height
    side = (np.abs(s.face_N3[:, 0]) > 0.7).astype(w.dtype)
    color = mix(s.color_N3, s.color2_N3, band(share, 0.06, 0.06 + stripe, ws))
    row = band(share, low, high, ws) * pulses(s.along_N / bay, 0.86, s.stretched_N / bay) * side
    across = np.abs(s.p_N3[:, 0]) / s.half_N3[:, 0]
    ends = (1 - side) * band(across, -1, 0.9, w)
    screen = band(share, low - 0.06, high + 0.02, ws) * ends
    board = band(share, high + 0.04, high + 0.12, ws) * ends
    color = mix(color, GLASS, np.clip(row + screen, 0, 1) * (1 - s.top_N))
    color = mix(color, rgb(0.95, 0.7, 0.1), board * (1 - s.top_N) * 0.8)
    lamp = band(across, 0.6, 0.9, w) * band(share, 0.08, 0.15, ws) * (1 - side) * (1 - s.top_N)
    red = (s.face_N3[:, 2] < 0)[:, None]
    return mix(color, np.where(red, rgb(0.8, 0.05, 0.05), WHITE), lamp)


def sign(s: Patch) -> FloatArray:
    """Red ring, blue arrow, yellow diamond, red-white no-entry, or a blue-white board."""
    half = s.half_N3[:, 0]
    disc = s.half_N3[:, 1] < 0.1  # a cylinder whose axis, its own y, points along the street
    unit = s.p_N3 / s.half_N3
    x, y = np.where(disc, unit[:, 2], unit[:, 0]), np.where(disc, unit[:, 0], unit[:, 1])
    w = s.footprint_N / half
    radius = np.where(disc, np.sqrt(x * x + y * y), np.maximum(np.abs(x), np.abs(y)))
    inner = band(radius, -1, 0.68, w)
    bar = band(np.abs(y), -1, 0.22, w) * band(np.abs(x), -1, 0.7, w)
    stroke = band(np.abs(x), -1, 0.16, w) * band(np.abs(y), -1, 0.62, w)
    design = s.params_N4[:, 0].astype(np.int64)[:, None]
    red, blue, yellow = rgb(0.82, 0.06, 0.07), rgb(0.05, 0.22, 0.7), rgb(0.98, 0.78, 0.08)
    base = np.choose(design, [red, blue, WHITE, red, blue])
    first = np.choose(design, [WHITE, blue, yellow, red, WHITE])
    second = np.choose(design, [DARK, WHITE, yellow, WHITE, blue])
    detail = np.where(design[:, 0] == 3, bar, stroke * (design[:, 0] != 2))
    return mix(mix(base, first, inner), second, detail).astype(np.float32)


def lamps(s: Patch) -> FloatArray:
    height, width = s.height_N, s.half_N3[:, 0]
    third = s.up_N / height * 3
    w = s.footprint_N / width
    number = np.clip(np.floor(third), 0, 2)
    x, y = s.p_N3[:, 0] / width, (third - number - 0.5) * height / 3 / width
    lamp = band(np.sqrt(x * x + y * y), -1, 0.72, w) * (np.abs(s.face_N3[:, 2]) > 0.7)
    colors = np.array([[0.1, 0.85, 0.4], [1.0, 0.7, 0.1], [1.0, 0.12, 0.08]], np.float32)
    lit = np.where(number == s.params_N4[:, 0], 1.5, 0.35)
    glow = colors[number.astype(np.int64)] * lit[:, None].astype(np.float32)
    return mix(s.color_N3, glow, lamp)


def person(s: Patch) -> FloatArray:
    return s.color_N3 * (0.9 + 0.12 * np.sign(s.noise_N))[:, None]


def wheel(s: Patch) -> FloatArray:
    radius = np.sqrt(s.p_N3[:, 0] ** 2 + s.p_N3[:, 2] ** 2) / s.half_N3[:, 0]
    hub = band(radius, -1, 1 - s.params_N4[:, 0], s.footprint_N / s.half_N3[:, 0]) * s.top_N
    return mix(DARK, s.color_N3, hub)


def head(s: Patch) -> FloatArray:
    """Hair above and behind, skin elsewhere."""
    across = s.p_N3[:, 1] / s.half_N3[:, 1] + 0.5 * s.p_N3[:, 2] / s.half_N3[:, 2]
    hair = band(across, -3, -0.15, s.footprint_N / s.half_N3[:, 1])
    return mix(s.color_N3, s.color2_N3, hair)


# --- the table of materials -----------------------------------------------------------------------


class Look(NamedTuple):
    """What paints a material, how rough it is, and how it is filtered."""

    albedo: Callable[[Patch], FloatArray]
    noise: tuple[float, ...]  # strength per wavelength: 17, 6.4, 2.3, .85, .32, .12, .045 m
    #: width of the patterns' filter: wide where surfaces are large and pass close by, as whoever
    #: warps a frame interpolates between its pixels; narrow on small things, to keep their look
    filter_px: float = 1.2
    #: share of the street's direction in the noise: wear runs along the road, where a pixel is long
    along: float = 1.0
    #: share of the pixel at which noise is faded: leaves may be finer than interpolation likes
    fine: float = 1.0


LOOKS = {
    Material.PLAIN: Look(plain, (0.0, 0.1, 0.2, 0.25, 0.25, 0.2, 0.15)),
    Material.FACADE: Look(facade, (0.6, 0.9, 0.75, 0.35, 0.25, 0.2, 0.2), 4.5, 0.6),
    Material.ASPHALT: Look(asphalt, (1.0, 1.1, 1.3, 1.0, 0.6, 0.35, 0.25), 5.0, 0.7),
    Material.PAVING: Look(paving, (0.8, 0.5, 0.9, 0.7, 0.4, 0.3, 0.2), 3.5, 0.7),
    Material.GRASS: Look(grass, (0.8, 0.5, 0.9, 0.6, 0.5, 0.45, 0.4), along=0.7),
    Material.FOLIAGE: Look(foliage, (0.0, 0.0, 0.4, 0.5, 0.6, 0.8, 0.8), fine=0.5),
    Material.SLATS: Look(slats, (0.0, 0.25, 0.3, 0.3, 0.25, 0.2, 0.15), 3.5, 0.6),
    Material.MASONRY: Look(masonry, (0.0, 0.35, 0.4, 0.4, 0.3, 0.25, 0.2), 3.5, 0.6),
    Material.BODY: Look(body, (0.0, 0.0, 0.15, 0.2, 0.15, 0.1, 0.05), 2.2),
    Material.CABIN: Look(cabin, (0.0, 0.0, 0.15, 0.2, 0.15, 0.1, 0.05), 2.2),
    Material.COACH: Look(coach, (0.0, 0.1, 0.2, 0.22, 0.16, 0.1, 0.05), 2.2),
    Material.SIGN: Look(sign, (0.0, 0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.LAMPS: Look(lamps, (0.0, 0.0, 0.0, 0.06, 0.06, 0.05, 0.05)),
    Material.PERSON: Look(person, (0.0, 0.0, 0.1, 0.2, 0.25, 0.25, 0.15), fine=0.7),
    Material.WHEEL: Look(wheel, (0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1)),
    Material.HEAD: Look(head, (0.0, 0.0, 0.0, 0.05, 0.05, 0.05, 0.05)),
    Material.ROOF: Look(roof, (0.0, 0.25, 0.3, 0.3, 0.25, 0.2, 0.15), 3.0),
}
NOISE = np.array([LOOKS[m].noise for m in Material], np.float32)
ALONG = np.array([LOOKS[m].along for m in Material], np.float32)
FINE = np.array([LOOKS[m].fine for m in Material], np.float32)
