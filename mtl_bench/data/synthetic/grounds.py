"""Albedo of what is built and grows: one function a material, `Patch` to colours [N,3]."""

import numpy as np

from mtl_bench.data.synthetic.camera import FloatArray
from mtl_bench.data.synthetic.material import GLASS, WHITE, Patch, rgb
from mtl_bench.data.synthetic.noise import band, cell_random, mix, pulses


def plain(s: Patch) -> FloatArray:
    return s.color_N3


def facade(s: Patch) -> FloatArray:
    """Storeys of windows over a ground floor of another colour; a cornice; a flat dark roof."""
    storey, bay, wide, tall = s.params_N4.T
    up, along, w, wide_w = s.up_N, s.along_N + 40.0, s.footprint_N, s.stretched_N
    column, row = along / bay, (up - 3.6) / storey
    window = pulses(column, wide, wide_w / bay) * pulses(row - 0.28, tall, w / storey)
    frame = pulses(column + 0.06, wide + 0.12, wide_w / bay) * pulses(
        row - 0.2, tall + 0.14, w / storey
    )
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
    color = mix(color, s.color_N3 * 1.25, band(up - 2 * s.half_N3[:, 1], -0.5, 0.1, w))
    return mix(color, np.broadcast_to(rgb(0.25, 0.2, 0.19), color.shape), s.top_N)


def _stripes(x: FloatArray, w: FloatArray) -> FloatArray:
    """Zebra stripes of half a metre, filtered more smoothly than by one box."""
    return (pulses(x - w / 2, 0.5, w) + 2 * pulses(x, 0.5, w) + pulses(x + w / 2, 0.5, w)) / 4


def asphalt(s: Patch) -> FloatArray:
    x, z, w, long_w = s.world_N3[:, 0], s.world_N3[:, 2], s.footprint_N, s.stretched_N
    marks, paint = s.markings, np.zeros(len(x), np.float32)
    for at, width, period, duty in marks.lines:
        paint += band(x, at - width / 2, at + width / 2, w) * pulses(
            z / period, duty, long_w / period
        )
    for low, high in marks.free:
        paint *= 1 - band(z, low, high, long_w)
    on_road = band(x, *marks.x_range, w)
    for low, high in marks.zebras:
        paint = np.maximum(paint, band(z, low, high, long_w) * _stripes(x, w) * on_road)
    rails = sum((band(x, at - 0.06, at + 0.06, w) for at in marks.rails), np.zeros_like(x))
    worn = np.clip(0.85 + 0.6 * s.noise_N, 0.4, 1) * np.clip(paint, 0, 1)
    tyres = 0.5 + 0.5 * np.cos((x - 0.75) * np.float32(2 * np.pi / 1.5))
    color = s.color_N3 * (1 - 0.1 * tyres * np.clip(1 - np.abs(x) / 8, 0, 1))[:, None]
    color = mix(color, np.broadcast_to(rgb(0.12, 0.11, 0.11), color.shape), np.clip(rails, 0, 1))
    return mix(color, np.broadcast_to(WHITE, color.shape), worn)


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
    up, height = s.up_N, 2 * s.half_N3[:, 1]
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
    tone = (
        0.25
        * (cell_random(np.floor(column), np.floor(row)) - 0.5)
        * np.clip(1.5 - 6 * wide_w, 0, 1)
    )
    color = mix(s.color2_N3, s.color_N3 * (1 + tone)[:, None], solid)
    height = 2 * s.half_N3[:, 1]
    coping = np.maximum(band(s.up_N, height - 0.16, height + 1, s.footprint_N), s.top_N)
    return mix(color, s.color_N3 * 0.6 + 0.3, coping)


def roof(s: Patch) -> FloatArray:
    rows = pulses(s.up_N / 0.4, 0.75, s.footprint_N / 0.4)
    return s.color_N3 * (0.8 + 0.25 * rows)[:, None]
