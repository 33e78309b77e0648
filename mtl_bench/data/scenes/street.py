"""One street: what is built along it, and who drives, walks and stands in it.

The ego car drives along +z in the right lane, x = 0 in its middle; everything is placed as it is at
the annotated frame.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from mtl_bench.data.scenes import objects as o
from mtl_bench.data.scenes.rays import Collector, Paint, Part, ball, box
from mtl_bench.data.scenes.surfaces import Markings, Material

Random = np.random.Generator
START_M, FAR_M = -16.0, 130.0
KERB_M = 0.13
PATH_M = 1.35  # half width that stays free for the ego car
Shadow = tuple[float, float, float, float, float, float, float]  # x, z, yaw, half sizes, velocity


@dataclass
class Side:
    """One side of the street, from the lane outwards; `sign` is +1 on the right."""

    sign: int
    lane_edge: float  # |x| where parking or the kerb begins
    parking: bool
    verge: float  # width of a grass strip at the kerb
    walk: float  # width of the sidewalk

    @property
    def kerb(self) -> float:
        return self.lane_edge + 2.3 * self.parking

    @property
    def walk_from(self) -> float:
        return self.kerb + self.verge

    @property
    def front(self) -> float:
        """Where private ground begins."""
        return self.walk_from + self.walk


@dataclass
class Street:
    """The plan, and everything placed so far."""

    right: Side
    left: Side
    crossing: tuple[float, float] | None  # z from, to of a side road
    tram_x: float | None
    end_m: float | None  # z of the building that closes the street
    style: str
    collector: Collector = field(default_factory=Collector)
    markings: Markings = field(default_factory=Markings)
    taken: list[tuple[float, float, float]] = field(default_factory=list)  # x, z, radius

    @property
    def sides(self) -> tuple[Side, Side]:
        return self.right, self.left

    def stretches(self) -> list[tuple[float, float]]:
        """z ranges along which the kerb runs."""
        far = FAR_M if self.end_m is None else self.end_m
        if self.crossing is None or self.crossing[0] > far:
            return [(START_M, far)]
        return [(START_M, self.crossing[0]), (self.crossing[1], far)]

    def along(self, z: float, margin: float = 0.0) -> bool:
        return any(a + margin <= z <= b - margin for a, b in self.stretches())

    def claim(self, spots: list[tuple[float, float]], radius: float) -> bool:
        """Take discs of ground, by their middles (x, z), unless somebody has a part of one."""
        for x, z in spots:
            if any((x - a) ** 2 + (z - b) ** 2 < (radius + r) ** 2 for a, b, r in self.taken):
                return False
        self.taken += [(x, z, radius) for x, z in spots]
        return True


def draw_street(rng: Random, ego_step_m: float) -> tuple[Street, list[Shadow]]:
    """Plan a street, build it up and fill it; also the shadows of what moves and stands there."""
    street = _plan(rng)
    _build_up(rng, street)
    return street, _populate(rng, street, ego_step_m)


def _plan(rng: Random) -> Street:
    """Draw widths and the kind of quarter; lay the ground."""
    style = str(rng.choice(["city", "suburb", "avenue"], p=[0.45, 0.35, 0.2]))
    tram_x = None
    half_lane = rng.uniform(1.7, 2.0)
    lanes_left = int(rng.choice([1, 2], p=[0.7, 0.3]))
    left_edge = half_lane + lanes_left * rng.uniform(2.9, 3.3)
    if rng.random() < 0.5:
        tram_x = -(half_lane + 1.7) if lanes_left == 1 else -(left_edge - 1.6)
        left_edge += 0.4
    verge = {"city": 0.2, "suburb": 0.6, "avenue": 0.7}[style]
    sides = []
    for sign, edge in ((1, half_lane), (-1, left_edge)):
        grass = rng.uniform(1.0, 2.6) if rng.random() < verge else 0.0
        sides.append(Side(sign, edge, bool(rng.random() < 0.42), grass, rng.uniform(1.5, 3.6)))
    crossing = None
    if rng.random() < 0.5:
        start = rng.uniform(13, 50)
        crossing = (start, start + rng.uniform(7, 10))
    end = rng.uniform(55, 110) if rng.random() < 0.45 else None
    if end is not None and crossing is not None and crossing[1] > end - 12:
        end = None
    street = Street(sides[0], sides[1], crossing, tram_x, end, style)
    _ground(rng, street)
    _markings(rng, street, half_lane, lanes_left)
    return street


def _ground(rng: Random, street: Street) -> None:
    place = street.collector.place
    dry = rng.uniform(0, 1)
    bright = (0.34 + 0.2 * dry, 0.46 + 0.02 * dry, 0.16 + 0.08 * dry)
    grass = Paint(Material.GRASS, tuple(0.6 * c for c in bright), bright)
    gray = rng.uniform(0.25, 0.37)
    asphalt = Paint(Material.ASPHALT, (gray, gray, gray * rng.uniform(0.97, 1.06)))
    slab = rng.uniform(0.5, 0.62)
    tone = rng.normal(0, 0.02, 3) + slab * np.array([1.02, 0.98, 0.92])
    slabs = (rng.uniform(0.4, 1.1), 0, 0, 0)
    paving = Paint(Material.PAVING, tuple(tone.tolist()), (0.68, 0.68, 0.66), slabs)
    place([box((0, -1.03, 150), (600, 1, 700), grass, o.TERRAIN)], 0, 0)
    left, right = -street.left.kerb, street.right.kerb
    far = 400.0 if street.end_m is None else street.end_m + 12
    road = (right - left, 1, far + 30)
    place([box(((left + right) / 2, -1, (far - 30) / 2), road, asphalt, o.ROAD)], 0, 0)
    roads = [] if street.crossing is None else [street.crossing]
    if street.end_m is not None:
        roads.append((street.end_m - 0.5, street.end_m + 8))
    for a, b in roads:
        place([box((0, -1.004, (a + b) / 2), (240, 1, b - a), asphalt, o.ROAD)], 0, 0)
    for side in street.sides:
        for a, b in street.stretches():
            strips = [(side.walk_from, side.front, paving, o.SIDEWALK, 0.0)]
            if side.verge:
                strips.append((side.kerb, side.walk_from, grass, o.TERRAIN, 0.0))
            strips.append((side.front, side.front + 30, grass, o.TERRAIN, 0.01))
            for x0, x1, paint, label, drop in strips:
                size = (x1 - x0, 0.5 + KERB_M - drop, b - a)
                at = (side.sign * (x0 + x1) / 2, -0.5, (a + b) / 2)
                place([box(at, size, paint, label)], 0, 0)


def _markings(rng: Random, street: Street, half_lane: float, lanes_left: int) -> None:
    marks = street.markings
    marks.x_range = (-street.left.kerb, street.right.kerb)
    period, duty = rng.uniform(6, 10), rng.uniform(0.4, 0.55)
    marks.lines.append((-half_lane, 0.16, period, 1.0 if rng.random() < 0.2 else duty))
    if lanes_left == 2:
        marks.lines.append((-(half_lane + street.left.lane_edge) / 2, 0.16, period, duty))
    for side in street.sides:
        if side.parking or rng.random() < 0.4:
            marks.lines.append((side.sign * (side.lane_edge - 0.1), 0.14, 10.0, 1.0))
    if street.tram_x is not None:
        marks.rails += [street.tram_x - 0.72, street.tram_x + 0.72]
    if street.crossing is not None:
        a, b = street.crossing
        marks.free.append((a - 4.5, b + 4.5))
        if rng.random() < 0.75:
            marks.zebras.append((a - 3.6, a - 0.8))
        if rng.random() < 0.5:
            marks.zebras.append((b + 0.8, b + 3.6))
    elif rng.random() < 0.4:
        z = rng.uniform(9, 25)
        marks.zebras.append((z, z + 3))
        marks.free.append((z - 1, z + 4))


# --- frontages ------------------------------------------------------------------------------------


def _build_up(rng: Random, street: Street) -> None:
    """Line both sides with houses, gardens and greenery, and close or open the far end."""
    for side in street.sides:
        for a, b in street.stretches():
            z = a
            while z < b - 2:
                length = min(rng.uniform(9, 22), b - z)
                _plot(rng, street, side, z, length)
                z += length
    _trees(rng, street)
    _far_end(rng, street)


def _plot(rng: Random, street: Street, side: Side, z: float, length: float) -> None:
    """A house at the sidewalk, a house behind a garden, or open green."""
    share = {"city": (0.68, 0.26), "suburb": (0.12, 0.66), "avenue": (0.4, 0.4)}[street.style]
    kind = rng.random()
    middle = z + length / 2
    place = street.collector.place
    if kind < share[0]:
        tall = rng.uniform(8, 17) if street.style != "suburb" else rng.uniform(6, 9)
        house = o.building(rng, (12, tall, length), bool(rng.random() < 0.3))
        place(house, side.sign * (side.front + 6 + rng.uniform(0, 0.5)), middle, base_m=KERB_M)
        return
    garden_m = KERB_M - 0.02
    make = rng.choice(4, p=[0.3, 0.4, 0.16, 0.14])
    if make < 3:  # something separates the garden from the sidewalk
        part = (o.wall, o.fence, o.hedge)[make](rng, length)
        x = side.sign * (side.front + (0.5 if make == 2 else 0.2))
        place(part, x, middle, base_m=garden_m)
    if kind < share[0] + share[1]:
        depth, gap = rng.uniform(8, 11), rng.uniform(1, 4) if length > 9 else 0.0
        size = (depth, rng.uniform(4.5, 8.5), length - gap)
        house = o.building(rng, size, bool(rng.random() < 0.75))
        set_back = rng.uniform(3, 7)
        place(house, side.sign * (side.front + set_back + depth / 2), middle, base_m=garden_m)
        if rng.random() < 0.5:
            x = side.sign * (side.front + rng.uniform(1.2, 2.2))
            bush = o.bush(rng, rng.uniform(0.9, 1.6))
            place(bush, x, z + rng.uniform(1, length), base_m=garden_m)
    else:
        for _ in range(int(rng.integers(1, 4))):
            x = side.sign * (side.front + rng.uniform(2.5, 14))
            tree = o.tree(rng, rng.uniform(5, 10))
            place(tree, x, z + rng.uniform(0, length), base_m=garden_m)


def _trees(rng: Random, street: Street) -> None:
    chance = {"city": 0.3, "suburb": 0.5, "avenue": 0.95}[street.style]
    for side in street.sides:
        if rng.random() > chance:
            continue
        spacing, height = rng.uniform(8, 15), rng.uniform(5.5, 9)
        for z in np.arange(rng.uniform(4, 4 + spacing), 80, spacing):
            x = side.sign * (side.kerb + (side.verge / 2 if side.verge else 0.6))
            if street.along(z, 2) and street.claim([(x, z)], 0.8):
                tall = height * rng.uniform(0.85, 1.15)
                street.collector.place(o.tree(rng, tall), x, z, rng.uniform(0, 6), base_m=KERB_M)


def _far_end(rng: Random, street: Street) -> None:
    """A house across the end of a closed street; distant trees, houses and hills otherwise."""
    place = street.collector.place
    if street.end_m is not None:
        z, x = street.end_m + 15, -60.0
        while x < 60:
            length = rng.uniform(12, 24)
            house = o.building(rng, (12, rng.uniform(8, 16), length), bool(rng.random() < 0.4))
            place(house, x + length / 2, z, np.pi / 2)
            x += length + (4.0 if rng.random() < 0.3 else 0.0)
        return
    for _ in range(int(rng.integers(4, 12))):
        x, z = rng.uniform(-60, 60), rng.uniform(150, 240)
        if abs(x) > 8:
            place(o.tree(rng, rng.uniform(8, 16)), x, z)
    for middle in range(-150, 150, 40):
        if rng.random() < 0.6:
            size = (rng.uniform(50, 90), rng.uniform(8, 24), 40)
            leaves = Paint(Material.FOLIAGE, (0.25, 0.36, 0.18), (0.14, 0.22, 0.1))
            hill = ball((0, 0, 0), size, leaves, o.VEGETATION)
            place([hill], middle + rng.uniform(-15, 15), 290)


# --- traffic and people ---------------------------------------------------------------------------


class Crowd:
    """Places moving and standing things where the ground is free, and remembers their shadows."""

    def __init__(self, street: Street, ego_step_m: float) -> None:
        self.street, self.ego_step_m = street, ego_step_m
        self.shadows: list[Shadow] = []

    def stand(
        self,
        parts: list[Part],
        x: float,
        z: float,
        yaw: float,
        width: float,
        reach: float,
        speed: float = 0.0,
        raised: bool = True,
    ) -> bool:
        """A thing on a square of ground, by its width and what it claims; speed in m a frame."""
        free = self.street.claim([(x, z)], reach)
        return free and self._place(o.Vehicle(parts, width, width), x, z, yaw, speed, raised)

    def vehicle(
        self,
        made: o.Vehicle,
        x: float,
        z: float,
        yaw: float,
        speed: float = 0.0,
        raised: bool = False,
    ) -> bool:
        """Claims a row of discs, so that long vehicles may stand side by side."""
        radius = made.width / 2 + 0.12
        count = max(1, int(np.ceil((made.length - made.width) / made.width)) + 1)
        spread = np.linspace(-1, 1, count) * max(0.0, made.length / 2 - radius + 0.25)
        spots = [(x + s * np.sin(yaw), z + s * np.cos(yaw)) for s in spread]
        return self.street.claim(spots, radius) and self._place(made, x, z, yaw, speed, raised)

    def _place(
        self, made: o.Vehicle, x: float, z: float, yaw: float, speed: float, raised: bool
    ) -> bool:
        velocity = (float(np.sin(yaw)) * speed, float(np.cos(yaw)) * speed)
        base = KERB_M if raised else 0.0
        self.street.collector.place(made.parts, x, z, yaw, velocity, base, o.THINGS)
        self.shadows.append((x, z, yaw, made.width / 2 + 0.1, made.length / 2 + 0.1, *velocity))
        return True


# --- features: rare things close to the camera. A sparse street would show most classes as specks,
# so every scene draws several before the ordinary traffic fills what room is left. A feature places
# itself and says whether it found a free spot.


def _at_kerb(
    rng: Random, crowd: Crowd, z: tuple[float, float], put: Callable[..., bool], **given: Any
) -> bool:
    """Draw a spot on the raised side of a kerb; where it is visible, put something there."""
    side = crowd.street.right if rng.random() < 0.6 else crowd.street.left
    at = rng.uniform(*z)
    x = side.kerb + rng.uniform(0.35, max(0.5, side.front - side.kerb - 0.4))
    if not crowd.street.along(at, 0.6) or x > 0.52 * at:
        return False
    return put(rng, crowd, side, side.sign * x, at, **given)


def _people(rng: Random, crowd: Crowd, side: Side, x: float, z: float) -> bool:
    moving = rng.random() < 0.5
    done = False
    for i in range(int(rng.integers(1, 4))):
        yaw, beside = rng.choice([0.0, np.pi]) + rng.normal(0, 0.5), x + side.sign * 0.2 * i
        done |= crowd.stand(o.person(rng), beside, z + 0.75 * i, yaw, 0.5, 0.32, 0.07 * moving)
    return done


def _two_wheels(
    rng: Random, crowd: Crowd, side: Side, x: float, z: float, make: Callable[..., o.Vehicle]
) -> bool:
    """One to three left standing by the kerb."""
    x = side.sign * min(abs(x), side.kerb + 1.2)
    yaw = rng.uniform(0, 2 * np.pi)
    done = False
    for i in range(int(rng.integers(1, 4))):
        made = make(rng, ridden=False)
        done |= crowd.vehicle(made, x, z + 1.1 * i, yaw + rng.normal(0, 0.1), raised=True)
    return done


def _furniture(
    rng: Random, crowd: Crowd, side: Side, _: float, z: float, make: Callable[..., list[Part]]
) -> bool:
    x = side.sign * (side.kerb + 0.45)
    return crowd.stand(make(rng), x, z, rng.normal(0, 0.12), 0.3, 0.3)


def _barrier(
    rng: Random, crowd: Crowd, side: Side, _: float, z: float, make: Callable[..., list[Part]]
) -> bool:
    """A wall or fence right behind the kerb's sidewalk."""
    length = rng.uniform(5, 12)
    if not crowd.street.along(z + 2, length / 2):
        return False
    x = side.sign * (side.front - 0.12)
    crowd.street.collector.place(make(rng, length), x, z + 2, base_m=KERB_M)
    return True


def _crossing_person(rng: Random, crowd: Crowd) -> bool:
    """Somebody on the road, on a zebra where there is one."""
    zebras = crowd.street.markings.zebras
    z = rng.uniform(*zebras[0]) if zebras else rng.uniform(10, 20)
    x = rng.uniform(-crowd.street.left.kerb + 0.5, crowd.street.right.kerb - 0.3)
    if abs(x) < PATH_M and z < 14:
        return False
    yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(0, 0.2)
    return crowd.stand(o.person(rng), x, z, yaw, 0.5, 0.35, 0.07, raised=False)


def _rider(rng: Random, crowd: Crowd, make: Callable[..., o.Vehicle], speed: float) -> bool:
    """Beside the ego path on the road, at the right kerb or on the left."""
    made, z, street = make(rng, ridden=True), rng.uniform(6, 15), crowd.street
    half = 0.4
    if rng.random() < 0.6:
        low, high, yaw = PATH_M + half, street.right.kerb - half - 0.1, 0.0
    else:
        low, high, yaw = -(street.left.kerb - half - 0.1), -(PATH_M + 0.4 + half), np.pi
    if low > high:
        return False
    x, yaw = rng.uniform(low, high), yaw + rng.normal(0, 0.05)
    pace = rng.uniform(0.7, 1.2) * speed
    if rng.random() < 0.3:
        yaw, pace = yaw + rng.choice([-1, 1]) * rng.uniform(0.5, 1.4), 0.0
    return crowd.vehicle(made, x, z, yaw, pace)


def _large(rng: Random, crowd: Crowd, make: Callable[[Random], o.Vehicle]) -> bool:
    """A truck or bus: parked at a kerb, oncoming, or ahead in the lane."""
    street, made = crowd.street, make(rng)
    kind = rng.random()
    half = made.width / 2
    z = rng.uniform(9, 26) + made.length / 2
    if kind < 0.45:
        side = street.right if rng.random() < 0.5 else street.left
        x = side.sign * (side.kerb - half - 0.15)
        if (side.sign > 0 and x - half < PATH_M) or not street.along(z, made.length / 2):
            return False
        return crowd.vehicle(made, x, z, 0.0 if side.sign > 0 else np.pi)
    if kind < 0.85:
        x = -street.right.lane_edge - half - rng.uniform(0.2, 0.5)
        return crowd.vehicle(made, x, z, np.pi, rng.uniform(0.3, 0.6) * (rng.random() < 0.3))
    # what drives as fast as we do looks infinitely far; most stand in a queue
    pace = rng.uniform(0.8, 1.2) * (rng.random() < 0.2)
    return crowd.vehicle(made, rng.normal(0, 0.1), z + 3, 0.0, crowd.ego_step_m * pace)


FEATURES: dict[str, tuple[float, Callable[[Random, Crowd], bool]]] = {
    "people": (2.2, partial(_at_kerb, z=(5.5, 14), put=_people)),
    "crossing person": (1.1, _crossing_person),
    "cyclist": (1.7, partial(_rider, make=o.bicycle, speed=0.25)),
    "motorcyclist": (1.2, partial(_rider, make=o.motorcycle, speed=0.5)),
    "bicycles": (1.2, partial(_at_kerb, z=(5.5, 13), put=_two_wheels, make=o.bicycle)),
    "motorcycles": (1.5, partial(_at_kerb, z=(5.5, 13), put=_two_wheels, make=o.motorcycle)),
    "truck": (1.4, partial(_large, make=o.truck)),
    "bus": (1.4, partial(_large, make=o.bus)),
    "column": (0.9, partial(_at_kerb, z=(6, 15), put=_furniture, make=o.column)),
    "light": (1.3, partial(_at_kerb, z=(6.5, 14), put=_furniture, make=o.traffic_light)),
    "sign": (1.2, partial(_at_kerb, z=(5.5, 13), put=_furniture, make=o.traffic_sign)),
    "wall": (1.2, partial(_at_kerb, z=(8, 16), put=_barrier, make=o.wall)),
    "fence": (1.6, partial(_at_kerb, z=(8, 16), put=_barrier, make=o.fence)),
}


# --- the ordinary street around its features: traffic, parked cars, lamps and signs, walkers ------


def _populate(rng: Random, street: Street, ego_step_m: float) -> list[Shadow]:
    """Fill a built street; returns the shadows."""
    crowd = Crowd(street, ego_step_m)
    _moving(rng, crowd)
    names = list(FEATURES)
    weights = np.array([FEATURES[n][0] for n in names])
    count = int(rng.integers(7, 11))
    for name in rng.choice(names, size=count, replace=False, p=weights / weights.sum()):
        for _ in range(4):  # the first free place
            if FEATURES[name][1](rng, crowd):
                break
    _parked(rng, crowd)
    _kerbside(rng, crowd)
    _walkers(rng, crowd)
    return crowd.shadows


def _any_vehicle(rng: Random) -> o.Vehicle:
    make = rng.choice(4, p=[0.86, 0.08, 0.03, 0.03])
    return (o.car, o.truck, o.bus)[make](rng) if make < 3 else o.motorcycle(rng, False)


def _moving(rng: Random, crowd: Crowd) -> None:
    street = crowd.street
    if street.tram_x is not None and rng.random() < 0.9:
        tram = o.tram(rng)
        z, away = rng.uniform(9, 28) + tram.length / 2, rng.random() < 0.4
        speed = 0.0 if rng.random() < 0.7 else rng.uniform(0.2, 0.6)
        crowd.vehicle(tram, street.tram_x, z, 0.0 if away else np.pi, speed)
    if rng.random() < 0.1:
        speed = crowd.ego_step_m * rng.uniform(0.85, 1.2)
        made, x, z = o.car(rng), rng.normal(0, 0.15), rng.uniform(11, 32)
        crowd.vehicle(made, x, z, rng.normal(0, 0.01), speed)
    for _ in range(int(rng.choice([0, 1, 2], p=[0.55, 0.33, 0.12]))):
        x = -street.right.lane_edge - rng.uniform(1.2, 1.6)
        crowd.vehicle(_any_vehicle(rng), x, rng.uniform(8, 55), np.pi, rng.uniform(0.25, 0.7))
    if street.crossing is not None and rng.random() < 0.5:
        a, b = street.crossing
        rightward = rng.random() < 0.5
        z = a + (b - a) * (0.72 if rightward else 0.28)
        yaw = np.pi / 2 if rightward else -np.pi / 2
        crowd.vehicle(_any_vehicle(rng), rng.uniform(-12, 12), z, yaw, rng.uniform(0, 0.5))


def _parked(rng: Random, crowd: Crowd) -> None:
    """Rows along the kerb where there is a parking lane."""
    street = crowd.street
    for side in street.sides:
        filled = rng.uniform(0.4, 0.9) if side.parking else 0.0
        z = rng.uniform(-4, 3)
        while side.parking and z < 75:
            made = _any_vehicle(rng)
            along = street.along(z + made.length / 2, made.length / 2 + 1)
            if made.width < 2.3 and along and rng.random() < filled:
                yaw = (0.0 if side.sign > 0 else np.pi) + rng.normal(0, 0.03)
                x = side.sign * (side.kerb - made.width / 2 - rng.uniform(0.15, 0.35))
                crowd.vehicle(made, x, z + made.length / 2, yaw)
            z += made.length + rng.uniform(0.7, 1.6)


def _kerbside(rng: Random, crowd: Crowd) -> None:
    """Lamps, signs and signals; bicycles against them."""
    street = crowd.street
    for side in street.sides:
        x, reach = side.sign * (side.kerb + 0.4), -side.sign * rng.uniform(1.2, 2.2)
        for z in np.arange(rng.uniform(5, 20), 90, rng.uniform(18, 30)):
            if street.along(z, 1):
                crowd.stand(o.lamp_post(rng, reach), x, z, 0, 0.2, 0.25)
        for _ in range(int(rng.integers(1, 4))):
            z = rng.uniform(8, 45)
            if street.along(z, 1):
                crowd.stand(o.traffic_sign(rng), x, z, rng.normal(0, 0.1), 0.2, 0.3)
        for _ in range(int(rng.integers(0, 4))):
            z = rng.uniform(9, 40)
            if street.along(z, 1):
                made = o.bicycle(rng, False)
                crowd.vehicle(made, x + side.sign * 0.4, z, rng.normal(0, 0.25), raised=True)
        if street.crossing is not None and rng.random() < 0.7:
            arm = -side.sign * (side.kerb - 0.5) if rng.random() < 0.5 else 0.0
            for z in (street.crossing[0] - 0.7, street.crossing[1] + 0.7):
                crowd.stand(o.traffic_light(rng, arm), x, z, 0, 0.2, 0.3)


def _walkers(rng: Random, crowd: Crowd) -> None:
    street = crowd.street
    count = rng.poisson({"city": 7, "suburb": 3, "avenue": 4}[street.style])
    for _ in range(int(count)):
        side = street.right if rng.random() < 0.5 else street.left
        x = side.sign * rng.uniform(side.walk_from + 0.4, side.front - 0.3)
        z, yaw = rng.uniform(7, 45), rng.choice([0, np.pi]) + rng.normal(0, 0.2)
        if street.along(z, 0.5):
            crowd.stand(o.person(rng), x, z, yaw, 0.5, 0.35, 0.07 * (rng.random() < 0.7))
