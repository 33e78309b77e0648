"""Vehicles, people and street furniture in a street, with what the classes need to be learnt.

A sparse street would show most classes as specks. Every scene therefore draws several *features*,
rare things close to the camera, before the ordinary traffic fills what room is left.
"""

from collections.abc import Callable

import numpy as np

from mtl_bench.data.synthetic import furniture as f
from mtl_bench.data.synthetic import vehicles as v
from mtl_bench.data.synthetic.people import PERSON, RIDER, person
from mtl_bench.data.synthetic.primitives import Part
from mtl_bench.data.synthetic.street import KERB_M, Side, Street

THINGS = frozenset((PERSON, RIDER, v.CAR, v.TRUCK, v.BUS, v.TRAIN, v.MOTORCYCLE, v.BICYCLE))
PATH_M = 1.35  # half width that stays free for the ego car
Shadow = tuple[float, float, float, float, float, float, float]  # x, z, yaw, half sizes, velocity


class Cast:
    """Places moving and standing things, and remembers their shadows."""

    def __init__(self, street: Street, ego_step_m: float) -> None:
        self.street, self.ego_step_m = street, ego_step_m
        self.shadows: list[Shadow] = []

    def stand(
        self, parts: list[Part], x: float, z: float, yaw: float, size: tuple[float, float],
        speed: float = 0.0, radius: float | None = None, raised: bool = False,
    ) -> bool:
        """Place a thing of width and length `size` if its ground is free; speed in m per frame."""
        reach = radius if radius is not None else max(size) / 2
        if not self.street.claim(x, z, reach):
            return False
        velocity = (float(np.sin(yaw)) * speed, float(np.cos(yaw)) * speed)
        base = KERB_M if raised else 0.0
        self.street.collector.place(parts, x, z, yaw, velocity, base, THINGS)
        self.shadows.append((x, z, yaw, size[0] / 2 + 0.1, size[1] / 2 + 0.1, *velocity))
        return True

    def vehicle(self, made: v.Vehicle, x: float, z: float, yaw: float, speed: float = 0.0, raised: bool = False) -> bool:
        """Claims a row of discs, so that long vehicles may stand side by side."""
        radius, street = made.width / 2 + 0.12, self.street
        count = max(1, int(np.ceil((made.length - made.width) / made.width)) + 1)
        spread = np.linspace(-1, 1, count) * max(0.0, made.length / 2 - radius + 0.25)
        spots = [(x + s * np.sin(yaw), z + s * np.cos(yaw)) for s in spread]
        for a, b in spots:
            if any((a - p) ** 2 + (b - q) ** 2 < (radius + r) ** 2 for p, q, r in street.taken):
                return False
        street.taken += [(a, b, radius) for a, b in spots]
        velocity = (float(np.sin(yaw)) * speed, float(np.cos(yaw)) * speed)
        street.collector.place(made.parts, x, z, yaw, velocity, KERB_M if raised else 0.0, THINGS)
        self.shadows.append((x, z, yaw, made.width / 2 + 0.1, made.length / 2 + 0.1, *velocity))
        return True


def populate(rng: np.random.Generator, street: Street, ego_step_m: float) -> list[Shadow]:
    """Fill a built street; returns the shadows."""
    cast = Cast(street, ego_step_m)
    _moving(rng, cast)
    names = list(_FEATURES)
    weights = np.array([_FEATURES[n][0] for n in names])
    for name in rng.choice(names, size=int(rng.integers(7, 11)), replace=False, p=weights / weights.sum()):
        for _ in range(4):  # the first free place
            if _FEATURES[name][1](rng, cast):
                break
    _parked(rng, cast)
    _kerbside(rng, cast)
    _walkers(rng, cast)
    return cast.shadows


def _kerb_place(rng: np.random.Generator, cast: Cast, z: tuple[float, float] = (6.5, 17)) -> tuple[Side, float, float] | None:
    """A visible spot on the raised side of a kerb: side, x and z."""
    side = cast.street.right if rng.random() < 0.6 else cast.street.left
    at = rng.uniform(*z)
    x = side.kerb + rng.uniform(0.35, max(0.5, side.front - side.kerb - 0.4))
    if not cast.street.along(at, 0.6) or x > 0.52 * at:
        return None
    return side, side.sign * x, at


def _lane_place(rng: np.random.Generator, cast: Cast, width: float, z: tuple[float, float]) -> tuple[float, float, float] | None:
    """Beside the ego path on the road, at the right kerb or on the left: x, z and yaw."""
    at = rng.uniform(*z)
    street = cast.street
    if rng.random() < 0.6:
        low, high, yaw = PATH_M + width / 2, street.right.kerb - width / 2 - 0.1, 0.0
    else:
        low, high, yaw = -(street.left.kerb - width / 2 - 0.1), -(PATH_M + 0.4 + width / 2), np.pi
    if low > high:
        return None
    return float(rng.uniform(low, high)), at, yaw + rng.normal(0, 0.05)


# --- features: rare classes, close enough to be more than specks -------------------------------------


def _near_person(rng: np.random.Generator, cast: Cast) -> bool:
    spot = _kerb_place(rng, cast, (5.5, 14))
    if spot is None:
        return False
    side, x, z = spot
    moving = rng.random() < 0.5
    done = False
    for i in range(int(rng.integers(1, 4))):
        yaw = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5)
        speed = 0.07 if moving else 0.0
        done |= cast.stand(person(rng), x + side.sign * 0.2 * i, z + 0.75 * i, yaw, (0.5, 0.5), speed, 0.32, True)
    return done


def _crossing_person(rng: np.random.Generator, cast: Cast) -> bool:
    """Somebody on the road, on a zebra where there is one."""
    zebras = cast.street.markings.zebras
    z = rng.uniform(*zebras[0]) if zebras else rng.uniform(10, 20)
    x = rng.uniform(-cast.street.left.kerb + 0.5, cast.street.right.kerb - 0.3)
    if abs(x) < PATH_M and z < 14:
        return False
    yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.2)
    return cast.stand(person(rng), x, z, yaw, (0.5, 0.5), 0.07, 0.35)


def _rider(make: Callable[[np.random.Generator, bool], v.Vehicle], speed: float) -> Callable:
    def feature(rng: np.random.Generator, cast: Cast) -> bool:
        made = make(rng, True)
        spot = _lane_place(rng, cast, 0.8, (6, 15))
        if spot is None:
            return False
        x, z, yaw = spot
        pace = rng.uniform(0.7, 1.2) * speed
        if rng.random() < 0.3:
            yaw, pace = yaw + rng.choice([-1, 1]) * rng.uniform(0.5, 1.4), 0.0
        return cast.vehicle(made, x, z, yaw, pace)

    return feature


def _two_wheels(make: Callable[[np.random.Generator, bool], v.Vehicle]) -> Callable:
    """One to three left standing by the kerb."""

    def feature(rng: np.random.Generator, cast: Cast) -> bool:
        spot = _kerb_place(rng, cast, (5.5, 13))
        if spot is None:
            return False
        side, x, z = spot
        x = side.sign * min(abs(x), side.kerb + 1.2)
        yaw = rng.uniform(0, 2 * np.pi)
        done = False
        for i in range(int(rng.integers(1, 4))):
            done |= cast.vehicle(make(rng, False), x, z + 1.1 * i, yaw + rng.normal(0, 0.1), raised=True)
        return done

    return feature


def _large(make: Callable[[np.random.Generator], v.Vehicle]) -> Callable:
    """A truck or bus: parked at a kerb, oncoming, or ahead in the lane."""

    def feature(rng: np.random.Generator, cast: Cast) -> bool:
        street, made = cast.street, make(rng)
        kind = rng.random()
        z = rng.uniform(9, 26) + made.length / 2
        if kind < 0.35:
            side = street.right if rng.random() < 0.5 else street.left
            x = side.sign * (side.kerb - made.width / 2 - 0.15)
            if side.sign > 0 and x - made.width / 2 < PATH_M or not street.along(z, made.length / 2):
                return False
            return cast.vehicle(made, x, z, 0.0 if side.sign > 0 else np.pi)
        if kind < 0.75:
            x = -street.right.lane_edge - made.width / 2 - rng.uniform(0.2, 0.5)
            return cast.vehicle(made, x, z, np.pi, rng.choice([0.0, rng.uniform(0.3, 0.6)]))
        return cast.vehicle(made, rng.normal(0, 0.1), z + 3, 0.0, cast.ego_step_m * rng.uniform(0.8, 1.2))

    return feature


def _furniture(make: Callable[[np.random.Generator], list[Part]], z: tuple[float, float], kerb_only: bool = True) -> Callable:
    def feature(rng: np.random.Generator, cast: Cast) -> bool:
        spot = _kerb_place(rng, cast, z)
        if spot is None:
            return False
        side, x, at = spot
        if kerb_only:
            x = side.sign * (side.kerb + 0.45)
        return cast.stand(make(rng), x, at, rng.normal(0, 0.12), (0.3, 0.3), 0, 0.3, True)

    return feature


def _barrier(make: Callable[[np.random.Generator, float], list[Part]]) -> Callable:
    """A wall or fence right behind the kerb's sidewalk."""

    def feature(rng: np.random.Generator, cast: Cast) -> bool:
        spot = _kerb_place(rng, cast, (8, 16))
        if spot is None:
            return False
        side, _, z = spot
        length = rng.uniform(5, 12)
        if not cast.street.along(z + 2, length / 2):
            return False
        x = side.sign * (side.front - 0.12)
        cast.street.collector.place(make(rng, length), x, z + 2, base_m=KERB_M)
        return True

    return feature


_FEATURES: dict[str, tuple[float, Callable[[np.random.Generator, Cast], bool]]] = {
    "person": (1.2, _near_person),
    "crossing person": (0.8, _crossing_person),
    "cyclist": (1.5, _rider(v.bicycle, 0.25)),
    "motorcyclist": (1.2, _rider(v.motorcycle, 0.5)),
    "bicycles": (1.2, _two_wheels(v.bicycle)),
    "motorcycles": (1.5, _two_wheels(v.motorcycle)),
    "truck": (1.4, _large(v.truck)),
    "bus": (1.4, _large(v.bus)),
    "column": (0.9, _furniture(f.column, (6, 15))),
    "light": (1.3, _furniture(lambda rng: f.traffic_light(rng, 0.0), (6.5, 14))),
    "sign": (1.2, _furniture(f.traffic_sign, (5.5, 13))),
    "wall": (1.2, _barrier(f.wall)),
    "fence": (1.2, _barrier(f.fence)),
}


# --- the ordinary street ------------------------------------------------------------------------------


def _any_vehicle(rng: np.random.Generator) -> v.Vehicle:
    make = rng.choice(4, p=[0.86, 0.08, 0.03, 0.03])
    return (v.car, v.truck, v.bus)[make](rng) if make < 3 else v.motorcycle(rng, False)


def _moving(rng: np.random.Generator, cast: Cast) -> None:
    street = cast.street
    if street.tram_x is not None and rng.random() < 0.9:
        tram = v.tram(rng)
        z, away = rng.uniform(9, 28) + tram.length / 2, rng.random() < 0.4
        speed = 0.0 if rng.random() < 0.55 else rng.uniform(0.2, 0.6)
        cast.vehicle(tram, street.tram_x, z, 0.0 if away else np.pi, speed)
    if rng.random() < 0.3:
        speed = cast.ego_step_m * rng.uniform(0.85, 1.2)
        cast.vehicle(v.car(rng), rng.normal(0, 0.15), rng.uniform(11, 32), rng.normal(0, 0.01), speed)
    for _ in range(int(rng.choice([0, 1, 2], p=[0.45, 0.35, 0.2]))):
        x = -street.right.lane_edge - rng.uniform(1.2, 1.6)
        cast.vehicle(_any_vehicle(rng), x, rng.uniform(8, 55), np.pi, rng.uniform(0.25, 0.7))
    if street.crossing is not None and rng.random() < 0.6:
        a, b = street.crossing
        rightward = rng.random() < 0.5
        z = a + (b - a) * (0.72 if rightward else 0.28)
        yaw = np.pi / 2 if rightward else -np.pi / 2
        cast.vehicle(_any_vehicle(rng), rng.uniform(-12, 12), z, yaw, rng.uniform(0, 0.5))


def _parked(rng: np.random.Generator, cast: Cast) -> None:
    """Rows along the kerb where there is a parking lane, single cars half on the verge elsewhere."""
    street = cast.street
    for side in street.sides:
        filled = rng.uniform(0.4, 0.9) if side.parking else 0.0
        z = rng.uniform(-4, 3)
        while side.parking and z < 75:
            made = _any_vehicle(rng)
            along = street.along(z + made.length / 2, made.length / 2 + 1)
            if made.width < 2.3 and along and rng.random() < filled:
                yaw = (0.0 if side.sign > 0 else np.pi) + rng.normal(0, 0.03)
                x = side.sign * (side.kerb - made.width / 2 - rng.uniform(0.15, 0.35))
                cast.vehicle(made, x, z + made.length / 2, yaw)
            z += made.length + rng.uniform(0.7, 1.6)


def _kerbside(rng: np.random.Generator, cast: Cast) -> None:
    """Lamps, signs and signals; bicycles against them."""
    street = cast.street
    for side in street.sides:
        x, reach = side.sign * (side.kerb + 0.4), -side.sign * rng.uniform(1.2, 2.2)
        for z in np.arange(rng.uniform(5, 20), 90, rng.uniform(18, 30)):
            if street.along(z, 1):
                cast.stand(f.lamp_post(rng, reach), x, z, 0, (0.2, 0.2), 0, 0.25, True)
        for _ in range(int(rng.integers(1, 4))):
            z = rng.uniform(8, 45)
            if street.along(z, 1):
                cast.stand(f.traffic_sign(rng), x, z, rng.normal(0, 0.1), (0.2, 0.2), 0, 0.3, True)
        for _ in range(int(rng.integers(0, 4))):
            z = rng.uniform(9, 40)
            if street.along(z, 1):
                made = v.bicycle(rng, False)
                cast.vehicle(made, x + side.sign * 0.4, z, rng.normal(0, 0.25), raised=True)
        if street.crossing is not None and rng.random() < 0.7:
            arm = -side.sign * (side.kerb - 0.5) if rng.random() < 0.5 else 0.0
            for z in (street.crossing[0] - 0.7, street.crossing[1] + 0.7):
                cast.stand(f.traffic_light(rng, arm), x, z, 0, (0.2, 0.2), 0, 0.3, True)


def _walkers(rng: np.random.Generator, cast: Cast) -> None:
    street = cast.street
    count = rng.poisson({"city": 7, "suburb": 3, "avenue": 4}[street.style])
    for _ in range(int(count)):
        side = street.right if rng.random() < 0.5 else street.left
        x = side.sign * rng.uniform(side.walk_from + 0.4, side.front - 0.3)
        z, yaw = rng.uniform(7, 45), rng.choice([0, np.pi]) + rng.normal(0, 0.2)
        if street.along(z, 0.5):
            cast.stand(person(rng), x, z, yaw, (0.5, 0.5), 0.07 * (rng.random() < 0.7), 0.35, True)
