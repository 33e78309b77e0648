"""A scene and its frames: what to draw, then images, label ids, instance ids and depth.

Labels, instances and depth belong to the ray through a pixel's centre. Colour is the mean of four
rays a quarter of a pixel from it where these see different solids, and one sample of the (already
box-filtered) texture where they see the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.scenes import street
from mtl_bench.data.scenes.rays import (
    CYLINDER,
    ELLIPSOID,
    Camera,
    FloatArray,
    Motion,
    Pose,
    Solids,
    cast,
    draw_camera,
    draw_motion,
    unit_frames,
    unit_normals,
)
from mtl_bench.data.scenes.surfaces import (
    ALONG,
    FINE,
    LOOKS,
    NOISE,
    Markings,
    Material,
    Patch,
    fractal_noise,
    lattice_noise,
)

RENDERER_VERSION = 7  # raised with every change of what is drawn
EGO, SKY = 1, 23
_DIVISOR = 1000


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


@dataclass(frozen=True)
class Scene:
    camera: Camera
    motion: Motion
    annotated: int
    solids: Solids
    markings: Markings
    shadows_S7: FloatArray
    light: Light
    bonnet: tuple[float, float, float] | None  # edge, its drop to the sides (of H), shift (of W)
    bonnet_color_3: FloatArray

    def viewer(self, frame: int) -> Pose:
        """The camera for which a frame's texture is filtered: one for every nine frames.

        Texture that is filtered anew for every frame sharpens as it comes nearer, and then the same
        point has two colours. The annotated frame shares a filter with four frames on either side.
        Between two groups of a longer snippet true depth and motion explain nearly nothing.
        """
        shared = frame + 4 - (frame - self.annotated + 4) % 9
        return self.motion.poses[min(max(shared, 0), len(self.motion.poses) - 1)]

    def cast(
        self, frame: int, u_W: FloatArray, v_H: FloatArray
    ) -> tuple[FloatArray, NDArray[np.int32]]:
        """Depth and solid that the rays of these pixel columns and rows hit."""
        pose, time = self.motion.poses[frame], frame - self.annotated
        return cast(self.solids, self.camera, pose, time, u_W, v_H)


@dataclass(frozen=True)
class Truth:
    """What the centre rays saw."""

    index_HW: NDArray[np.int32]  # solid; -1 sky, -2 ego vehicle
    label_HW: NDArray[np.uint8]
    object_HW: NDArray[np.int64]  # number of the thing, 0 = none
    depth_HW: FloatArray  # metres; 0 = sky or ego vehicle


def draw_scene(
    seed: tuple[int, ...],
    height: int,
    width: int,
    frames: int,
    annotated: int,
    camera: Camera | None = None,
) -> Scene:
    """The street of one seed; the same street at every size.

    Args:
        camera: mounted on the roof; None: drawn, behind the windscreen, and sees the bonnet.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    on_roof = camera is not None
    camera = camera or draw_camera(rng, height, width)
    motion = draw_motion(np.random.default_rng([*seed, 1]), camera, frames, annotated)
    light = _draw_light(rng)
    bonnet = (rng.uniform(0.9, 0.955), rng.uniform(0.02, 0.07), rng.uniform(-0.03, 0.03))
    color = np.float32(rng.uniform(0.05, 0.5)) + rng.normal(0, 0.05, 3).astype(np.float32)
    place, shadows = street.draw_street(rng, motion.step_m)
    return Scene(
        camera, motion, annotated, place.collector.solids(), place.markings,
        np.array(shadows, np.float32).reshape(-1, 7), light, None if on_roof else bonnet,
        color.clip(0.03, 0.6),
    )  # fmt: skip


def _draw_light(rng: np.random.Generator) -> Light:
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

    def as_color(color: Sequence[float], factor: float = 1.0) -> NDArray[np.float32]:
        return np.array(color, np.float32) * np.float32(factor)

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


# --- truth ----------------------------------------------------------------------------------------


def truth(scene: Scene, frame: int) -> Truth:
    """Labels and depth of a frame from the rays through its pixel centres."""
    solids = scene.solids
    u, v = _centres(scene.camera)
    depth, index = scene.cast(frame, u, v)
    if scene.bonnet is not None:
        index[_below_bonnet(scene.bonnet, scene.camera) >= 0] = -2
    label = solids.label_P[index].astype(np.uint8)
    label[index == -1], label[index == -2] = SKY, EGO
    things = np.where(index >= 0, solids.object_P[index], 0)
    return Truth(index, label, things, np.where(index >= 0, depth, 0).astype(np.float32))


def normals(scene: Scene, frame: int, seen: Truth) -> FloatArray:
    """Unit normals [H,W,3] of a frame, x right, y down, z forward; 0 = sky or ego vehicle."""
    solids, pose, time = scene.solids, scene.motion.poses[frame], frame - scene.annotated
    rows, cols = np.nonzero(seen.index_HW >= 0)
    index, (u, v) = seen.index_HW[rows, cols], _centres(scene.camera)
    x, y = scene.camera.rays(u[cols], v[rows])
    point = np.stack([x, y, np.ones_like(x)], 1) * seen.depth_HW[rows, cols, None]
    directions, origins = unit_frames(solids, pose, time)
    unit = origins[index] + (directions[index] * point[:, None, :]).sum(2)
    face = unit_normals(solids.kind_P[index], unit, solids.taper_P3[index])
    # A plane's normal goes over from unit space to the camera's by the transpose of the way back.
    normal = (directions[index] * face[:, :, None]).sum(1)
    found = np.zeros((*seen.index_HW.shape, 3), np.float32)
    found[rows, cols] = normal / np.sqrt((normal * normal).sum(1, keepdims=True))
    return found


def instance_ids(seen: Truth, min_area: int) -> NDArray[np.uint16]:
    """Cityscapes' ids: label id, or label id * 1000 + number for a thing.

    A thing of which fewer than `min_area` pixels are seen could not be told from its neighbours by
    an annotator: like theirs it gets the bare label id, which means group (crowd).
    """
    ids = seen.label_HW.astype(np.uint16)
    counters: dict[int, int] = {}
    for number in np.unique(seen.object_HW):
        mask = seen.object_HW == number
        if number == 0 or mask.sum() < min_area:
            continue
        label = int(seen.label_HW[mask][0])
        ids[mask] = label * _DIVISOR + counters.setdefault(label, 0)
        counters[label] += 1
    return ids


# --- the image ------------------------------------------------------------------------------------


def image(scene: Scene, frame: int) -> NDArray[np.uint8]:
    """Colour image [H,W,3] RGB."""
    quarter = np.array([-0.25, 0.25], np.float32)
    u, v = _centres(scene.camera)
    u2, v2 = (u[:, None] + quarter).ravel(), (v[:, None] + quarter).ravel()
    depth, index = scene.cast(frame, u2, v2)
    faces = index * 4 + _faces(scene, frame, u2, v2, index, depth)
    blocks, depths = _blocks(faces), _blocks(depth)
    mixed = (blocks != blocks[..., :1]).any(-1)
    with np.errstate(divide="ignore"):
        middle = 4 / (1 / depths).sum(-1)  # exact for planes: inverse depth is linear in the image
    out = np.empty((*mixed.shape, 3), np.float32)
    i, j = np.nonzero(~mixed)
    out[i, j] = _colors(scene, frame, u[j], v[i], blocks[i, j, 0] >> 2, middle[i, j])
    i, j = np.nonzero(mixed)
    if len(i):
        us = (u[j, None] + np.tile(quarter, 2)).ravel()
        vs = (v[i, None] + np.repeat(quarter, 2)).ravel()
        four = _colors(scene, frame, us, vs, blocks[i, j].ravel() >> 2, depths[i, j].ravel())
        out[i, j] = four.reshape(-1, 4, 3).mean(1)
    if scene.bonnet is not None:
        _draw_bonnet(scene, out, _below_bonnet(scene.bonnet, scene.camera))
    toned = np.clip(out, 0, 1) ** np.float32(0.9)  # display gamma
    return (toned * 255 + 0.5).astype(np.uint8)


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """The 2x2 values of every pixel: [2 H,2 W] -> [H,W,4]."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return image.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)


def _centres(camera: Camera) -> tuple[FloatArray, FloatArray]:
    return np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)


def _faces(
    scene: Scene,
    frame: int,
    u_W: FloatArray,
    v_H: FloatArray,
    index: NDArray[Any],
    depth: FloatArray,
) -> NDArray[np.int32]:
    """Which pair of faces of a box or cylinder a ray hits, 0..2; 0 for the round and the sky."""
    rows, cols = np.nonzero(index >= 0)
    hit = index[rows, cols]
    pose, time = scene.motion.poses[frame], frame - scene.annotated
    directions, origins = unit_frames(scene.solids, pose, time)
    x, y = scene.camera.rays(u_W[cols], v_H[rows])
    t, m = depth[rows, cols], directions[hit]
    p = np.stack(
        [origins[hit, i] + (m[:, i, 0] * x + m[:, i, 1] * y + m[:, i, 2]) * t for i in range(3)], 1
    )
    kind = scene.solids.kind_P[hit]
    normal = np.abs(unit_normals(kind, p, scene.solids.taper_P3[hit]))
    face = normal.argmax(1)
    face[kind == CYLINDER] = normal[kind == CYLINDER, 1] > 0.5
    face[kind == ELLIPSOID] = 0
    out = np.zeros(index.shape, np.int32)
    out[rows, cols] = face
    return out


def _colors(
    scene: Scene,
    frame: int,
    u_N: FloatArray,
    v_N: FloatArray,
    index_N: NDArray[Any],
    depth_N: FloatArray,
) -> FloatArray:
    """Colours [N,3] of what the rays through (u, v) see at a known depth."""
    pose, time = scene.motion.poses[frame], frame - scene.annotated
    x, y = scene.camera.rays(u_N, v_N)
    ray_c = np.stack([x, y, np.ones_like(x)], 1)
    ray = (pose.rotation_33.astype(np.float32)[None] * ray_c[:, None, :]).sum(2)
    out = np.empty((len(u_N), 3), np.float32)
    above = np.flatnonzero(index_N < 0)
    out[above] = _sky(scene.light, ray[above])
    s = np.flatnonzero(index_N >= 0)
    index, depth = index_N[s], depth_N[s]
    directions, origins = unit_frames(scene.solids, pose, time)
    unit = origins[index] + (directions[index] * ray_c[s][:, None, :]).sum(2) * depth[:, None]
    world = pose.position_3.astype(np.float32) + ray[s] * depth[:, None]
    out[s] = _surface(scene, frame, index, unit, world)
    return out


def _sky(light: Light, direction_N3: FloatArray) -> FloatArray:
    """Colour of the sky along world directions: a gradient with soft clouds, nothing fine."""
    d = direction_N3 / np.sqrt((direction_N3**2).sum(1, keepdims=True))
    rise = np.clip(-d[:, 1] * 2.2, 0, 1)[:, None]
    color = light.horizon_3 + (light.zenith_3 - light.horizon_3) * np.sqrt(rise)
    flat = d / (np.abs(d[:, 1:2]) + 0.25) * np.float32(1.6) + np.float32(light.seed)
    puffs = lattice_noise(flat) + 0.5 * lattice_noise(flat * 2.3)
    share = np.clip(puffs * 0.9 + light.cloud - 0.35, 0, 1)[:, None] * np.sqrt(rise) * 0.8
    white = np.array([0.95, 0.95, 0.96], np.float32) * light.horizon_3.max()
    found: FloatArray = color + (white - color) * share
    return found


def _surface(
    scene: Scene, frame: int, index_N: NDArray[Any], unit_N3: FloatArray, world_N3: FloatArray
) -> FloatArray:
    """Colours [N,3] of surface points given in unit and world space."""
    solids, light, viewer = scene.solids, scene.light, scene.viewer(frame)
    away = world_N3 - viewer.position_3.astype(np.float32)
    ahead = (away * viewer.rotation_33[:, 2].astype(np.float32)).sum(1)
    depth_N = np.maximum(ahead, np.float32(0.4))
    face = unit_normals(solids.kind_P[index_N], unit_N3, solids.taper_P3[index_N])
    half = solids.half_P3.astype(np.float32)[index_N]
    local = face / half
    turn = solids.rotation_P33.astype(np.float32)[index_N]
    normal = (turn * local[:, None, :]).sum(2)
    normal /= np.sqrt((normal * normal).sum(1, keepdims=True))
    length = np.sqrt((away * away).sum(1))
    facing = np.clip(-(normal * away).sum(1) / length, 0.02, 1)
    footprint = depth_N * np.float32(1 / scene.camera.fx)
    stretched = footprint / facing
    p = unit_N3 * half
    material = solids.material_P[index_N]
    shift = (index_N.astype(np.float32) * np.float32(1.37))[:, None]
    fixed = np.isin(material, (Material.ASPHALT, Material.PAVING, Material.GRASS))[:, None]
    along = ALONG[material]
    points = np.where(fixed, world_N3, p + shift)
    points[:, 2] *= along
    blur = FINE[material] * np.maximum(footprint, along * stretched)
    noise = fractal_noise(points, NOISE[material], blur)
    albedo = np.empty_like(p)
    for m in np.unique(material):
        s = np.flatnonzero(material == m)
        look, solid = LOOKS[Material(m)], index_N[s]
        albedo[s] = look.albedo(Patch(
            p[s], half[s], face[s], world_N3[s], look.filter_px * footprint[s],
            look.filter_px * stretched[s], solids.color_P3[solid], solids.color2_P3[solid],
            solids.params_P4[solid], noise[s], scene.markings,
        ))  # fmt: skip
    albedo *= np.clip(1 + 0.75 * noise, 0.25, 1.9)[:, None]
    shade = np.clip((normal * light.sun_3).sum(1), 0, 1)[:, None]
    sky_share = 0.72 - 0.28 * normal[:, 1:2]  # surfaces that look up see more of the sky
    contact = _contact(scene, frame, world_N3, footprint, stretched)[:, None]
    color = albedo * (light.ambient_3 * sky_share + light.sun_color_3 * shade) * contact
    air = 1 - np.exp(-depth_N / np.float32(light.haze_m))[:, None]
    found: FloatArray = color + (light.horizon_3 * 0.9 - color) * air
    return found


def _contact(
    scene: Scene, frame: int, world_N3: FloatArray, wide_N: FloatArray, long_N: FloatArray
) -> FloatArray:
    """Darkening of the ground under vehicles and people, 1 = none; soft, and softer than a pixel.

    wide_N and long_N: metres that the pixel covers across and along the view.
    """
    dark = np.ones(len(world_N3), np.float32)
    ground = np.flatnonzero(world_N3[:, 1] > -0.2)
    x, z = world_N3[ground, 0], world_N3[ground, 2]
    wide, long = 1.5 * wide_N[ground], 1.5 * long_N[ground]
    factor = np.ones(len(ground), np.float32)
    time = frame - scene.annotated
    for x0, z0, yaw, hx, hz, vx, vz in scene.shadows_S7:
        dx, dz, c, s = x - (x0 + vx * time), z - (z0 + vz * time), np.cos(yaw), np.sin(yaw)
        blur_x, blur_z = 0.15 + abs(c) * wide + abs(s) * long, 0.15 + abs(s) * wide + abs(c) * long
        a, b = (c * dx - s * dz) / (hx + blur_x), (s * dx + c * dz) / (hz + blur_z)
        depth = hx * hz / ((hx + blur_x) * (hz + blur_z))
        q = np.clip(1.25 - 0.6 * (a * a + b * b), 0, 1)
        factor *= 1 - np.float32(0.75) * depth * q * q * (3 - 2 * q)
    dark[ground] = np.maximum(factor, 0.25)
    return dark


def _below_bonnet(bonnet: tuple[float, float, float], camera: Camera) -> FloatArray:
    """How far [H,W] below the bonnet's edge a pixel centre lies, in pixels; in every frame."""
    top, drop, shift = bonnet
    u, v = _centres(camera)
    across = (u / camera.width - 0.5 - shift) * 2
    return v[:, None] - (top + drop * across[None] ** 2) * camera.height


def _draw_bonnet(scene: Scene, out: FloatArray, below: FloatArray) -> None:
    """Smooth paint that mirrors a little sky; its edge is anti-aliased, its mask is not."""
    share = np.clip(below + 0.5, 0, 1)[..., None]
    gloss = np.exp(-np.maximum(below, 0) / (0.03 * scene.camera.height))[..., None]
    light, sheen = scene.light, gloss * np.float32(0.35)
    color = scene.bonnet_color_3 * (light.ambient_3 + 0.3) + sheen * light.horizon_3
    out += (color - out) * share.astype(np.float32)
