"""What stands along a street: houses, trees, hedges, walls, fences, poles, lights and signs."""

import numpy as np

from mtl_bench.data.synthetic.material import Material
from mtl_bench.data.synthetic.primitives import Paint, Part, Point, ball, box, rod

ROAD, SIDEWALK, BUILDING, WALL, FENCE = 7, 8, 11, 12, 13
POLE, LIGHT, SIGN, VEGETATION, TERRAIN = 17, 19, 20, 21, 22
_PLASTER = (
    (0.72, 0.64, 0.5), (0.66, 0.48, 0.38), (0.78, 0.76, 0.7), (0.55, 0.3, 0.24), (0.6, 0.6, 0.6),
    (0.82, 0.72, 0.48), (0.62, 0.56, 0.54), (0.5, 0.42, 0.36), (0.7, 0.55, 0.5),
)  # fmt: skip
_CROWNS = ((0.3, 0.48, 0.14), (0.22, 0.42, 0.15), (0.42, 0.5, 0.16), (0.5, 0.42, 0.12))
_METAL = ((0.42, 0.44, 0.45), (0.3, 0.32, 0.32), (0.55, 0.56, 0.56), (0.2, 0.25, 0.22))


def _vary(rng: np.random.Generator, color: Point, spread: float = 0.05) -> Point:
    r, g, b = np.clip(
        np.array(color) * rng.normal(1, spread) + rng.normal(0, spread / 2, 3), 0.03, 0.95
    )
    return float(r), float(g), float(b)


def building(rng: np.random.Generator, size: Point, pitched: bool) -> list[Part]:
    """A house of width (x), height and length (z), by its middle; flat or with a tiled roof."""
    w, h, length = size
    color = _vary(rng, _PLASTER[rng.integers(len(_PLASTER))], 0.08)
    ground = _vary(rng, _PLASTER[rng.integers(len(_PLASTER))]) if rng.random() < 0.5 else color
    params = (
        rng.uniform(2.9, 3.5),
        rng.uniform(2.0, 3.4),
        rng.uniform(0.38, 0.58),
        rng.uniform(0.42, 0.58),
    )
    parts = [box((0, 0, 0), size, Paint(Material.FACADE, color, ground, params), BUILDING)]
    if pitched:
        tiles = Paint(
            Material.ROOF, _vary(rng, ((0.5, 0.22, 0.16), (0.3, 0.27, 0.27))[rng.integers(2)])
        )
        parts.append(
            box((0, h, 0), (w + 0.5, min(w, 9) * 0.42, length + 0.3), tiles, BUILDING, (0.96, 0, 0))
        )
    return parts


def tree(rng: np.random.Generator, height: float) -> list[Part]:
    """A trunk that forks under a crown of overlapping clumps."""
    kind = rng.choice(4, p=[0.4, 0.35, 0.15, 0.1])
    green = _vary(rng, _CROWNS[kind], 0.08)
    leaves = Paint(Material.FOLIAGE, green, tuple(0.45 * c for c in green))
    bark = Paint(Material.PLAIN, _vary(rng, (0.27, 0.2, 0.15)))
    fork, crown = height * rng.uniform(0.3, 0.4), height * rng.uniform(0.5, 0.68)
    v = VEGETATION
    parts = [
        rod((0, 0, 0), (0, fork + 0.3, 0), height * 0.027, bark, v),
        ball(
            (0, fork + 0.52 * (height - fork), 0),
            (crown * 0.8, (height - fork) * 0.85, crown * 0.8),
            leaves,
            v,
        ),
    ]
    count = int(rng.integers(7, 10))
    for i in range(count):
        angle = 2 * np.pi * (i + rng.uniform(-0.3, 0.3)) / count * 2
        level = (i + 0.5) / count
        reach = crown * (0.34 - 0.18 * level) * rng.uniform(0.8, 1.2)
        size = crown * rng.uniform(0.36, 0.52)
        at = (
            reach * np.cos(angle),
            fork + (0.18 + 0.74 * level) * (height - fork),
            reach * np.sin(angle),
        )
        parts.append(ball(at, (size, size * 0.82, size), leaves, v))
        if i < 3:
            parts.append(rod((0, fork * 0.95, 0), at, height * 0.012, bark, v))
    return parts


def bush(rng: np.random.Generator, size: float) -> list[Part]:
    green = _vary(rng, (0.26, 0.42, 0.13), 0.1)
    leaves = Paint(Material.FOLIAGE, green, tuple(0.45 * c for c in green))
    parts = []
    for _ in range(4):
        x, z = rng.uniform(-0.35, 0.35, 2) * size
        w, h = rng.uniform(0.6, 0.95, 2) * size
        parts.append(ball((x, 0.35 * h, z), (w, h, w), leaves, VEGETATION))
    return parts


def hedge(rng: np.random.Generator, length: float) -> list[Part]:
    """A clipped hedge along z."""
    green = _vary(rng, (0.2, 0.36, 0.11), 0.1)
    leaves = Paint(Material.FOLIAGE, green, tuple(0.45 * c for c in green))
    return [
        box((0, 0, 0), (0.9, rng.uniform(1.0, 2.2), length), leaves, VEGETATION, (0.12, 0.02, 0.02))
    ]


def wall(rng: np.random.Generator, length: float) -> list[Part]:
    """A garden or retaining wall along z: masonry or bare concrete under a coping."""
    color = _vary(rng, ((0.58, 0.57, 0.54), (0.56, 0.36, 0.28), (0.66, 0.6, 0.5))[rng.integers(3)])
    paint = Paint(
        Material.MASONRY, color, tuple(0.72 * c for c in color), (rng.uniform(0.2, 0.5), 0, 0, 0)
    )
    return [box((0, 0, 0), (0.35, rng.uniform(1.2, 2.4), length), paint, WALL)]


def fence(rng: np.random.Generator, length: float) -> list[Part]:
    """Pales, planks or bars along z, with the dark of what lies behind in the gaps."""
    color = ((0.72, 0.7, 0.66), (0.46, 0.32, 0.2), (0.2, 0.28, 0.22), (0.5, 0.53, 0.55))[
        rng.integers(4)
    ]
    color = _vary(rng, color)
    gap = tuple(0.28 * c + 0.03 for c in color)
    params = (rng.uniform(0.16, 0.42), rng.uniform(0.4, 0.62), float(rng.random() < 0.25), 0.0)
    paint = Paint(Material.SLATS, color, gap, params)
    return [box((0, 0, 0), (0.08, rng.uniform(1.0, 1.9), length), paint, FENCE)]


def column(rng: np.random.Generator) -> list[Part]:
    """A thick post: advertising mast, old lamp post or bollard-like column."""
    radius, height = rng.uniform(0.12, 0.2), rng.uniform(2.8, 7.0)
    paint = Paint(Material.PLAIN, _vary(rng, _METAL[rng.integers(len(_METAL))]))
    return [
        rod((0, 0, 0), (0, height, 0), radius, paint, POLE),
        rod((0, 0, 0), (0, 0.5, 0), radius * 1.5, paint, POLE),
        ball((0, height, 0), (radius * 3, radius * 3.4, radius * 3), paint, POLE),
    ]


def lamp_post(rng: np.random.Generator, reach: float) -> list[Part]:
    """A street lamp with its arm towards `reach` (signed, metres)."""
    height = rng.uniform(5.5, 8.0)
    paint = Paint(Material.PLAIN, _vary(rng, _METAL[rng.integers(len(_METAL))]))
    return [
        rod((0, 0, 0), (0, height, 0), 0.09, paint, POLE),
        rod((0, 0, 0), (0, 1.1, 0), 0.14, paint, POLE),
        rod((0, height, 0), (reach, height + 0.25, 0), 0.06, paint, POLE),
        box((reach, height + 0.16, 0), (0.65, 0.14, 0.3), paint, POLE),
    ]


def traffic_light(rng: np.random.Generator, reach: float) -> list[Part]:
    """Signal heads facing -z on a pole; with |reach| > 0 another one over the road."""
    metal = Paint(Material.PLAIN, _vary(rng, _METAL[rng.integers(3)]))
    head = Paint(
        Material.LAMPS, (0.07, 0.08, 0.07), params=(float(rng.choice([0, 2, 2, 1])), 0, 0, 0)
    )
    height, k = rng.uniform(2.1, 2.6), rng.uniform(1.1, 1.5)
    size = (0.36 * k, 1.0 * k, 0.3 * k)
    parts = [
        rod((0, 0, 0), (0, height + 0.9, 0), 0.1, metal, POLE),
        box((0, height, -0.22), size, head, LIGHT),
    ]
    if abs(reach) > 0:
        parts += [
            rod((0, height, 0), (0, 5.2, 0), 0.1, metal, POLE),
            rod((0, 5.0, 0), (reach, 5.2, 0), 0.08, metal, POLE),
            box((reach, 4.5, -0.22), size, head, LIGHT),
        ]
    return parts


def traffic_sign(rng: np.random.Generator) -> list[Part]:
    """A plate facing -z on its pole: a disc, a diamond-coloured square or a larger board."""
    design = int(rng.choice(5, p=[0.28, 0.22, 0.2, 0.15, 0.15]))
    metal = Paint(Material.PLAIN, _vary(rng, (0.55, 0.56, 0.57)))
    face = Paint(Material.SIGN, params=(float(design), 0, 0, 0))
    size, height = rng.uniform(0.75, 1.05), rng.uniform(1.9, 2.5)
    parts = [rod((0, 0, 0.08), (0, height + size * 0.8, 0.08), 0.055, metal, POLE)]
    middle = height + size / 2
    if design == 4:
        wide = size * rng.uniform(1.4, 2.2)
        return [*parts, box((0, height, 0), (wide, size * 1.1, 0.06), face, SIGN)]
    if design == 2:
        return [*parts, box((0, height, 0), (size, size, 0.06), face, SIGN)]
    parts.append(rod((0, middle, -0.03), (0, middle, 0.03), size / 2, face, SIGN))
    if rng.random() < 0.35:
        plate = Paint(Material.SIGN, params=(2.0, 0, 0, 0))
        parts.append(box((0, height - 0.5, 0), (size * 0.8, 0.42, 0.05), plate, SIGN))
    return parts
