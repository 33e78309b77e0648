"""One street: what is built along it. Traffic and people are added by `traffic.py`.

The ego car drives along +z in the right lane, x = 0 in its middle; everything is placed as it is at
the annotated frame.
"""

from dataclasses import dataclass, field

import numpy as np

from mtl_bench.data.synthetic import furniture as f
from mtl_bench.data.synthetic.material import Markings, Material
from mtl_bench.data.synthetic.primitives import Collector, Paint, box

START_M, FAR_M = -16.0, 130.0
KERB_M = 0.13


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

    def claim(self, x: float, z: float, radius: float) -> bool:
        """Take a disc of ground unless somebody has it."""
        if any((x - a) ** 2 + (z - b) ** 2 < (radius + r) ** 2 for a, b, r in self.taken):
            return False
        self.taken.append((x, z, radius))
        return True


def plan(rng: np.random.Generator) -> Street:
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


def _ground(rng: np.random.Generator, street: Street) -> None:
    place = street.collector.place
    grass = _grass_paint(rng)
    gray = rng.uniform(0.25, 0.37)
    asphalt = Paint(Material.ASPHALT, (gray, gray, gray * rng.uniform(0.97, 1.06)))
    slab = rng.uniform(0.5, 0.62)
    tone = rng.normal(0, 0.02, 3) + slab * np.array([1.02, 0.98, 0.92])
    paving = Paint(
        Material.PAVING, tuple(tone.tolist()), (0.68, 0.68, 0.66), (rng.uniform(0.4, 1.1), 0, 0, 0)
    )
    place([box((0, -1.03, 150), (600, 1, 700), grass, f.TERRAIN)], 0, 0)
    left, right = -street.left.kerb, street.right.kerb
    far = 400.0 if street.end_m is None else street.end_m + 12
    road = box(
        ((left + right) / 2, -1, (far - 30) / 2), (right - left, 1, far + 30), asphalt, f.ROAD
    )
    place([road], 0, 0)
    roads = [] if street.crossing is None else [street.crossing]
    if street.end_m is not None:
        roads.append((street.end_m - 0.5, street.end_m + 8))
    for a, b in roads:
        place([box((0, -1.004, (a + b) / 2), (240, 1, b - a), asphalt, f.ROAD)], 0, 0)
    for side in street.sides:
        for a, b in street.stretches():
            strips = [(side.walk_from, side.front, paving, f.SIDEWALK, 0.0)]
            if side.verge:
                strips.append((side.kerb, side.walk_from, grass, f.TERRAIN, 0.0))
            strips.append((side.front, side.front + 30, grass, f.TERRAIN, 0.01))
            for x0, x1, paint, label, drop in strips:
                size = (x1 - x0, 0.5 + KERB_M - drop, b - a)
                at = (side.sign * (x0 + x1) / 2, -0.5, (a + b) / 2)
                place([box(at, size, paint, label)], 0, 0)


def _grass_paint(rng: np.random.Generator) -> Paint:
    dry = rng.uniform(0, 1)
    bright = (0.34 + 0.2 * dry, 0.46 + 0.02 * dry, 0.16 + 0.08 * dry)
    return Paint(Material.GRASS, tuple(0.6 * c for c in bright), bright)


def _markings(rng: np.random.Generator, street: Street, half_lane: float, lanes_left: int) -> None:
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


def build_up(rng: np.random.Generator, street: Street) -> None:
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


def _plot(rng: np.random.Generator, street: Street, side: Side, z: float, length: float) -> None:
    """A house at the sidewalk, a house behind a garden, or open green."""
    share = {"city": (0.68, 0.26), "suburb": (0.12, 0.66), "avenue": (0.4, 0.4)}[street.style]
    kind = rng.random()
    middle = z + length / 2
    place = street.collector.place
    if kind < share[0]:
        tall = rng.uniform(8, 17) if street.style != "suburb" else rng.uniform(6, 9)
        house = f.building(rng, (12, tall, length), bool(rng.random() < 0.3))
        place(house, side.sign * (side.front + 6 + rng.uniform(0, 0.5)), middle, base_m=KERB_M)
        return
    _boundary(rng, street, side, z, length)
    if kind < share[0] + share[1]:
        depth, gap = rng.uniform(8, 11), rng.uniform(1, 4) if length > 9 else 0.0
        house = f.building(
            rng, (depth, rng.uniform(4.5, 8.5), length - gap), bool(rng.random() < 0.75)
        )
        set_back = rng.uniform(3, 7)
        place(house, side.sign * (side.front + set_back + depth / 2), middle, base_m=KERB_M - 0.02)
        if rng.random() < 0.5:
            x = side.sign * (side.front + rng.uniform(1.2, 2.2))
            place(
                f.bush(rng, rng.uniform(0.9, 1.6)),
                x,
                z + rng.uniform(1, length),
                base_m=KERB_M - 0.02,
            )
    else:
        for _ in range(int(rng.integers(1, 4))):
            x = side.sign * (side.front + rng.uniform(2.5, 14))
            place(
                f.tree(rng, rng.uniform(5, 10)), x, z + rng.uniform(0, length), base_m=KERB_M - 0.02
            )


def _boundary(
    rng: np.random.Generator, street: Street, side: Side, z: float, length: float
) -> None:
    """What separates private ground from the sidewalk: wall, fence, hedge or nothing."""
    make = rng.choice(4, p=[0.3, 0.4, 0.16, 0.14])
    if make == 3:
        return
    part = (f.wall, f.fence, f.hedge)[make](rng, length)
    x = side.sign * (side.front + (0.5 if make == 2 else 0.2))
    street.collector.place(part, x, z + length / 2, base_m=KERB_M - 0.02)


def _trees(rng: np.random.Generator, street: Street) -> None:
    chance = {"city": 0.3, "suburb": 0.5, "avenue": 0.95}[street.style]
    for side in street.sides:
        if rng.random() > chance:
            continue
        spacing, height = rng.uniform(8, 15), rng.uniform(5.5, 9)
        for z in np.arange(rng.uniform(4, 4 + spacing), 80, spacing):
            x = side.sign * (side.kerb + (side.verge / 2 if side.verge else 0.6))
            if street.along(z, 2) and street.claim(x, z, 0.8):
                tall = height * rng.uniform(0.85, 1.15)
                street.collector.place(f.tree(rng, tall), x, z, rng.uniform(0, 6), base_m=KERB_M)


def _far_end(rng: np.random.Generator, street: Street) -> None:
    """A house across the end of a closed street; distant trees, houses and hills otherwise."""
    place = street.collector.place
    if street.end_m is not None:
        z, x = street.end_m + 15, -60.0
        while x < 60:
            length = rng.uniform(12, 24)
            house = f.building(rng, (12, rng.uniform(8, 16), length), bool(rng.random() < 0.4))
            place(house, x + length / 2, z, np.pi / 2)
            x += length + (4.0 if rng.random() < 0.3 else 0.0)
        return
    for _ in range(int(rng.integers(4, 12))):
        x, z = rng.uniform(-60, 60), rng.uniform(150, 240)
        if abs(x) > 8:
            place(f.tree(rng, rng.uniform(8, 16)), x, z)
    for middle in range(-150, 150, 40):
        if rng.random() < 0.6:
            size = (rng.uniform(50, 90), rng.uniform(8, 24), 40)
            leaves = Paint(Material.FOLIAGE, (0.25, 0.36, 0.18), (0.14, 0.22, 0.1))
            place(
                [f.ball((0, 0, 0), size, leaves, f.VEGETATION)], middle + rng.uniform(-15, 15), 290
            )
