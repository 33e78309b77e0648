"""Light and colour: from what a ray hit to what the camera records."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic.camera import FloatArray, Pose
from mtl_bench.data.synthetic.material import Markings, Material, Patch
from mtl_bench.data.synthetic.noise import fractal_noise, lattice_noise
from mtl_bench.data.synthetic.primitives import Solids, unit_normals
from mtl_bench.data.synthetic.texture import ALONG, FILTER_PX, FINE, OCTAVES, PATCHES


@dataclass(frozen=True)
class Light:
    """One weather and time of day."""

    sun_3: FloatArray  # unit vector towards the sun (y down)
    sun_color_3: FloatArray
    ambient_3: FloatArray
    zenith_3: FloatArray  # sky colours
    horizon_3: FloatArray
    cloud: float  # 0..1
    haze_m: float  # distance at which 1 - 1/e of the light comes from the air
    seed: float


def draw_light(rng: np.random.Generator) -> Light:
    """Clear, overcast or late afternoon, with a sun that is never behind a wall of its own."""
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 1.1)
    sun = [np.cos(height) * np.sin(azimuth), -np.sin(height), np.cos(height) * np.cos(azimuth)]
    weather = rng.choice(3, p=[0.45, 0.35, 0.2])
    strength = (rng.uniform(0.65, 0.85), rng.uniform(0.1, 0.25), rng.uniform(0.6, 0.75))[weather]
    tint = ((1.0, 0.96, 0.88), (1.0, 1.0, 1.0), (1.0, 0.82, 0.6))[weather]
    ambient = ((0.5, 0.54, 0.6), (0.76, 0.78, 0.8), (0.5, 0.48, 0.52))[weather]
    zenith = ((0.3, 0.5, 0.85), (0.72, 0.75, 0.8), (0.45, 0.55, 0.8))[weather]
    horizon = ((0.75, 0.85, 0.97), (0.86, 0.87, 0.88), (0.98, 0.86, 0.72))[weather]
    exposure = rng.uniform(0.78, 1.12)
    as_color = lambda c, k=1.0: np.array(c, np.float32) * np.float32(k)  # noqa: E731
    return Light(
        sun_3=as_color(sun),
        sun_color_3=as_color(tint, strength * exposure),
        ambient_3=as_color(ambient, exposure),
        zenith_3=as_color(zenith, rng.uniform(0.85, 1.05)),
        horizon_3=as_color(horizon, rng.uniform(0.9, 1.0)),
        cloud=(rng.uniform(0, 0.8), rng.uniform(0.1, 0.4), rng.uniform(0.2, 0.8))[weather],
        haze_m=rng.uniform(250, 900),
        seed=rng.uniform(0, 30),
    )


def sky(light: Light, direction_N3: FloatArray) -> FloatArray:
    """Colour of the sky along world directions: a gradient with soft clouds, nothing fine."""
    d = direction_N3 / np.sqrt((direction_N3**2).sum(1, keepdims=True))
    rise = np.clip(-d[:, 1] * 2.2, 0, 1)[:, None]
    color = light.horizon_3 + (light.zenith_3 - light.horizon_3) * np.sqrt(rise)
    flat = d / (np.abs(d[:, 1:2]) + 0.25) * np.float32(1.6) + np.float32(light.seed)
    puffs = lattice_noise(flat) + 0.5 * lattice_noise(flat * 2.3)
    share = np.clip(puffs * 0.9 + light.cloud - 0.35, 0, 1)[:, None] * np.sqrt(rise) * 0.8
    white = np.array([0.95, 0.95, 0.96], np.float32) * light.horizon_3.max()
    return color + (white - color) * share


def surface(
    solids: Solids,
    light: Light,
    markings: Markings,
    shadows: FloatArray,
    index_N: NDArray,
    unit_N3: FloatArray,
    world_N3: FloatArray,
    viewer: Pose,
    pixel_rad: float,
) -> FloatArray:
    """Colours [N,3] of surface points given in unit and world space.

    Args:
        shadows: [S,6] of dark patches under things: x, z, cos and sin of the yaw, half sizes.
        viewer: the camera for which texture is filtered.
        pixel_rad: size of a pixel at unit depth.
    """
    away = world_N3 - viewer.position_3.astype(np.float32)
    ahead = (away * viewer.rotation_33[:, 2].astype(np.float32)).sum(1)
    depth_N = np.maximum(ahead, np.float32(0.4))
    kind = solids.kind_P[index_N]
    face = unit_normals(kind, unit_N3, solids.taper_P3[index_N])
    half = solids.half_P3.astype(np.float32)[index_N]
    local = face / half
    turn = solids.rotation_P33.astype(np.float32)[index_N]
    normal = (turn * local[:, None, :]).sum(2)
    normal /= np.sqrt((normal * normal).sum(1, keepdims=True))
    length = np.sqrt((away * away).sum(1))
    facing = np.clip(-(normal * away).sum(1) / length, 0.02, 1)
    footprint = depth_N * np.float32(pixel_rad)
    stretched = footprint / facing
    p = unit_N3 * half
    material = solids.material_P[index_N]
    shift = (index_N.astype(np.float32) * np.float32(1.37))[:, None]
    fixed = np.isin(material, (Material.ASPHALT, Material.PAVING, Material.GRASS))[:, None]
    along = ALONG[material]
    points = np.where(fixed, world_N3, p + shift)
    points[:, 2] *= along
    noise = fractal_noise(
        points, OCTAVES[material], FINE[material] * np.maximum(footprint, along * stretched)
    )
    albedo = np.empty_like(p)
    for m in np.unique(material):
        s = np.flatnonzero(material == m)
        blur = FILTER_PX[m]
        patch = Patch(
            p[s],
            half[s],
            face[s],
            world_N3[s],
            blur * footprint[s],
            blur * stretched[s],
            solids.color_P3[index_N[s]],
            solids.color2_P3[index_N[s]],
            solids.params_P4[index_N[s]],
            noise[s],
            markings,
        )
        albedo[s] = PATCHES[Material(m)][0](patch)
    albedo *= np.clip(1 + 0.75 * noise, 0.25, 1.9)[:, None]
    shade = np.clip((normal * light.sun_3).sum(1), 0, 1)[:, None]
    sky_share = 0.72 - 0.28 * normal[:, 1:2]  # surfaces that look up see more of the sky
    contact = _contact(shadows, world_N3, footprint, stretched)[:, None]
    color = albedo * (light.ambient_3 * sky_share + light.sun_color_3 * shade) * contact
    air = 1 - np.exp(-depth_N / np.float32(light.haze_m))[:, None]
    return color + (light.horizon_3 * 0.9 - color) * air


def _contact(
    shadows: FloatArray, world_N3: FloatArray, wide_N: FloatArray, long_N: FloatArray
) -> FloatArray:
    """Darkening of the ground under vehicles and people, 1 = none; soft, and softer than a pixel.

    wide_N and long_N: metres that the pixel covers across and along the view.
    """
    dark = np.ones(len(world_N3), np.float32)
    ground = np.flatnonzero(world_N3[:, 1] > -0.2)
    x, z = world_N3[ground, 0], world_N3[ground, 2]
    wide, long = 1.5 * wide_N[ground], 1.5 * long_N[ground]
    factor = np.ones(len(ground), np.float32)
    for sx, sz, c, s, hx, hz in shadows:
        dx, dz = x - sx, z - sz
        blur_x, blur_z = 0.15 + abs(c) * wide + abs(s) * long, 0.15 + abs(s) * wide + abs(c) * long
        a, b = (c * dx - s * dz) / (hx + blur_x), (s * dx + c * dz) / (hz + blur_z)
        depth = hx * hz / ((hx + blur_x) * (hz + blur_z))
        q = np.clip(1.25 - 0.6 * (a * a + b * b), 0, 1)
        factor *= 1 - np.float32(0.75) * depth * q * q * (3 - 2 * q)
    dark[ground] = np.maximum(factor, 0.25)
    return dark
