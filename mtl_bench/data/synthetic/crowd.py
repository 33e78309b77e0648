"""Who is in the street: vehicles and people find a free place, and their shadows are kept."""

import numpy as np

from mtl_bench.data.synthetic import vehicles as v
from mtl_bench.data.synthetic.people import PERSON, RIDER
from mtl_bench.data.synthetic.primitives import Part
from mtl_bench.data.synthetic.street import KERB_M, Street

THINGS = frozenset((PERSON, RIDER, v.CAR, v.TRUCK, v.BUS, v.TRAIN, v.MOTORCYCLE, v.BICYCLE))
PATH_M = 1.35  # half width that stays free for the ego car
Shadow = tuple[float, float, float, float, float, float, float]  # x, z, yaw, half sizes, velocity


class Crowd:
    """Places moving and standing things, and remembers their shadows."""

    def __init__(self, street: Street, ego_step_m: float) -> None:
        self.street, self.ego_step_m = street, ego_step_m
        self.shadows: list[Shadow] = []

    def stand(
        self,
        parts: list[Part],
        x: float,
        z: float,
        yaw: float,
        size: tuple[float, float],
        speed: float = 0.0,
        radius: float | None = None,
        raised: bool = False,
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

    def vehicle(
        self,
        made: v.Vehicle,
        x: float,
        z: float,
        yaw: float,
        speed: float = 0.0,
        raised: bool = False,
    ) -> bool:
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
