"""Persons and riders: lists of parts, facing +z."""

from typing import NamedTuple

import numpy as np

from mtl_bench.data.synthetic.material import Material
from mtl_bench.data.synthetic.primitives import Paint, Part, ball, box, rod

PERSON, RIDER = 24, 25
_SKIN = ((0.85, 0.66, 0.54), (0.72, 0.5, 0.38), (0.45, 0.3, 0.22), (0.9, 0.74, 0.64))
_HAIR = ((0.1, 0.07, 0.05), (0.3, 0.2, 0.1), (0.55, 0.42, 0.22), (0.4, 0.4, 0.4))
_TOPS = (
    (0.75, 0.12, 0.12), (0.12, 0.2, 0.5), (0.85, 0.82, 0.78), (0.85, 0.6, 0.12), (0.15, 0.4, 0.3),
    (0.5, 0.2, 0.45), (0.2, 0.2, 0.22), (0.9, 0.4, 0.5), (0.35, 0.6, 0.8),
)  # fmt: skip
_LEGS = ((0.12, 0.16, 0.3), (0.1, 0.1, 0.11), (0.4, 0.35, 0.28), (0.2, 0.3, 0.45))


class Clothes(NamedTuple):
    top: Paint
    legs: Paint
    skin: Paint
    head: Paint
    shoes: Paint


def clothes(rng: np.random.Generator, leather: bool = False) -> Clothes:
    skin = _SKIN[rng.integers(len(_SKIN))]
    top = _LEGS[1] if leather and rng.random() < 0.5 else _TOPS[rng.integers(len(_TOPS))]
    return Clothes(
        Paint(Material.PERSON, top),
        Paint(Material.PERSON, _LEGS[rng.integers(len(_LEGS))]),
        Paint(Material.PERSON, skin),
        Paint(Material.HEAD, skin, _HAIR[rng.integers(len(_HAIR))]),
        Paint(Material.PLAIN, (0.1, 0.08, 0.07)),
    )


def person(rng: np.random.Generator) -> list[Part]:
    """Somebody walking or standing, 1.5-1.95 m, now and then a child, a skirt or a bag."""
    k = rng.uniform(0.62, 0.8) if rng.random() < 0.12 else rng.normal(1.0, 0.05)
    wear, stride, n = clothes(rng), rng.uniform(-0.3, 0.3), PERSON
    if rng.random() < 0.4:
        stride *= 0.2
    hip, shoulder = 0.88 * k, 1.42 * k
    parts = [
        ball((0, 1.62 * k, 0.02), (0.2 * k, 0.27 * k, 0.23 * k), wear.head, n),
        rod((0, 1.4 * k, 0), (0, 1.56 * k, 0.01), 0.06 * k, wear.skin, n),
        box(
            (0, hip - 0.06, 0),
            (0.46 * k, shoulder - hip + 0.1, 0.26 * k),
            wear.top,
            n,
            (0.12, 0.1, 0.1),
        ),
    ]
    for side in (-1, 1):
        x, z = side * 0.1 * k, side * stride
        parts.append(rod((x, hip, 0), (x, 0.06, z), 0.085 * k, wear.legs, n))
        parts.append(ball((x, 0.05, z + 0.06), (0.1, 0.1, 0.26), wear.shoes, n))
        a = side * 0.26 * k
        parts.append(
            rod((a, shoulder - 0.04, 0), (a * 1.1, hip - 0.02, -z * 0.7), 0.055 * k, wear.top, n)
        )
        parts.append(ball((a * 1.1, hip - 0.05, -z * 0.75), (0.09, 0.11, 0.09), wear.skin, n))
    if rng.random() < 0.2:
        parts.append(
            box((0, 0.5 * k, 0), (0.5 * k, 0.45 * k, 0.4 * k), wear.top, n, (0.3, 0.3, 0.3))
        )
    if rng.random() < 0.3:
        bag = Paint(Material.PLAIN, _TOPS[rng.integers(len(_TOPS))])
        parts.append(box((0, 1.0 * k, -0.2 * k), (0.3 * k, 0.42 * k, 0.18 * k), bag, n))
    return parts


def rider(
    rng: np.random.Generator,
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
    head = wear.head
    if helmet:
        color = _TOPS[rng.integers(len(_TOPS))]
        head = Paint(Material.HEAD, wear.head.color, color)
    parts = [
        rod((0, seat[0] + 0.02, seat[1]), (0, neck[0], neck[1]), 0.19, wear.top, n),
        ball((0, neck[0] + 0.02, neck[1]), (0.46, 0.24, 0.28), wear.top, n),
        ball((0, neck[0] + 0.24, neck[1] + 0.04), (0.25, 0.3, 0.28), head, n),
    ]
    for side in (-1, 1):
        lift = side * 0.08
        knee = (side * (foot_x + 0.04), (seat[0] + feet[0]) / 2 + 0.08 + lift, feet[1] + 0.32)
        foot = (side * foot_x, feet[0] + lift, feet[1])
        parts.append(rod((side * 0.1, seat[0], seat[1]), knee, 0.09, wear.legs, n))
        parts.append(rod(knee, foot, 0.07, wear.legs, n))
        parts.append(
            ball((foot[0], foot[1] - 0.03, foot[2] + 0.06), (0.1, 0.1, 0.26), wear.shoes, n)
        )
        parts.append(rod((side * 0.21, neck[0], neck[1]), (side * 0.27, *hands), 0.06, wear.top, n))
    return parts
