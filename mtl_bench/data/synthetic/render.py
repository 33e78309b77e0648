"""A scene and its frames: what to draw, then images, label ids, instance ids and depth.

Labels, instances and depth belong to the ray through a pixel's centre. Colour is the mean of four
rays a quarter of a pixel from it where these see different solids, and one sample of the (already
box-filtered) texture where they see the same.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic import shade, street, traffic
from mtl_bench.data.synthetic.camera import (
    Camera,
    FloatArray,
    Motion,
    Pose,
    draw_camera,
    draw_motion,
)
from mtl_bench.data.synthetic.cast import cast
from mtl_bench.data.synthetic.material import Markings
from mtl_bench.data.synthetic.primitives import (
    CYLINDER,
    ELLIPSOID,
    Solids,
    unit_frames,
    unit_normals,
)

RENDERER_VERSION = 6  # raised with every change of what is drawn
EGO, SKY = 1, 23
_DIVISOR = 1000


@dataclass(frozen=True)
class Scene:
    camera: Camera
    motion: Motion
    annotated: int
    solids: Solids
    markings: Markings
    shadows_S7: FloatArray
    light: shade.Light
    bonnet: tuple[float, float, float] | None  # edge, its drop to the sides (of H), shift (of W)
    bonnet_color_3: FloatArray

    def viewer(self, frame: int) -> Pose:
        """The camera for which a frame's texture is filtered: one for every seven frames.

        Texture that is filtered anew for every frame sharpens as it comes nearer, and then the same
        point has two colours. The annotated frame shares a filter with three frames on either side.
        Between two groups of a longer snippet true depth and motion explain nearly nothing.
        """
        shared = frame + 3 - (frame - self.annotated + 3) % 7
        return self.motion.poses[min(max(shared, 0), len(self.motion.poses) - 1)]


@dataclass(frozen=True)
class Truth:
    """What the centre rays saw."""

    index_HW: NDArray[np.int32]  # solid; -1 sky, -2 ego vehicle
    label_HW: NDArray[np.uint8]
    object_HW: NDArray[np.int64]  # number of the thing, 0 = none
    depth_HW: FloatArray  # metres; 0 = sky or ego vehicle
    moving_HW: NDArray[np.bool_]


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
    light = shade.draw_light(rng)
    bonnet = (rng.uniform(0.9, 0.955), rng.uniform(0.02, 0.07), rng.uniform(-0.03, 0.03))
    color = np.float32(rng.uniform(0.05, 0.5)) + rng.normal(0, 0.05, 3).astype(np.float32)
    place = street.plan(rng)
    street.build_up(rng, place)
    shadows = traffic.populate(rng, place, motion.step_m)
    return Scene(
        camera, motion, annotated, place.collector.solids(), place.markings,
        np.array(shadows, np.float32).reshape(-1, 7), light, None if on_roof else bonnet,
        color.clip(0.03, 0.6),
    )  # fmt: skip


def truth(scene: Scene, frame: int) -> Truth:
    """Labels and depth of a frame from the rays through its pixel centres."""
    camera, solids = scene.camera, scene.solids
    time = frame - scene.annotated
    u, v = _centres(camera)
    depth, index = cast(solids, camera, scene.motion.poses[frame], time, u, v)
    if scene.bonnet is not None:
        index[_bonnet(scene.bonnet, camera, u, v) >= 0] = -2
    label = solids.label_P[index].astype(np.uint8)
    label[index == -1], label[index == -2] = SKY, EGO
    things = np.where(index >= 0, solids.object_P[index], 0)
    moving = (index >= 0) & (np.abs(solids.velocity_P3[index]).sum(-1) > 0)
    return Truth(index, label, things, np.where(index >= 0, depth, 0).astype(np.float32), moving)


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


def image(scene: Scene, frame: int) -> NDArray[np.uint8]:
    """Colour image [H,W,3] RGB."""
    return (radiance(scene, frame) * 255 + 0.5).astype(np.uint8)


def radiance(scene: Scene, frame: int) -> FloatArray:
    """The image [H,W,3] before it is rounded to 8 bits: 0..1, display gamma."""
    camera, pose = scene.camera, scene.motion.poses[frame]
    height, width = camera.height, camera.width
    time = frame - scene.annotated
    quarter = np.array([-0.25, 0.25], np.float32)
    u, v = _centres(camera)
    u2, v2 = (u[:, None] + quarter).ravel(), (v[:, None] + quarter).ravel()
    depth, index = cast(scene.solids, camera, pose, time, u2, v2)
    surface = index * 4 + _faces(scene, frame, u2, v2, index, depth)
    blocks = surface.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    depths = depth.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    mixed = (blocks != blocks[..., :1]).any(-1)
    with np.errstate(divide="ignore"):
        middle = 4 / (1 / depths).sum(-1)  # exact for planes: inverse depth is linear in the image
    rows, cols = np.nonzero(~mixed)
    out = np.empty((height, width, 3), np.float32)
    out[rows, cols] = _colors(
        scene, frame, u[cols], v[rows], blocks[rows, cols, 0] >> 2, middle[rows, cols]
    )
    rows, cols = np.nonzero(mixed)
    if len(rows):
        du, dv = np.tile(quarter, 2), np.repeat(quarter, 2)
        us, vs = (u[cols, None] + du).ravel(), (v[rows, None] + dv).ravel()
        four = _colors(
            scene, frame, us, vs, blocks[rows, cols].ravel() >> 2, depths[rows, cols].ravel()
        )
        out[rows, cols] = four.reshape(-1, 4, 3).mean(1)
    if scene.bonnet is not None:
        _draw_bonnet(scene, out, _bonnet(scene.bonnet, camera, u, v))
    toned: FloatArray = np.clip(out, 0, 1) ** np.float32(0.9)
    return toned


def _centres(camera: Camera) -> tuple[FloatArray, FloatArray]:
    return np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32)


def _faces(
    scene: Scene, frame: int, u_W: FloatArray, v_H: FloatArray, index: NDArray, depth: FloatArray
) -> NDArray[np.int32]:
    """Which pair of faces of a box or cylinder a ray hits, 0..2; 0 for the round and the sky."""
    rows, cols = np.nonzero(index >= 0)
    hit = index[rows, cols]
    camera = scene.camera
    directions, origins = unit_frames(
        scene.solids, scene.motion.poses[frame], frame - scene.annotated
    )
    x = ((u_W - camera.u0) / camera.fx).astype(np.float32)[cols]
    y = ((v_H - camera.v0) / camera.fy).astype(np.float32)[rows]
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
    index_N: NDArray,
    depth_N: FloatArray,
) -> FloatArray:
    """Colours [N,3] of what the rays through (u, v) see at a known depth."""
    camera, pose = scene.camera, scene.motion.poses[frame]
    time = frame - scene.annotated
    x, y = (u_N - camera.u0) / camera.fx, (v_N - camera.v0) / camera.fy
    ray_c = np.stack([x, y, np.ones_like(x)], 1).astype(np.float32)
    ray = (pose.rotation_33.astype(np.float32)[None] * ray_c[:, None, :]).sum(2)
    out = np.empty((len(u_N), 3), np.float32)
    above = np.flatnonzero(index_N < 0)
    out[above] = shade.sky(scene.light, ray[above])
    s = np.flatnonzero(index_N >= 0)
    index, depth = index_N[s], depth_N[s]
    directions, origins = unit_frames(scene.solids, pose, time)
    unit = origins[index] + (directions[index] * ray_c[s][:, None, :]).sum(2) * depth[:, None]
    world = pose.position_3.astype(np.float32) + ray[s] * depth[:, None]
    shadows = scene.shadows_S7.copy()
    shadows[:, :2] += shadows[:, 5:7] * time
    flat = np.stack(
        [*shadows[:, :2].T, np.cos(shadows[:, 2]), np.sin(shadows[:, 2]), *shadows[:, 3:5].T], 1
    )
    out[s] = shade.surface(
        scene.solids, scene.light, scene.markings, flat, index, unit, world,
        scene.viewer(frame), 1 / camera.fx,
    )  # fmt: skip
    return out


def _bonnet(
    bonnet: tuple[float, float, float], camera: Camera, u: FloatArray, v: FloatArray
) -> FloatArray:
    """How far [H,W] below the bonnet's edge a pixel centre lies, in pixels; in every frame."""
    top, drop, shift = bonnet
    across = (u / camera.width - 0.5 - shift) * 2
    return v[:, None] - (top + drop * across[None] ** 2) * camera.height


def _draw_bonnet(scene: Scene, out: FloatArray, below: FloatArray) -> None:
    """Smooth paint that mirrors a little sky; its edge is anti-aliased, its mask is not."""
    share = np.clip(below + 0.5, 0, 1)[..., None]
    gloss = np.exp(-np.maximum(below, 0) / (0.03 * scene.camera.height))[..., None] * np.float32(
        0.35
    )
    color = scene.bonnet_color_3 * (scene.light.ambient_3 + 0.3) + gloss * scene.light.horizon_3
    out += (color - out) * share.astype(np.float32)
