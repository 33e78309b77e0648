"""The ordinary street around its features: moving and parked traffic, lamps and signs, walkers."""

import numpy as np

from mtl_bench.data.synthetic import furniture as f
from mtl_bench.data.synthetic import vehicles as v
from mtl_bench.data.synthetic.crowd import Crowd, Shadow
from mtl_bench.data.synthetic.features import FEATURES
from mtl_bench.data.synthetic.people import person
from mtl_bench.data.synthetic.street import Street


def populate(rng: np.random.Generator, street: Street, ego_step_m: float) -> list[Shadow]:
    """Fill a built street; returns the shadows."""
    crowd = Crowd(street, ego_step_m)
    _moving(rng, crowd)
    names = list(FEATURES)
    weights = np.array([FEATURES[n][0] for n in names])
    for name in rng.choice(
        names, size=int(rng.integers(7, 11)), replace=False, p=weights / weights.sum()
    ):
        for _ in range(4):  # the first free place
            if FEATURES[name][1](rng, crowd):
                break
    _parked(rng, crowd)
    _kerbside(rng, crowd)
    _walkers(rng, crowd)
    return crowd.shadows


def _any_vehicle(rng: np.random.Generator) -> v.Vehicle:
    make = rng.choice(4, p=[0.86, 0.08, 0.03, 0.03])
    return (v.car, v.truck, v.bus)[make](rng) if make < 3 else v.motorcycle(rng, False)


def _moving(rng: np.random.Generator, crowd: Crowd) -> None:
    street = crowd.street
    if street.tram_x is not None and rng.random() < 0.9:
        tram = v.tram(rng)
        z, away = rng.uniform(9, 28) + tram.length / 2, rng.random() < 0.4
        speed = 0.0 if rng.random() < 0.7 else rng.uniform(0.2, 0.6)
        crowd.vehicle(tram, street.tram_x, z, 0.0 if away else np.pi, speed)
    if rng.random() < 0.1:
        speed = crowd.ego_step_m * rng.uniform(0.85, 1.2)
        crowd.vehicle(
            v.car(rng), rng.normal(0, 0.15), rng.uniform(11, 32), rng.normal(0, 0.01), speed
        )
    for _ in range(int(rng.choice([0, 1, 2], p=[0.55, 0.33, 0.12]))):
        x = -street.right.lane_edge - rng.uniform(1.2, 1.6)
        crowd.vehicle(_any_vehicle(rng), x, rng.uniform(8, 55), np.pi, rng.uniform(0.25, 0.7))
    if street.crossing is not None and rng.random() < 0.5:
        a, b = street.crossing
        rightward = rng.random() < 0.5
        z = a + (b - a) * (0.72 if rightward else 0.28)
        yaw = np.pi / 2 if rightward else -np.pi / 2
        crowd.vehicle(_any_vehicle(rng), rng.uniform(-12, 12), z, yaw, rng.uniform(0, 0.5))


def _parked(rng: np.random.Generator, crowd: Crowd) -> None:
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


def _kerbside(rng: np.random.Generator, crowd: Crowd) -> None:
    """Lamps, signs and signals; bicycles against them."""
    street = crowd.street
    for side in street.sides:
        x, reach = side.sign * (side.kerb + 0.4), -side.sign * rng.uniform(1.2, 2.2)
        for z in np.arange(rng.uniform(5, 20), 90, rng.uniform(18, 30)):
            if street.along(z, 1):
                crowd.stand(f.lamp_post(rng, reach), x, z, 0, (0.2, 0.2), 0, 0.25, True)
        for _ in range(int(rng.integers(1, 4))):
            z = rng.uniform(8, 45)
            if street.along(z, 1):
                crowd.stand(f.traffic_sign(rng), x, z, rng.normal(0, 0.1), (0.2, 0.2), 0, 0.3, True)
        for _ in range(int(rng.integers(0, 4))):
            z = rng.uniform(9, 40)
            if street.along(z, 1):
                made = v.bicycle(rng, False)
                crowd.vehicle(made, x + side.sign * 0.4, z, rng.normal(0, 0.25), raised=True)
        if street.crossing is not None and rng.random() < 0.7:
            arm = -side.sign * (side.kerb - 0.5) if rng.random() < 0.5 else 0.0
            for z in (street.crossing[0] - 0.7, street.crossing[1] + 0.7):
                crowd.stand(f.traffic_light(rng, arm), x, z, 0, (0.2, 0.2), 0, 0.3, True)


def _walkers(rng: np.random.Generator, crowd: Crowd) -> None:
    street = crowd.street
    count = rng.poisson({"city": 7, "suburb": 3, "avenue": 4}[street.style])
    for _ in range(int(count)):
        side = street.right if rng.random() < 0.5 else street.left
        x = side.sign * rng.uniform(side.walk_from + 0.4, side.front - 0.3)
        z, yaw = rng.uniform(7, 45), rng.choice([0, np.pi]) + rng.normal(0, 0.2)
        if street.along(z, 0.5):
            crowd.stand(person(rng), x, z, yaw, (0.5, 0.5), 0.07 * (rng.random() < 0.7), 0.35, True)
