"""The ego camera, the solids, and which solid each of the camera's rays hits first.

World and camera axes: x right, y down, z forward; the road's surface is y = 0. Pixel centres are
integers, so the ray of pixel (u, v) is ((u - u0) / fx, (v - v0) / fy, 1), and the distance along it
is the depth z itself. At the annotated frame the camera stands at x = 0, z = 0.

Every solid is a *unit* solid seen through an affine map: the box [-1,1]^3, the cylinder of radius 1
around y, the unit ball. Rays are taken into that unit space, where the distance along a ray is the
same. Solids lie in the world as arrays over P, rays are N or a grid of [H,W].
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]  # float32 wherever there is one value a ray
DoubleArray = NDArray[np.float64]
BOX, TAPERED, CYLINDER, ELLIPSOID = range(4)
NEAR_M = 0.1
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1])
_SMALL = 600  # rays; up to here the cost of a call outweighs that of the pairs


# --- the camera -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    height: int  # pixels
    width: int
    fx: float
    fy: float
    u0: float
    v0: float
    mount_m: float  # above the road
    level: bool = False  # mounted without pitch: only the suspension adds some

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x and y of the rays through pixel columns u and rows v."""
        x, y = (u - self.u0) / self.fx, (v - self.v0) / self.fy
        return x.astype(np.float32), y.astype(np.float32)


@dataclass(frozen=True)
class Pose:
    """Camera to world: X_world = rotation_33 X_camera + position_3."""

    position_3: DoubleArray
    rotation_33: DoubleArray

    @property
    def matrix_44(self) -> DoubleArray:
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation_33
        matrix[:3, 3] = self.position_3
        return matrix


@dataclass(frozen=True)
class Motion:
    """What the car does during a snippet, per frame."""

    step_m: float
    yaw_step_rad: float  # positive turns right
    poses: tuple[Pose, ...]
    pitch_rad: float  # at the annotated frame, positive looks down


def rotation(yaw_rad: float, pitch_rad: float) -> DoubleArray:
    """Yaw to the right about y, after pitch downwards about x: [3,3], local to outer axes."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    yaw = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    found: DoubleArray = yaw @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    return found


def draw_camera(rng: np.random.Generator, height: int, width: int) -> Camera:
    focal = width * rng.uniform(0.86, 0.94)
    return Camera(
        height=height,
        width=width,
        fx=focal,
        fy=focal * rng.uniform(0.995, 1.005),
        u0=(width - 1) / 2 + width * rng.uniform(-0.02, 0.02),
        v0=(height - 1) / 2 + height * rng.uniform(-0.04, 0.04),
        mount_m=rng.uniform(1.2, 1.6),
    )


def draw_motion(rng: np.random.Generator, camera: Camera, frames: int, annotated: int) -> Motion:
    """Drive forward with nearly constant speed and turn rate; suspension adds some pitch."""
    step_m, yaw_step = rng.uniform(0.65, 1.1), rng.normal(0, 0.0025)
    heading, base_pitch = rng.normal(0, 0.015), rng.normal(0.012, 0.008)
    steps_m = step_m * (1 + rng.normal(0, 0.02, frames))
    yaws = heading + yaw_step * (np.arange(frames) - annotated) + rng.normal(0, 0.0004, frames)
    pitches = (0 if camera.level else base_pitch) + rng.normal(0, 0.0008, frames)
    ahead = np.stack([np.sin(yaws), np.zeros(frames), np.cos(yaws)], 1)
    along = np.cumsum(ahead * steps_m[:, None], 0)
    places = along - along[annotated] - [0, camera.mount_m, 0]
    poses = (Pose(places[i], rotation(yaws[i], pitches[i])) for i in range(frames))
    return Motion(step_m, yaw_step, tuple(poses), float(pitches[annotated]))


def context_from_target(target: Pose, context: Pose) -> DoubleArray:
    """[4,4] T with X_context = T X_target, both in camera axes, metres."""
    return np.linalg.inv(context.matrix_44) @ target.matrix_44


# --- solids ---------------------------------------------------------------------------------------

Point = tuple[float, float, float]


class Paint(NamedTuple):
    """What a surface looks like; `material` is one of `surfaces.Material`."""

    material: int
    color: tuple[float, ...] = (0.5, 0.5, 0.5)
    color2: tuple[float, ...] = (0.5, 0.5, 0.5)
    params: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)


class Part(NamedTuple):
    """One solid in its object's axes: x right, y down (0 = the ground), z forward; metres."""

    kind: int
    center: Point
    half: Point
    paint: Paint
    label: int
    rotation: DoubleArray | None = None  # part to object
    taper: Point = (0.0, 0.0, 0.0)  # shrinking of the top: sides, front, rear


def box(at: Point, size: Point, paint: Paint, label: int, taper: Point = (0.0, 0.0, 0.0)) -> Part:
    """A box by the middle of its base (x, height, z) and its full width, height and length."""
    (x, base, z), (w, h, length) = at, size
    kind = TAPERED if any(taper) else BOX
    return Part(kind, (x, -base - h / 2, z), (w / 2, h / 2, length / 2), paint, label, None, taper)


def ball(at: Point, size: Point, paint: Paint, label: int) -> Part:
    """An ellipsoid by its middle (x, height, z) and its full width, height and length."""
    (x, middle, z), (w, h, length) = at, size
    return Part(ELLIPSOID, (x, -middle, z), (w / 2, h / 2, length / 2), paint, label)


def rod(start: Point, end: Point, radius: float, paint: Paint, label: int) -> Part:
    """A cylinder between two points (x, height, z)."""
    a, b = np.array(start) * [1, -1, 1], np.array(end) * [1, -1, 1]
    length = float(np.sqrt(((b - a) ** 2).sum()))
    i, j, k = ((b - a) / length).tolist()
    p, q, r = (j, -i, 0.0) if abs(k) < 0.9 else (0.0, k, -j)  # axis x (0, 0, 1) or (1, 0, 0)
    n = (p * p + q * q + r * r) ** 0.5
    p, q, r = p / n, q / n, r / n
    other = (q * k - r * j, r * i - p * k, p * j - q * i)  # side x axis
    turned = np.array([(p, i, other[0]), (q, j, other[1]), (r, k, other[2])])
    half = (radius, length / 2, radius)
    x, y, z = ((a + b) / 2).tolist()
    return Part(CYLINDER, (x, y, z), half, paint, label, turned)


@dataclass
class Solids:
    """Arrays over P solids; what the caster and the shader read."""

    kind_P: NDArray[np.int64]
    center_P3: DoubleArray
    half_P3: DoubleArray
    rotation_P33: DoubleArray  # local to world
    taper_P3: FloatArray
    velocity_P3: DoubleArray  # metres per frame
    label_P: NDArray[np.int64]
    object_P: NDArray[np.int64]  # 0 = no thing; every thing has its own number
    material_P: NDArray[np.int64]
    color_P3: FloatArray
    color2_P3: FloatArray
    params_P4: FloatArray


@dataclass
class Collector:
    """Objects in, `Solids` out."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    objects: int = 0

    def place(
        self,
        parts: list[Part],
        x: float,
        z: float,
        yaw_rad: float = 0.0,
        velocity: tuple[float, float] = (0.0, 0.0),
        base_m: float = 0.0,
        things: frozenset[int] = frozenset(),
    ) -> None:
        """Stand an object on the ground; each label among `things` becomes one instance of it."""
        turn = rotation(yaw_rad, 0.0)
        numbers = {}
        for part in parts:
            if part.label in things and part.label not in numbers:
                self.objects += 1
                numbers[part.label] = self.objects
            local = np.eye(3) if part.rotation is None else part.rotation
            center = turn @ part.center + [x, -base_m, z]
            moving, number = (velocity[0], 0.0, velocity[1]), numbers.get(part.label, 0)
            self.rows.append((part, center, turn @ local, moving, number))

    def solids(self) -> Solids:
        parts, centers, rotations, velocities, objects = zip(*self.rows, strict=True)
        return Solids(
            kind_P=np.array([p.kind for p in parts]),
            center_P3=np.array(centers),
            half_P3=np.array([p.half for p in parts], np.float64),
            rotation_P33=np.array(rotations),
            taper_P3=np.array([p.taper for p in parts], np.float32),
            velocity_P3=np.array(velocities),
            label_P=np.array([p.label for p in parts]),
            object_P=np.array(objects),
            material_P=np.array([p.paint.material for p in parts]),
            color_P3=np.array([p.paint.color for p in parts], np.float32),
            color2_P3=np.array([p.paint.color2 for p in parts], np.float32),
            params_P4=np.array([p.paint.params for p in parts], np.float32),
        )


def unit_frames(solids: Solids, pose: Pose, time: int) -> tuple[FloatArray, FloatArray]:
    """Camera rays to unit space: direction matrices [P,3,3] and ray origins [P,3].

    `time` counts frames from the annotated one, when every moving solid is at its `center_P3`.
    """
    inverse_P33 = solids.rotation_P33.transpose(0, 2, 1) / solids.half_P3[:, :, None]
    away_P3 = pose.position_3 - (solids.center_P3 + solids.velocity_P3 * time)
    # sums written out: a BLAS product could round differently from machine to machine
    direction = (inverse_P33[:, :, :, None] * pose.rotation_33[None, None]).sum(2)
    origin = (inverse_P33 * away_P3[:, None, :]).sum(2)
    return direction.astype(np.float32), origin.astype(np.float32)


def screen_bounds(
    solids: Solids, pose: Pose, camera: Camera, time: int
) -> tuple[FloatArray, FloatArray]:
    """Per solid [P,4] the image box (u_min, u_max, v_min, v_max; pixels), and its nearest depth.

    Empty (u_max < u_min) for what lies behind the camera. Boxes that reach behind it are clipped.
    """
    centers = solids.center_P3 + solids.velocity_P3 * time - pose.position_3
    corners = _CORNERS[:, None, :] * solids.half_P3[:, None, None, :]
    world_P83 = (solids.rotation_P33[:, None] * corners).sum(-1) + centers[:, None]
    points = (world_P83[..., None] * pose.rotation_33[None, None]).sum(2)
    a, b = points[:, _EDGES[:, 0]], points[:, _EDGES[:, 1]]
    crosses = (a[..., 2] < NEAR_M) != (b[..., 2] < NEAR_M)
    share = (NEAR_M - a[..., 2]) / np.where(crosses, b[..., 2] - a[..., 2], 1.0)
    cut = a + share[..., None] * (b - a)
    points = np.concatenate([points, cut], 1)
    seen = np.concatenate([points[:, :8, 2] >= NEAR_M, crosses], 1)
    z = np.where(seen, points[..., 2], 1.0)
    bounds = []
    for axis, focal, origin in ((0, camera.fx, camera.u0), (1, camera.fy, camera.v0)):
        pixel = points[..., axis] / z * focal + origin
        bounds += [np.where(seen, pixel, np.inf).min(1), np.where(seen, pixel, -np.inf).max(1)]
    nearest = np.where(seen, points[..., 2], np.inf).min(1)
    return np.stack(bounds, 1), nearest.astype(np.float32)


# --- rays in unit space: origin o and direction d as three broadcastable arrays -> depth ----------


Rays = tuple[Any, Any, Any]  # three arrays that broadcast against each other


def hit(kind: int, o: Rays, d: Rays, taper: Rays) -> FloatArray:
    """Depth at which rays enter the unit solid; infinite where they miss or start inside."""
    if kind == BOX:
        enter, leave = _slab(o[0], d[0])
        for axis in (1, 2):
            near, far = _slab(o[axis], d[axis])
            enter, leave = np.maximum(enter, near), np.minimum(leave, far)
    elif kind == TAPERED:
        enter, leave = _tapered(o, d, taper)
    else:
        across = (0, 2) if kind == CYLINDER else (0, 1, 2)
        a = sum(d[i] * d[i] for i in across)
        b = sum(o[i] * d[i] for i in across)
        c = sum(o[i] * o[i] for i in across) - 1
        root = np.sqrt(b * b - a * c)  # not a number where the ray misses: no comparison holds
        enter, leave = (-b - root) / a, (root - b) / a
        if kind == CYLINDER:
            near, far = _slab(o[1], d[1])
            enter, leave = np.maximum(enter, near), np.minimum(leave, far)
    return np.where((enter <= leave) & (enter > NEAR_M), enter, np.float32(np.inf))


def _slab(o: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    inverse = 1 / d
    middle, half = o * inverse, np.abs(inverse)
    return -middle - half, half - middle


def _tapered(o: Rays, d: Rays, taper: Rays) -> tuple[FloatArray, FloatArray]:
    """Six half-spaces n.p <= c; the four sides lean inwards, as y = -1 is the top."""
    enter, leave = _slab(o[1], d[1])
    sides, front, rear = (k / 2 for k in taper)
    for axis, sign, lean in ((0, 1, sides), (0, -1, sides), (2, 1, front), (2, -1, rear)):
        slope = sign * d[axis] - lean * d[1]
        t = (1 - lean - sign * o[axis] + lean * o[1]) / slope
        enter = np.maximum(enter, np.where(slope < 0, t, -np.inf).astype(np.float32))
        leave = np.minimum(leave, np.where(slope > 0, t, np.inf).astype(np.float32))
    return enter, leave


def unit_normals(kind: NDArray[Any], p: FloatArray, taper: FloatArray) -> FloatArray:
    """Outward normals [N,3] in unit space at surface points p [N,3] of solids of mixed kinds."""
    normal = p.copy()  # ellipsoid
    flat = np.flatnonzero(kind == BOX)
    axis = np.abs(p[flat]).argmax(1)
    normal[flat] = 0
    normal[flat, axis] = np.sign(p[flat, axis])
    lean = kind == TAPERED
    normal[lean] = _tapered_normals(p[lean], taper[lean] / 2)
    tube = kind == CYLINDER
    q = p[tube] * np.array([1, 0, 1], np.float32)
    cap = (q * q).sum(1) < 0.998 * p[tube, 1] ** 2
    q[cap] = np.sign(p[tube][cap]) * np.array([0, 1, 0], np.float32)
    normal[tube] = q
    return normal


def _tapered_normals(q: FloatArray, lean: FloatArray) -> FloatArray:
    normals = np.zeros((6, *q.shape), np.float32)
    limit = np.ones((6, len(q)), np.float32)
    normals[0, :, 1], normals[1, :, 1] = 1, -1
    for i, (axis, sign, which) in enumerate(((0, 1, 0), (0, -1, 0), (2, 1, 1), (2, -1, 2)), 2):
        normals[i, :, axis], normals[i, :, 1] = sign, -lean[:, which]
        limit[i] -= lean[:, which]
    nearest = ((normals * q).sum(2) - limit).argmax(0)
    found: FloatArray = normals[nearest, np.arange(len(q))]
    return found


_SMALL = 600  # rays; up to here the cost of a call outweighs that of the pairs


# --- the first hit --------------------------------------------------------------------------------


def cast(
    solids: Solids, camera: Camera, pose: Pose, time: int, u_W: FloatArray, v_H: FloatArray
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Cast the rays of the pixel columns u_W and rows v_H (any fractions, evenly spaced, rising).

    Solids with a large image box are tested one by one on that box, as broadcast rows and columns;
    the many small ones (wheels, legs, far things) together, as one flat list of (solid, ray) pairs.

    Returns depth [H,W] in metres (inf = sky) and the index of the solid hit (-1 = sky).
    """
    directions, origins = unit_frames(solids, pose, time)
    bounds, nearest = screen_bounds(solids, pose, camera, time)
    c0, c1 = _range(bounds[:, 0], bounds[:, 1], u_W)
    r0, r1 = _range(bounds[:, 2], bounds[:, 3], v_H)
    area = np.maximum(c1 - c0, 0) * np.maximum(r1 - r0, 0)
    x, y = camera.rays(u_W, v_H)
    depth = np.full((len(v_H), len(u_W)), np.inf, np.float32)
    index = np.full(depth.shape, -1, np.int32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in np.flatnonzero(area > _SMALL)[np.argsort(nearest[area > _SMALL], kind="stable")]:
            window = slice(r0[i], r1[i]), slice(c0[i], c1[i])
            xs, ys = x[None, window[1]], y[window[0], None]
            d = tuple(m[0] * xs + (m[1] * ys + m[2]) for m in directions[i])
            t = hit(solids.kind_P[i], tuple(origins[i]), d, tuple(solids.taper_P3[i]))
            better = t < depth[window]
            depth[window][better] = t[better]
            index[window][better] = i
        for kind in range(BOX, ELLIPSOID + 1):
            few = np.flatnonzero((area > 0) & (area <= _SMALL) & (solids.kind_P == kind))
            if len(few):
                solid, row, col = _pairs(few, r0[few], c0[few], c1[few] - c0[few], area[few])
                m, xs, ys = directions[solid], x[col], y[row]
                d = tuple(m[:, j, 0] * xs + (m[:, j, 1] * ys + m[:, j, 2]) for j in range(3))
                t = hit(kind, tuple(origins[solid].T), d, tuple(solids.taper_P3[solid].T))
                _keep_nearest(depth, index, solid, row * len(u_W) + col, t)
    return depth, index


def _range(
    low: FloatArray, high: FloatArray, samples: FloatArray
) -> tuple[NDArray[Any], NDArray[Any]]:
    """First and one-past-last sample inside [low, high], a little widened against rounding."""
    step = float(samples[1] - samples[0]) if len(samples) > 1 else 1.0
    limit = len(samples)
    first = np.clip(np.ceil((low - samples[0]) / step - 0.01), 0, limit)
    last = np.clip(np.floor((high - samples[0]) / step + 0.01) + 1, 0, limit)
    return first.astype(np.int64), last.astype(np.int64)


def _pairs(
    solids: NDArray[Any], r0: NDArray[Any], c0: NDArray[Any], wide: NDArray[Any], area: NDArray[Any]
) -> tuple[NDArray[Any], ...]:
    """All (solid, row, column) of image boxes given by corner, width and area, as flat arrays."""
    which = np.repeat(np.arange(len(solids)), area)
    within = np.arange(len(which)) - np.repeat(np.cumsum(area) - area, area)
    row, col = np.divmod(within, wide[which])
    return solids[which], row + r0[which], col + c0[which]


def _keep_nearest(
    depth: FloatArray, index: NDArray[Any], solid: NDArray[Any], ray: NDArray[Any], t: FloatArray
) -> None:
    """Put the nearest of several hits of a ray into the flat views of depth and index."""
    flat_depth, flat_index = depth.reshape(-1), index.reshape(-1)
    better = np.flatnonzero(t < flat_depth[ray])
    order = better[np.argsort(-t[better], kind="stable")]  # of equal indices the last one stays
    flat_depth[ray[order]] = t[order]
    flat_index[ray[order]] = solid[order]
