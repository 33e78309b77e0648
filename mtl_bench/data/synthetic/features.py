"""Rare things close to the camera.

A sparse street would show most classes as specks. Every scene therefore draws several *features*
before the ordinary traffic fills what room is left. A feature places itself and says whether it
found a free spot.
"""

from collections.abc import Callable

import numpy as np

from mtl_bench.data.synthetic import furniture as f
from mtl_bench.data.synthetic import vehicles as v
from mtl_bench.data.synthetic.crowd import PATH_M, Crowd
from mtl_bench.data.synthetic.people import person
from mtl_bench.data.synthetic.primitives import Part
from mtl_bench.data.synthetic.street import KERB_M, Side


def _kerb_place(
    rng: np.random.Generator, crowd: Crowd, z: tuple[float, float] = (6.5, 17)
) -> tuple[Side, float, float] | None:
    """A visible spot on the raised side of a kerb: side, x and z."""
    side = crowd.street.right if rng.random() < 0.6 else crowd.street.left
    at = rng.uniform(*z)
    x = side.kerb + rng.uniform(0.35, max(0.5, side.front - side.kerb - 0.4))
    if not crowd.street.along(at, 0.6) or x > 0.52 * at:
        return None
    return side, side.sign * x, at


def _lane_place(
    rng: np.random.Generator, crowd: Crowd, width: float, z: tuple[float, float]
) -> tuple[float, float, float] | None:
    """Beside the ego path on the road, at the right kerb or on the left: x, z and yaw."""
    at = rng.uniform(*z)
    street = crowd.street
    if rng.random() < 0.6:
        low, high, yaw = PATH_M + width / 2, street.right.kerb - width / 2 - 0.1, 0.0
    else:
        low, high, yaw = -(street.left.kerb - width / 2 - 0.1), -(PATH_M + 0.4 + width / 2), np.pi
    if low > high:
        return None
    return float(rng.uniform(low, high)), at, yaw + rng.normal(0, 0.05)


def _near_person(rng: np.random.Generator, crowd: Crowd) -> bool:
    spot = _kerb_place(rng, crowd, (5.5, 14))
    if spot is None:
        return False
    side, x, z = spot
    moving = rng.random() < 0.5
    done = False
    for i in range(int(rng.integers(1, 4))):
        yaw = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5)
        speed = 0.07 if moving else 0.0
        done |= crowd.stand(
            person(rng), x + side.sign * 0.2 * i, z + 0.75 * i, yaw, (0.5, 0.5), speed, 0.32, True
        )
    return done


def _crossing_person(rng: np.random.Generator, crowd: Crowd) -> bool:
    """Somebody on the road, on a zebra where there is one."""
    zebras = crowd.street.markings.zebras
    z = rng.uniform(*zebras[0]) if zebras else rng.uniform(10, 20)
    x = rng.uniform(-crowd.street.left.kerb + 0.5, crowd.street.right.kerb - 0.3)
    if abs(x) < PATH_M and z < 14:
        return False
    yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.2)
    return crowd.stand(person(rng), x, z, yaw, (0.5, 0.5), 0.07, 0.35)


def _rider(make: Callable[[np.random.Generator, bool], v.Vehicle], speed: float) -> Callable:
    def feature(rng: np.random.Generator, crowd: Crowd) -> bool:
        made = make(rng, True)
        spot = _lane_place(rng, crowd, 0.8, (6, 15))
        if spot is None:
            return False
        x, z, yaw = spot
        pace = rng.uniform(0.7, 1.2) * speed
        if rng.random() < 0.3:
            yaw, pace = yaw + rng.choice([-1, 1]) * rng.uniform(0.5, 1.4), 0.0
        return crowd.vehicle(made, x, z, yaw, pace)

    return feature


def _two_wheels(make: Callable[[np.random.Generator, bool], v.Vehicle]) -> Callable:
    """One to three left standing by the kerb."""

    def feature(rng: np.random.Generator, crowd: Crowd) -> bool:
        spot = _kerb_place(rng, crowd, (5.5, 13))
        if spot is None:
            return False
        side, x, z = spot
        x = side.sign * min(abs(x), side.kerb + 1.2)
        yaw = rng.uniform(0, 2 * np.pi)
        done = False
        for i in range(int(rng.integers(1, 4))):
            done |= crowd.vehicle(
                make(rng, False), x, z + 1.1 * i, yaw + rng.normal(0, 0.1), raised=True
            )
        return done

    return feature


def _large(make: Callable[[np.random.Generator], v.Vehicle]) -> Callable:
    """A truck or bus: parked at a kerb, oncoming, or ahead in the lane."""

    def feature(rng: np.random.Generator, crowd: Crowd) -> bool:
        street, made = crowd.street, make(rng)
        kind = rng.random()
        z = rng.uniform(9, 26) + made.length / 2
        if kind < 0.45:
            side = street.right if rng.random() < 0.5 else street.left
            x = side.sign * (side.kerb - made.width / 2 - 0.15)
            if (side.sign > 0 and x - made.width / 2 < PATH_M) or not street.along(
                z, made.length / 2
            ):
                return False
            return crowd.vehicle(made, x, z, 0.0 if side.sign > 0 else np.pi)
        if kind < 0.85:
            x = -street.right.lane_edge - made.width / 2 - rng.uniform(0.2, 0.5)
            return crowd.vehicle(made, x, z, np.pi, rng.uniform(0.3, 0.6) * (rng.random() < 0.3))
        # what drives as fast as we do looks infinitely far; most stand in a queue
        pace = rng.uniform(0.8, 1.2) * (rng.random() < 0.2)
        return crowd.vehicle(made, rng.normal(0, 0.1), z + 3, 0.0, crowd.ego_step_m * pace)

    return feature


def _furniture(
    make: Callable[[np.random.Generator], list[Part]],
    z: tuple[float, float],
    kerb_only: bool = True,
) -> Callable:
    def feature(rng: np.random.Generator, crowd: Crowd) -> bool:
        spot = _kerb_place(rng, crowd, z)
        if spot is None:
            return False
        side, x, at = spot
        if kerb_only:
            x = side.sign * (side.kerb + 0.45)
        return crowd.stand(make(rng), x, at, rng.normal(0, 0.12), (0.3, 0.3), 0, 0.3, True)

    return feature


def _barrier(make: Callable[[np.random.Generator, float], list[Part]]) -> Callable:
    """A wall or fence right behind the kerb's sidewalk."""

    def feature(rng: np.random.Generator, crowd: Crowd) -> bool:
        spot = _kerb_place(rng, crowd, (8, 16))
        if spot is None:
            return False
        side, _, z = spot
        length = rng.uniform(5, 12)
        if not crowd.street.along(z + 2, length / 2):
            return False
        x = side.sign * (side.front - 0.12)
        crowd.street.collector.place(make(rng, length), x, z + 2, base_m=KERB_M)
        return True

    return feature


FEATURES: dict[str, tuple[float, Callable[[np.random.Generator, Crowd], bool]]] = {
    "person": (2.2, _near_person),
    "crossing person": (1.1, _crossing_person),
    "cyclist": (1.7, _rider(v.bicycle, 0.25)),
    "motorcyclist": (1.2, _rider(v.motorcycle, 0.5)),
    "bicycles": (1.2, _two_wheels(v.bicycle)),
    "motorcycles": (1.5, _two_wheels(v.motorcycle)),
    "truck": (1.4, _large(v.truck)),
    "bus": (1.4, _large(v.bus)),
    "column": (0.9, _furniture(f.column, (6, 15))),
    "light": (1.3, _furniture(lambda rng: f.traffic_light(rng, 0.0), (6.5, 14))),
    "sign": (1.2, _furniture(f.traffic_sign, (5.5, 13))),
    "wall": (1.2, _barrier(f.wall)),
    "fence": (1.6, _barrier(f.fence)),
}
