"""What stands, grows, walks and drives in a street, each a list of parts; front = +z.

Furniture comes first (houses, plants, walls, posts, lights, signs), then people, then vehicles.
"""

from typing import NamedTuple

import numpy as np

from mtl_bench.data.scenes.rays import Paint, Part, Point, ball, box, rod
from mtl_bench.data.scenes.surfaces import Material

ROAD, SIDEWALK, BUILDING, WALL, FENCE = 7, 8, 11, 12, 13
POLE, LIGHT, SIGN, VEGETATION, TERRAIN = 17, 19, 20, 21, 22
PERSON, RIDER, CAR, TRUCK, BUS, TRAIN, MOTORCYCLE, BICYCLE = 24, 25, 26, 27, 28, 31, 32, 33
THINGS = frozenset((PERSON, RIDER, CAR, TRUCK, BUS, TRAIN, MOTORCYCLE, BICYCLE))

Random = np.random.Generator
Colors = tuple[Point, ...]


def _pick(rng: Random, colors: Colors) -> Point:
    return colors[rng.integers(len(colors))]


def _near(rng: Random, color: Point) -> Point:
    """A colour beside the given one: every channel moves by itself."""
    r, g, b = np.clip(np.array(color) + rng.normal(0, 0.04, 3), 0.03, 0.95).tolist()
    return r, g, b


def _vary(rng: Random, color: Point, spread: float = 0.05) -> Point:
    """A lighter or darker colour, whose channels move a little by themselves."""
    varied = np.array(color) * rng.normal(1, spread) + rng.normal(0, spread / 2, 3)
    r, g, b = np.clip(varied, 0.03, 0.95).tolist()
    return r, g, b


def _darker(color: Point, share: float) -> Point:
    r, g, b = color
    return share * r, share * g, share * b


def _plain(r: float, g: float, b: float) -> Paint:
    return Paint(Material.PLAIN, (r, g, b))


# --- furniture ------------------------------------------------------------------------------------

_PLASTER: Colors = (
    (0.72, 0.64, 0.5), (0.66, 0.48, 0.38), (0.78, 0.76, 0.7), (0.55, 0.3, 0.24), (0.6, 0.6, 0.6),
    (0.82, 0.72, 0.48), (0.62, 0.56, 0.54), (0.5, 0.42, 0.36), (0.7, 0.55, 0.5),
)  # fmt: skip
_TILES: Colors = ((0.5, 0.22, 0.16), (0.3, 0.27, 0.27))
_CROWNS: Colors = ((0.3, 0.48, 0.14), (0.22, 0.42, 0.15), (0.42, 0.5, 0.16), (0.5, 0.42, 0.12))
_STONES: Colors = ((0.58, 0.57, 0.54), (0.56, 0.36, 0.28), (0.66, 0.6, 0.5))
_PALES: Colors = ((0.72, 0.7, 0.66), (0.46, 0.32, 0.2), (0.2, 0.28, 0.22), (0.5, 0.53, 0.55))
_METAL: Colors = ((0.42, 0.44, 0.45), (0.3, 0.32, 0.32), (0.55, 0.56, 0.56), (0.2, 0.25, 0.22))


def _metal(rng: Random, colors: Colors = _METAL) -> Paint:
    return _plain(*_vary(rng, _pick(rng, colors)))


def _leaves(rng: Random, color: Point, spread: float = 0.1) -> Paint:
    green = _vary(rng, color, spread)
    return Paint(Material.FOLIAGE, green, _darker(green, 0.45))


def building(rng: Random, size: Point, pitched: bool) -> list[Part]:
    """A house of width (x), height and length (z), by its middle; flat or with a tiled roof."""
    w, h, length = size
    color = _vary(rng, _pick(rng, _PLASTER), 0.08)
    ground = _vary(rng, _pick(rng, _PLASTER)) if rng.random() < 0.5 else color
    params = tuple(rng.uniform((2.9, 2.0, 0.38, 0.42), (3.5, 3.4, 0.58, 0.58)).tolist())
    parts = [box((0, 0, 0), size, Paint(Material.FACADE, color, ground, params), BUILDING)]
    if pitched:
        tiles = Paint(Material.ROOF, _vary(rng, _pick(rng, _TILES)))
        gable = (w + 0.5, min(w, 9) * 0.42, length + 0.3)
        parts.append(box((0, h, 0), gable, tiles, BUILDING, (0.96, 0, 0)))
    return parts


def tree(rng: Random, height: float) -> list[Part]:
    """A trunk that forks under a crown of overlapping clumps."""
    leaves = _leaves(rng, _CROWNS[rng.choice(4, p=[0.4, 0.35, 0.15, 0.1])], 0.08)
    bark = _plain(*_vary(rng, (0.27, 0.2, 0.15)))
    fork, crown = height * rng.uniform(0.3, 0.4), height * rng.uniform(0.5, 0.68)
    top, v = height - fork, VEGETATION
    heart = (crown * 0.8, top * 0.85, crown * 0.8)
    parts = [
        rod((0, 0, 0), (0, fork + 0.3, 0), height * 0.027, bark, v),
        ball((0, fork + 0.52 * top, 0), heart, leaves, v),
    ]
    count = int(rng.integers(7, 10))
    for i in range(count):
        angle = 2 * np.pi * (i + rng.uniform(-0.3, 0.3)) / count * 2
        level = (i + 0.5) / count
        reach = crown * (0.34 - 0.18 * level) * rng.uniform(0.8, 1.2)
        size = crown * rng.uniform(0.36, 0.52)
        at = (reach * np.cos(angle), fork + (0.18 + 0.74 * level) * top, reach * np.sin(angle))
        parts.append(ball(at, (size, size * 0.82, size), leaves, v))
        if i < 3:
            parts.append(rod((0, fork * 0.95, 0), at, height * 0.012, bark, v))
    return parts


def bush(rng: Random, size: float) -> list[Part]:
    leaves, parts = _leaves(rng, (0.26, 0.42, 0.13)), []
    for _ in range(4):
        x, z = rng.uniform(-0.35, 0.35, 2) * size
        w, h = rng.uniform(0.6, 0.95, 2) * size
        parts.append(ball((x, 0.35 * h, z), (w, h, w), leaves, VEGETATION))
    return parts


def hedge(rng: Random, length: float) -> list[Part]:
    """A clipped hedge along z."""
    leaves = _leaves(rng, (0.2, 0.36, 0.11))
    size = (0.9, rng.uniform(1.0, 2.2), length)
    return [box((0, 0, 0), size, leaves, VEGETATION, (0.12, 0.02, 0.02))]


def wall(rng: Random, length: float) -> list[Part]:
    """A garden or retaining wall along z: masonry or bare concrete under a coping."""
    color = _vary(rng, _pick(rng, _STONES))
    params = (rng.uniform(0.2, 0.5), 0, 0, 0)
    paint = Paint(Material.MASONRY, color, _darker(color, 0.72), params)
    return [box((0, 0, 0), (0.35, rng.uniform(1.2, 2.4), length), paint, WALL)]


def fence(rng: Random, length: float) -> list[Part]:
    """Pales, planks or bars along z, with the dark of what lies behind in the gaps."""
    color = _vary(rng, _pick(rng, _PALES))
    gap = tuple(0.28 * c + 0.03 for c in color)
    params = (rng.uniform(0.16, 0.42), rng.uniform(0.4, 0.62), float(rng.random() < 0.25), 0.0)
    paint = Paint(Material.SLATS, color, gap, params)
    return [box((0, 0, 0), (0.08, rng.uniform(1.0, 1.9), length), paint, FENCE)]


def column(rng: Random) -> list[Part]:
    """A thick post: advertising mast, old lamp post or bollard-like column."""
    radius, height = rng.uniform(0.12, 0.2), rng.uniform(2.8, 7.0)
    paint = _metal(rng)
    return [
        rod((0, 0, 0), (0, height, 0), radius, paint, POLE),
        rod((0, 0, 0), (0, 0.5, 0), radius * 1.5, paint, POLE),
        ball((0, height, 0), (radius * 3, radius * 3.4, radius * 3), paint, POLE),
    ]


def lamp_post(rng: Random, reach: float) -> list[Part]:
    """A street lamp with its arm towards `reach` (signed, metres)."""
    height = rng.uniform(5.5, 8.0)
    paint = _metal(rng)
    return [
        rod((0, 0, 0), (0, height, 0), 0.09, paint, POLE),
        rod((0, 0, 0), (0, 1.1, 0), 0.14, paint, POLE),
        rod((0, height, 0), (reach, height + 0.25, 0), 0.06, paint, POLE),
        box((reach, height + 0.16, 0), (0.65, 0.14, 0.3), paint, POLE),
    ]


def traffic_light(rng: Random, reach: float = 0.0) -> list[Part]:
    """Signal heads facing -z on a pole; with |reach| > 0 another one over the road."""
    metal = _metal(rng, _METAL[:3])
    lit = float(rng.choice([0, 2, 2, 1]))
    head = Paint(Material.LAMPS, (0.07, 0.08, 0.07), params=(lit, 0, 0, 0))
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


def traffic_sign(rng: Random) -> list[Part]:
    """A plate facing -z on its pole: a disc, a diamond-coloured square or a larger board."""
    design = int(rng.choice(5, p=[0.28, 0.22, 0.2, 0.15, 0.15]))
    metal = _plain(*_vary(rng, (0.55, 0.56, 0.57)))
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


# --- people ---------------------------------------------------------------------------------------

_SKIN: Colors = ((0.85, 0.66, 0.54), (0.72, 0.5, 0.38), (0.45, 0.3, 0.22), (0.9, 0.74, 0.64))
_HAIR: Colors = ((0.1, 0.07, 0.05), (0.3, 0.2, 0.1), (0.55, 0.42, 0.22), (0.4, 0.4, 0.4))
_TOPS: Colors = (
    (0.75, 0.12, 0.12), (0.12, 0.2, 0.5), (0.85, 0.82, 0.78), (0.85, 0.6, 0.12), (0.15, 0.4, 0.3),
    (0.5, 0.2, 0.45), (0.2, 0.2, 0.22), (0.9, 0.4, 0.5), (0.35, 0.6, 0.8),
)  # fmt: skip
_LEGS: Colors = ((0.12, 0.16, 0.3), (0.1, 0.1, 0.11), (0.4, 0.35, 0.28), (0.2, 0.3, 0.45))
_SHOES = _plain(0.1, 0.08, 0.07)


class Clothes(NamedTuple):
    top: Paint
    legs: Paint
    skin: Paint
    head: Paint


def clothes(rng: Random, leather: bool = False) -> Clothes:
    skin = _pick(rng, _SKIN)
    top = _LEGS[1] if leather and rng.random() < 0.5 else _pick(rng, _TOPS)
    return Clothes(
        Paint(Material.PERSON, top),
        Paint(Material.PERSON, _pick(rng, _LEGS)),
        Paint(Material.PERSON, skin),
        Paint(Material.HEAD, skin, _pick(rng, _HAIR)),
    )


def person(rng: Random) -> list[Part]:
    """Somebody walking or standing, 1.5-1.95 m, now and then a child, a skirt or a bag."""
    k = rng.uniform(0.62, 0.8) if rng.random() < 0.12 else rng.normal(1.0, 0.05)
    wear, stride, n = clothes(rng), rng.uniform(-0.3, 0.3), PERSON
    if rng.random() < 0.4:
        stride *= 0.2
    hip, shoulder = 0.88 * k, 1.42 * k
    trunk = (0.46 * k, shoulder - hip + 0.1, 0.26 * k)
    parts = [
        ball((0, 1.62 * k, 0.02), (0.2 * k, 0.27 * k, 0.23 * k), wear.head, n),
        rod((0, 1.4 * k, 0), (0, 1.56 * k, 0.01), 0.06 * k, wear.skin, n),
        box((0, hip - 0.06, 0), trunk, wear.top, n, (0.12, 0.1, 0.1)),
    ]
    for side in (-1, 1):
        x, z, a = side * 0.1 * k, side * stride, side * 0.26 * k
        elbow, wrist = (a, shoulder - 0.04, 0), (a * 1.1, hip - 0.02, -z * 0.7)
        parts += [
            rod((x, hip, 0), (x, 0.06, z), 0.085 * k, wear.legs, n),
            ball((x, 0.05, z + 0.06), (0.1, 0.1, 0.26), _SHOES, n),
            rod(elbow, wrist, 0.055 * k, wear.top, n),
            ball((a * 1.1, hip - 0.05, -z * 0.75), (0.09, 0.11, 0.09), wear.skin, n),
        ]
    if rng.random() < 0.2:
        skirt = (0.5 * k, 0.45 * k, 0.4 * k)
        parts.append(box((0, 0.5 * k, 0), skirt, wear.top, n, (0.3, 0.3, 0.3)))
    if rng.random() < 0.3:
        bag = _plain(*_pick(rng, _TOPS))
        parts.append(box((0, 1.0 * k, -0.2 * k), (0.3 * k, 0.42 * k, 0.18 * k), bag, n))
    return parts


def _rider(
    rng: Random,
    wear: Clothes,
    seat: tuple[float, float],
    hands: tuple[float, float],
    feet: tuple[float, float],
    foot_x: float,
    helmet: bool,
) -> list[Part]:
    """Somebody on two wheels, by the height and z of seat, hands and feet."""
    lean, n = rng.uniform(0.1, 0.3), RIDER
    neck = (seat[0] + 0.55, seat[1] + lean)
    head = wear.head._replace(color2=_pick(rng, _TOPS)) if helmet else wear.head
    parts = [
        rod((0, seat[0] + 0.02, seat[1]), (0, neck[0], neck[1]), 0.19, wear.top, n),
        ball((0, neck[0] + 0.02, neck[1]), (0.46, 0.24, 0.28), wear.top, n),
        ball((0, neck[0] + 0.24, neck[1] + 0.04), (0.25, 0.3, 0.28), head, n),
    ]
    for side in (-1, 1):
        lift = side * 0.08
        knee = (side * (foot_x + 0.04), (seat[0] + feet[0]) / 2 + 0.08 + lift, feet[1] + 0.32)
        x, y, z = foot = (side * foot_x, feet[0] + lift, feet[1])
        parts += [
            rod((side * 0.1, seat[0], seat[1]), knee, 0.09, wear.legs, n),
            rod(knee, foot, 0.07, wear.legs, n),
            ball((x, y - 0.03, z + 0.06), (0.1, 0.1, 0.26), _SHOES, n),
            rod((side * 0.21, neck[0], neck[1]), (side * 0.27, *hands), 0.06, wear.top, n),
        ]
    return parts


# --- vehicles: width, length and height come first, as the street asks what room they need ----

_CARS: Colors = (
    (0.8, 0.8, 0.82), (0.55, 0.57, 0.6), (0.1, 0.1, 0.12), (0.22, 0.24, 0.27), (0.1, 0.18, 0.42),
    (0.6, 0.08, 0.08), (0.85, 0.85, 0.85), (0.3, 0.32, 0.2), (0.12, 0.3, 0.22), (0.7, 0.45, 0.12),
)  # fmt: skip
_CABS: Colors = ((0.85, 0.85, 0.85), (0.75, 0.12, 0.1), (0.15, 0.3, 0.6), (0.9, 0.6, 0.1))
_LOADS: Colors = ((0.82, 0.82, 0.8), (0.25, 0.4, 0.6), (0.75, 0.7, 0.3), (0.35, 0.5, 0.35))
_BUSES: Colors = ((0.9, 0.75, 0.15), (0.75, 0.1, 0.1), (0.85, 0.85, 0.8), (0.2, 0.5, 0.35))
_BUS_STRIPES: Colors = ((0.8, 0.8, 0.8), (0.2, 0.25, 0.4), (0.6, 0.1, 0.1))
_TRAMS: Colors = ((0.85, 0.85, 0.8), (0.85, 0.75, 0.4), (0.7, 0.75, 0.8))
_TRAM_STRIPES: Colors = ((0.75, 0.08, 0.1), (0.1, 0.25, 0.6), (0.1, 0.45, 0.3))
_TANKS: Colors = ((0.7, 0.08, 0.06), (0.1, 0.1, 0.12), (0.1, 0.25, 0.6), (0.85, 0.55, 0.1))
_FRAMES: Colors = (
    (0.1, 0.35, 0.6), (0.65, 0.1, 0.1), (0.12, 0.12, 0.13), (0.2, 0.5, 0.25), (0.8, 0.8, 0.8)
)  # fmt: skip
_DARK = _plain(0.07, 0.07, 0.08)


class Vehicle(NamedTuple):
    parts: list[Part]
    width: float
    length: float


def _wheels(width: float, axles: list[float], radius: float, label: int) -> list[Part]:
    paint = Paint(Material.WHEEL, (0.5, 0.5, 0.52), params=(0.4, 0, 0, 0))
    parts = []
    for z in axles:
        for side in (-1, 1):
            a, b = side * (width / 2 + 0.01), side * (width / 2 - 0.22)
            parts.append(rod((a, radius, z), (b, radius, z), radius, paint, label))
    return parts


def car(rng: Random) -> Vehicle:
    """Saloon, estate, hatchback or van."""
    style = rng.choice(4, p=[0.35, 0.25, 0.25, 0.15])
    length = (4.5, 4.6, 3.9, 4.9)[style] + rng.normal(0, 0.12)
    width, height = rng.uniform(1.7, 1.86), (1.45, 1.5, 1.5, 1.95)[style] + rng.normal(0, 0.04)
    color = _near(rng, _pick(rng, _CARS))
    belt = 0.56 * height if style < 3 else 0.5 * height
    back = (-0.06, -0.13, -0.14, -0.09)[style] * length
    size = (width * 0.97, height - belt, (0.58, 0.72, 0.68, 0.8)[style] * length)
    rear = (0.4, 0.12, 0.22, 0.04)[style]
    body = Paint(Material.BODY, color, params=(1, 0, 0, 0))
    cabin = Paint(Material.CABIN, color, params=(0.14, 0.84, 0.06, 0))
    parts = [
        box((0, 0.2, 0), (width, belt - 0.2, length), body, CAR, (0.05, 0.03, 0.02)),
        box((0, belt, back), size, cabin, CAR, (0.2, 0.5, rear)),
        *_wheels(width, [-0.3 * length, 0.31 * length], 0.32, CAR),
    ]
    return Vehicle(parts, width, length)


def truck(rng: Random) -> Vehicle:
    """A cab before a box, a tarpaulin or an open bed."""
    width, length, height = rng.uniform(2.2, 2.5), rng.uniform(5.8, 8.5), rng.uniform(2.7, 3.5)
    color, load = _near(rng, _pick(rng, _CABS)), _near(rng, _pick(rng, _LOADS))
    params = (rng.uniform(0.5, 0.9), 0.9, float(rng.integers(2)), 0)
    cargo = Paint(Material.SLATS, load, _darker(load, 0.82), params)
    cab = Paint(Material.CABIN, color, params=(0.5, 0.86, 0.07, 0))
    bed = height if rng.random() < 0.8 else 1.7
    lamp, t = _plain(0.8, 0.06, 0.05), TRUCK
    return Vehicle(
        [
            box((0, 0.55, 0), (width * 0.9, 0.4, length), _plain(0.12, 0.12, 0.13), t),
            box((0, 0.9, -1.05), (width, bed - 0.9, length - 2.1), cargo, t),
            box((0, 0.45, length / 2 - 0.95), (width * 0.96, 2.2, 1.9), cab, t, (0.08, 0.12, 0.01)),
            *_wheels(width, [-0.32 * length, -0.18 * length, 0.36 * length], 0.48, t),
            box((-width * 0.36, 0.62, -length / 2), (0.4, 0.2, 0.06), lamp, t),
            box((width * 0.36, 0.62, -length / 2), (0.4, 0.2, 0.06), lamp, t),
        ],
        width,
        length,
    )


def bus(rng: Random) -> Vehicle:
    width, length, height = 2.5, rng.uniform(9.5, 12.5), rng.uniform(2.9, 3.2)
    color, stripe = _near(rng, _pick(rng, _BUSES)), _near(rng, _pick(rng, _BUS_STRIPES))
    paint = Paint(Material.COACH, color, stripe, (0.42, 0.8, rng.uniform(1.3, 1.7), 0.14))
    parts = [
        box((0, 0.3, 0), (width, height - 0.3, length), paint, BUS, (0.03, 0.02, 0.02)),
        box((0, height, -1), (1.6, 0.22, length * 0.4), _plain(*color), BUS),
        *_wheels(width, [-0.25 * length, 0.3 * length], 0.48, BUS),
    ]
    return Vehicle(parts, width, length)


def tram(rng: Random) -> Vehicle:
    """Two or three cars with bellows between them and a pantograph; long, narrow and tall."""
    width, height, cars = 2.4, rng.uniform(3.4, 3.7), rng.integers(2, 4)
    one, t = rng.uniform(7.0, 8.5), TRAIN
    color, stripe = _near(rng, _pick(rng, _TRAMS)), _near(rng, _pick(rng, _TRAM_STRIPES))
    paint = Paint(Material.COACH, color, stripe, (0.45, 0.76, rng.uniform(1.6, 2.2), 0.26))
    parts = []
    for i in range(cars):
        z = (i - (cars - 1) / 2) * one
        nose = (0.03, 0.08 * (i == cars - 1), 0.08 * (i == 0))
        parts += [
            box((0, 0.35, z), (width, height - 0.35, one - 0.35), paint, t, nose),
            box((0, 0.08, z), (width * 0.8, 0.3, one * 0.6), _DARK, t),
            box((0, height, z), (1.4, 0.25, one * 0.5), _plain(0.4, 0.4, 0.42), t),
        ]
    for i in range(cars - 1):
        z = (i + 1 - cars / 2) * one
        parts.append(box((0, 0.5, z), (width * 0.9, height - 0.7, 0.4), _DARK, t))
    parts.append(rod((0, height, 0), (0, height + 1.0, 0.6), 0.05, _DARK, t))
    return Vehicle(parts, width, cars * one)


def motorcycle(rng: Random, ridden: bool) -> Vehicle:
    """A motorcycle or scooter, with or without its rider."""
    paint, chrome = _plain(*_near(rng, _pick(rng, _TANKS))), _plain(0.6, 0.6, 0.62)
    wheel = Paint(Material.WHEEL, (0.35, 0.35, 0.37), params=(0.35, 0, 0, 0))
    m = MOTORCYCLE
    parts = [
        rod((-0.08, 0.32, -0.7), (0.08, 0.32, -0.7), 0.32, wheel, m),
        rod((-0.07, 0.32, 0.75), (0.07, 0.32, 0.75), 0.32, wheel, m),
        ball((0, 0.52, 0.0), (0.42, 0.55, 0.85), chrome, m),
        ball((0, 0.85, 0.2), (0.36, 0.38, 0.75), paint, m),
        box((0, 0.75, -0.45), (0.3, 0.13, 0.75), _DARK, m),
        ball((0, 0.7, -0.75), (0.3, 0.3, 0.5), paint, m),
        box((0, 0.84, 0.6), (0.44, 0.36, 0.22), paint, m, (0.3, 0.3, 0.3)),
        rod((-0.36, 1.08, 0.45), (0.36, 1.08, 0.45), 0.035, _DARK, m),
        rod((0, 0.32, 0.75), (0, 1.05, 0.45), 0.06, chrome, m),
        box((0, 0.74, -1.0), (0.2, 0.1, 0.05), _plain(0.85, 0.06, 0.05), m),
    ]
    if ridden:
        parts += _rider(rng, clothes(rng, leather=True), seat=(0.82, -0.3), hands=(1.08, 0.42),
                        feet=(0.35, 0.05), foot_x=0.24, helmet=True)  # fmt: skip
    return Vehicle(parts, 0.8, 2.1)


def bicycle(rng: Random, ridden: bool) -> Vehicle:
    """A bicycle, with or without its rider; wheels count as filled, as annotators draw them."""
    paint = _plain(*_near(rng, _pick(rng, _FRAMES)))
    wheel = Paint(Material.WHEEL, (0.42, 0.42, 0.41), params=(0.16, 0, 0, 0))
    b, r = BICYCLE, 0.35
    parts = [
        rod((-0.03, r, -0.54), (0.03, r, -0.54), r, wheel, b),
        rod((-0.03, r, 0.54), (0.03, r, 0.54), r, wheel, b),
        rod((0, 0.35, 0), (0, 0.9, -0.18), 0.035, paint, b),
        rod((0, 0.35, 0), (0, 0.8, 0.4), 0.035, paint, b),
        rod((0, 0.8, -0.14), (0, 0.85, 0.4), 0.035, paint, b),
        rod((0, r, -0.54), (0, 0.35, 0), 0.03, paint, b),
        rod((0, r, 0.54), (0, 1.02, 0.38), 0.03, paint, b),
        rod((-0.29, 1.04, 0.34), (0.29, 1.04, 0.34), 0.03, _DARK, b),
        box((0, 0.9, -0.2), (0.17, 0.09, 0.28), _DARK, b),
    ]
    if rng.random() < 0.35:
        basket = Paint(Material.SLATS, (0.4, 0.3, 0.18), (0.15, 0.1, 0.06), (0.06, 0.6, 1, 0))
        parts.append(box((0, 0.85, 0.62), (0.36, 0.26, 0.3), basket, b))
    if ridden:
        parts += _rider(rng, clothes(rng), seat=(0.97, -0.2), hands=(1.06, 0.32), feet=(0.25, 0.02),
                        foot_x=0.12, helmet=rng.random() < 0.5)  # fmt: skip
    return Vehicle(parts, 0.6, 1.8)
