"""Cars, trucks, buses, trams, motorcycles and bicycles, each a list of parts; front = +z.

A vehicle's length, width and height come first, so that the street knows what room it needs.
"""

from dataclasses import dataclass

import numpy as np

from mtl_bench.data.synthetic.material import Material
from mtl_bench.data.synthetic.people import clothes, rider
from mtl_bench.data.synthetic.primitives import Paint, Part, ball, box, rod

CAR, TRUCK, BUS, TRAIN, MOTORCYCLE, BICYCLE = 26, 27, 28, 31, 32, 33
_CAR_COLORS = (
    (0.8, 0.8, 0.82), (0.55, 0.57, 0.6), (0.1, 0.1, 0.12), (0.22, 0.24, 0.27), (0.1, 0.18, 0.42),
    (0.6, 0.08, 0.08), (0.85, 0.85, 0.85), (0.3, 0.32, 0.2), (0.12, 0.3, 0.22), (0.7, 0.45, 0.12),
)  # fmt: skip
_DARK = (0.07, 0.07, 0.08)


@dataclass(frozen=True)
class Vehicle:
    parts: list[Part]
    width: float
    length: float


def _near(
    rng: np.random.Generator, color: tuple, spread: float = 0.04
) -> tuple[float, float, float]:
    r, g, b = np.clip(np.array(color) + rng.normal(0, spread, 3), 0.03, 0.95).tolist()
    return r, g, b


def _wheels(width: float, axles: list[float], radius: float, label: int) -> list[Part]:
    paint = Paint(Material.WHEEL, (0.5, 0.5, 0.52), params=(0.4, 0, 0, 0))
    parts = []
    for z in axles:
        for side in (-1, 1):
            a, b = side * (width / 2 + 0.01), side * (width / 2 - 0.22)
            parts.append(rod((a, radius, z), (b, radius, z), radius, paint, label))
    return parts


def car(rng: np.random.Generator) -> Vehicle:
    """Saloon, estate, hatchback or van."""
    style = rng.choice(4, p=[0.35, 0.25, 0.25, 0.15])
    length = (4.5, 4.6, 3.9, 4.9)[style] + rng.normal(0, 0.12)
    width, height = rng.uniform(1.7, 1.86), (1.45, 1.5, 1.5, 1.95)[style] + rng.normal(0, 0.04)
    color = _near(rng, _CAR_COLORS[rng.integers(len(_CAR_COLORS))])
    belt = 0.56 * height if style < 3 else 0.5 * height
    cab_length = (0.58, 0.72, 0.68, 0.8)[style] * length
    back = (-0.06, -0.13, -0.14, -0.09)[style] * length
    rear = (0.4, 0.12, 0.22, 0.04)[style]
    body = Paint(Material.BODY, color, params=(1, 0, 0, 0))
    cabin = Paint(Material.CABIN, color, params=(0.14, 0.84, 0.06, 0))
    parts = [
        box((0, 0.2, 0), (width, belt - 0.2, length), body, CAR, (0.05, 0.03, 0.02)),
        box(
            (0, belt, back), (width * 0.97, height - belt, cab_length), cabin, CAR, (0.2, 0.5, rear)
        ),
        *_wheels(width, [-0.3 * length, 0.31 * length], 0.32, CAR),
    ]
    return Vehicle(parts, width, length)


def truck(rng: np.random.Generator) -> Vehicle:
    """A cab before a box, a tarpaulin or an open bed."""
    width, length, height = rng.uniform(2.2, 2.5), rng.uniform(5.8, 8.5), rng.uniform(2.7, 3.5)
    color = _near(
        rng,
        ((0.85, 0.85, 0.85), (0.75, 0.12, 0.1), (0.15, 0.3, 0.6), (0.9, 0.6, 0.1))[rng.integers(4)],
    )
    load = _near(
        rng,
        ((0.82, 0.82, 0.8), (0.25, 0.4, 0.6), (0.75, 0.7, 0.3), (0.35, 0.5, 0.35))[rng.integers(4)],
    )
    ribs = tuple(0.82 * c for c in load)
    cargo = Paint(
        Material.SLATS, load, ribs, (rng.uniform(0.5, 0.9), 0.9, float(rng.integers(2)), 0)
    )
    cab = Paint(Material.CABIN, color, params=(0.5, 0.86, 0.07, 0))
    load_length = length - 2.1
    bed = height if rng.random() < 0.8 else 1.7
    parts = [
        box(
            (0, 0.55, 0),
            (width * 0.9, 0.4, length),
            Paint(Material.PLAIN, (0.12, 0.12, 0.13)),
            TRUCK,
        ),
        box((0, 0.9, -1.05), (width, bed - 0.9, load_length), cargo, TRUCK),
        box((0, 0.45, length / 2 - 0.95), (width * 0.96, 2.2, 1.9), cab, TRUCK, (0.08, 0.12, 0.01)),
        *_wheels(width, [-0.32 * length, -0.18 * length, 0.36 * length], 0.48, TRUCK),
    ]
    for side in (-1, 1):
        lamp = Paint(Material.PLAIN, (0.8, 0.06, 0.05))
        parts.append(box((side * width * 0.36, 0.62, -length / 2), (0.4, 0.2, 0.06), lamp, TRUCK))
    return Vehicle(parts, width, length)


def bus(rng: np.random.Generator) -> Vehicle:
    width, length, height = 2.5, rng.uniform(9.5, 12.5), rng.uniform(2.9, 3.2)
    color = _near(
        rng,
        ((0.9, 0.75, 0.15), (0.75, 0.1, 0.1), (0.85, 0.85, 0.8), (0.2, 0.5, 0.35))[rng.integers(4)],
    )
    stripe = _near(rng, ((0.8, 0.8, 0.8), (0.2, 0.25, 0.4), (0.6, 0.1, 0.1))[rng.integers(3)])
    paint = Paint(Material.COACH, color, stripe, (0.42, 0.8, rng.uniform(1.3, 1.7), 0.14))
    parts = [
        box((0, 0.3, 0), (width, height - 0.3, length), paint, BUS, (0.03, 0.02, 0.02)),
        box((0, height, -1), (1.6, 0.22, length * 0.4), Paint(Material.PLAIN, color), BUS),
        *_wheels(width, [-0.25 * length, 0.3 * length], 0.48, BUS),
    ]
    return Vehicle(parts, width, length)


def tram(rng: np.random.Generator) -> Vehicle:
    """Two or three cars with bellows between them and a pantograph; long, narrow and tall."""
    width, height, cars = 2.4, rng.uniform(3.4, 3.7), rng.integers(2, 4)
    one = rng.uniform(7.0, 8.5)
    color = _near(rng, ((0.85, 0.85, 0.8), (0.85, 0.75, 0.4), (0.7, 0.75, 0.8))[rng.integers(3)])
    stripe = _near(rng, ((0.75, 0.08, 0.1), (0.1, 0.25, 0.6), (0.1, 0.45, 0.3))[rng.integers(3)])
    paint = Paint(Material.COACH, color, stripe, (0.45, 0.76, rng.uniform(1.6, 2.2), 0.26))
    dark = Paint(Material.PLAIN, _DARK)
    length = cars * one
    parts = []
    for i in range(cars):
        z = (i - (cars - 1) / 2) * one
        nose = (0.03, 0.08 * (i == cars - 1), 0.08 * (i == 0))
        parts.append(box((0, 0.35, z), (width, height - 0.35, one - 0.35), paint, TRAIN, nose))
        parts.append(box((0, 0.08, z), (width * 0.8, 0.3, one * 0.6), dark, TRAIN))
        parts.append(
            box(
                (0, height, z),
                (1.4, 0.25, one * 0.5),
                Paint(Material.PLAIN, (0.4, 0.4, 0.42)),
                TRAIN,
            )
        )
    for i in range(cars - 1):
        z = (i + 1 - cars / 2) * one
        parts.append(box((0, 0.5, z), (width * 0.9, height - 0.7, 0.4), dark, TRAIN))
    parts.append(rod((0, height, 0), (0, height + 1.0, 0.6), 0.05, dark, TRAIN))
    return Vehicle(parts, width, length)


def motorcycle(rng: np.random.Generator, ridden: bool) -> Vehicle:
    """A motorcycle or scooter, with or without its rider."""
    color = _near(
        rng,
        ((0.7, 0.08, 0.06), (0.1, 0.1, 0.12), (0.1, 0.25, 0.6), (0.85, 0.55, 0.1))[rng.integers(4)],
    )
    paint, dark = Paint(Material.PLAIN, color), Paint(Material.PLAIN, _DARK)
    chrome = Paint(Material.PLAIN, (0.6, 0.6, 0.62))
    wheel = Paint(Material.WHEEL, (0.35, 0.35, 0.37), params=(0.35, 0, 0, 0))
    m = MOTORCYCLE
    parts = [
        rod((-0.08, 0.32, -0.7), (0.08, 0.32, -0.7), 0.32, wheel, m),
        rod((-0.07, 0.32, 0.75), (0.07, 0.32, 0.75), 0.32, wheel, m),
        ball((0, 0.52, 0.0), (0.42, 0.55, 0.85), chrome, m),
        ball((0, 0.85, 0.2), (0.36, 0.38, 0.75), paint, m),
        box((0, 0.75, -0.45), (0.3, 0.13, 0.75), dark, m),
        ball((0, 0.7, -0.75), (0.3, 0.3, 0.5), paint, m),
        box((0, 0.84, 0.6), (0.44, 0.36, 0.22), paint, m, (0.3, 0.3, 0.3)),
        rod((-0.36, 1.08, 0.45), (0.36, 1.08, 0.45), 0.035, dark, m),
        rod((0, 0.32, 0.75), (0, 1.05, 0.45), 0.06, chrome, m),
        box((0, 0.74, -1.0), (0.2, 0.1, 0.05), Paint(Material.PLAIN, (0.85, 0.06, 0.05)), m),
    ]
    if ridden:
        parts += rider(rng, clothes(rng, leather=True), seat=(0.82, -0.3), hands=(1.08, 0.42),
                       feet=(0.35, 0.05), foot_x=0.24, helmet=True)  # fmt: skip
    return Vehicle(parts, 0.8, 2.1)


def bicycle(rng: np.random.Generator, ridden: bool) -> Vehicle:
    """A bicycle, with or without its rider; wheels count as filled, as annotators draw them."""
    color = _near(
        rng,
        ((0.1, 0.35, 0.6), (0.65, 0.1, 0.1), (0.12, 0.12, 0.13), (0.2, 0.5, 0.25), (0.8, 0.8, 0.8))[
            rng.integers(5)
        ],
    )
    paint, dark = Paint(Material.PLAIN, color), Paint(Material.PLAIN, _DARK)
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
        rod((-0.29, 1.04, 0.34), (0.29, 1.04, 0.34), 0.03, dark, b),
        box((0, 0.9, -0.2), (0.17, 0.09, 0.28), dark, b),
    ]
    if rng.random() < 0.35:
        basket = Paint(Material.SLATS, (0.4, 0.3, 0.18), (0.15, 0.1, 0.06), (0.06, 0.6, 1, 0))
        parts.append(box((0, 0.85, 0.62), (0.36, 0.26, 0.3), basket, b))
    if ridden:
        parts += rider(rng, clothes(rng), seat=(0.97, -0.2), hands=(1.06, 0.32), feet=(0.25, 0.02),
                       foot_x=0.12, helmet=rng.random() < 0.5)  # fmt: skip
    return Vehicle(parts, 0.6, 1.8)
