"""Albedo of what moves and of signs: one function a material, `Patch` to colours [N,3]."""

import numpy as np

from mtl_bench.data.synthetic.camera import FloatArray
from mtl_bench.data.synthetic.material import DARK, GLASS, WHITE, Patch, rgb
from mtl_bench.data.synthetic.noise import band, mix, pulses


def body(s: Patch) -> FloatArray:
    """Sheet metal over a dark sill; lamps, grille and number plate at the ends (front = +z)."""
    w, up, height = s.footprint_N, s.up_N, 2 * s.half_N3[:, 1]
    share, ws = up / height, w / height
    color = mix(s.color_N3, DARK * 2 + 0 * s.color_N3, band(share, -1, 0.16, ws))
    side = np.abs(s.face_N3[:, 0]) > 0.7
    doors = pulses((s.p_N3[:, 2] + 0.55) / 1.1, 0.04, s.stretched_N / 1.1) * side
    color = mix(color, color * 0.55, doors * 0.8)
    across = np.abs(s.p_N3[:, 0]) / s.half_N3[:, 0]
    wx = w / s.half_N3[:, 0]
    front, rear = (s.face_N3[:, 2] > 0.7).astype(w.dtype), (s.face_N3[:, 2] < -0.7).astype(w.dtype)
    lamps = band(across, 0.62, 0.97, wx) * band(share, 0.5, 0.82, ws) * s.params_N4[:, 0]
    middle = band(across, -1, 0.3, wx) * band(share, 0.34, 0.6, ws) * s.params_N4[:, 0]
    color = mix(color, rgb(0.72, 0.05, 0.04) + 0 * color, lamps * rear)
    color = mix(color, rgb(0.95, 0.95, 0.85) + 0 * color, lamps * front)
    color = mix(color, WHITE + 0 * color, middle * rear)
    return mix(color, DARK + 0 * color, middle * front)


def cabin(s: Patch) -> FloatArray:
    """Windows all around between pillars, under a painted roof."""
    low, high, pillar = s.params_N4[:, :3].T
    w, height = s.footprint_N, 2 * s.half_N3[:, 1]
    across = np.abs(s.along_N) / np.where(
        np.abs(s.face_N3[:, 0]) > np.abs(s.face_N3[:, 2]), s.half_N3[:, 2], s.half_N3[:, 0]
    )
    pane = band(s.up_N / height, low, high, w / height) * band(across, -1, 1 - pillar, w)
    split = pulses(s.p_N3[:, 2] / 1.2 + 0.05, 0.1, s.stretched_N / 1.2) * (
        np.abs(s.face_N3[:, 0]) > 0.5
    )
    glass = np.clip(pane - split, 0, 1) * (np.abs(s.face_N3[:, 1]) < 0.9)
    return mix(s.color_N3, GLASS * 1.2 + 0 * s.color_N3, glass)


def coach(s: Patch) -> FloatArray:
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
    color = mix(color, GLASS + 0 * color, np.clip(row + screen, 0, 1) * (1 - s.top_N))
    color = mix(color, rgb(0.95, 0.7, 0.1) + 0 * color, board * (1 - s.top_N) * 0.8)
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
    inner, bar = (
        band(radius, -1, 0.68, w),
        band(np.abs(y), -1, 0.22, w) * band(np.abs(x), -1, 0.7, w),
    )
    stroke = band(np.abs(x), -1, 0.16, w) * band(np.abs(y), -1, 0.62, w)
    design = s.params_N4[:, 0].astype(np.int64)[:, None]
    red, blue, yellow = rgb(0.82, 0.06, 0.07), rgb(0.05, 0.22, 0.7), rgb(0.98, 0.78, 0.08)
    base = np.choose(design, [red, blue, WHITE, red, blue])
    first = np.choose(design, [WHITE, blue, yellow, red, WHITE])
    second = np.choose(design, [DARK, WHITE, yellow, WHITE, blue])
    detail = np.where(design[:, 0] == 3, bar, stroke * (design[:, 0] != 2))
    return mix(mix(base, first, inner), second, detail).astype(np.float32)


def lamps(s: Patch) -> FloatArray:
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


def person(s: Patch) -> FloatArray:
    return s.color_N3 * (0.9 + 0.12 * np.sign(s.noise_N))[:, None]


def wheel(s: Patch) -> FloatArray:
    radius = np.sqrt(s.p_N3[:, 0] ** 2 + s.p_N3[:, 2] ** 2) / s.half_N3[:, 0]
    hub = band(radius, -1, 1 - s.params_N4[:, 0], s.footprint_N / s.half_N3[:, 0]) * s.top_N
    return mix(DARK + 0 * s.color_N3, s.color_N3, hub)


def head(s: Patch) -> FloatArray:
    """Hair above and behind, skin elsewhere."""
    hair = band(
        s.p_N3[:, 1] / s.half_N3[:, 1] + 0.5 * s.p_N3[:, 2] / s.half_N3[:, 2],
        -3,
        -0.15,
        s.footprint_N / s.half_N3[:, 1],
    )
    return mix(s.color_N3, s.color2_N3, hair)
