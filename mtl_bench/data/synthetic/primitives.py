"""Solids that a ray can hit: boxes, tapered boxes, cylinders and ellipsoids, anywhere, any way up.

Every solid is a *unit* solid seen through an affine map: the box [-1,1]^3, the cylinder of radius 1
around y, the unit ball. Rays are taken into that unit space; the distance along a ray (the camera
depth, as its camera z is 1) is the same in both.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic.camera import Camera, DoubleArray, FloatArray, Pose, rotation

BOX, TAPERED, CYLINDER, ELLIPSOID = range(4)
NEAR_M = 0.1
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1])


class Paint(NamedTuple):
    """What a surface looks like; `material` is one of `material.Material`."""

    material: int
    color: tuple[float, ...] = (0.5, 0.5, 0.5)
    color2: tuple[float, ...] = (0.5, 0.5, 0.5)
    params: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)


class Part(NamedTuple):
    """One solid in its object's axes: x right, y down (0 = the ground), z forward; metres."""

    kind: int
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    paint: Paint
    label: int
    rotation: DoubleArray | None = None  # part to object
    taper: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shrinking of the top: sides, front, rear


Point = tuple[float, float, float]


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

    rows: list[tuple] = field(default_factory=list)
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
            self.rows.append(
                (
                    part,
                    center,
                    turn @ local,
                    (velocity[0], 0.0, velocity[1]),
                    numbers.get(part.label, 0),
                )
            )

    def solids(self) -> Solids:
        parts = [row[0] for row in self.rows]
        return Solids(
            kind_P=np.array([p.kind for p in parts]),
            center_P3=np.array([row[1] for row in self.rows]),
            half_P3=np.array([p.half for p in parts], np.float64),
            rotation_P33=np.array([row[2] for row in self.rows]),
            taper_P3=np.array([p.taper for p in parts], np.float32),
            velocity_P3=np.array([row[3] for row in self.rows]),
            label_P=np.array([p.label for p in parts]),
            object_P=np.array([row[4] for row in self.rows]),
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
    spokes = solids.rotation_P33[:, None] * (
        _CORNERS[:, None, :] * solids.half_P3[:, None, None, :]
    )
    world_P83 = spokes.sum(-1) + centers[:, None]
    points = (world_P83[..., None] * pose.rotation_33[None, None]).sum(2)
    a, b = points[:, _EDGES[:, 0]], points[:, _EDGES[:, 1]]
    crosses = (a[..., 2] < NEAR_M) != (b[..., 2] < NEAR_M)
    share = (NEAR_M - a[..., 2]) / np.where(crosses, b[..., 2] - a[..., 2], 1.0)
    cut = a + share[..., None] * (b - a)
    points = np.concatenate([points, cut], 1)
    seen = np.concatenate([points[:, :8, 2] >= NEAR_M, crosses], 1)
    z = np.where(seen, points[..., 2], 1.0)
    u = points[..., 0] / z * camera.fx + camera.u0
    v = points[..., 1] / z * camera.fy + camera.v0
    low, high = (
        (np.where(seen, q, np.inf).min(1) for q in (u, v)),
        (np.where(seen, q, -np.inf).max(1) for q in (u, v)),
    )
    (u_min, v_min), (u_max, v_max) = low, high
    nearest = np.where(seen, points[..., 2], np.inf).min(1)
    return np.stack([u_min, u_max, v_min, v_max], 1), nearest.astype(np.float32)


# --- rays in unit space: origin o and direction d as three broadcastable arrays -> depth ----


def hit(kind: int, o: tuple, d: tuple, taper: tuple) -> FloatArray:
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


def _slab(o, d):
    inverse = 1 / d
    middle, half = o * inverse, np.abs(inverse)
    return -middle - half, half - middle


def _tapered(o, d, taper):
    """Six half-spaces n.p <= c; the four sides lean inwards, as y = -1 is the top."""
    enter, leave = _slab(o[1], d[1])
    sides, front, rear = (k / 2 for k in taper)
    for axis, sign, lean in ((0, 1, sides), (0, -1, sides), (2, 1, front), (2, -1, rear)):
        slope = sign * d[axis] - lean * d[1]
        t = (1 - lean - sign * o[axis] + lean * o[1]) / slope
        enter = np.maximum(enter, np.where(slope < 0, t, -np.inf).astype(np.float32))
        leave = np.minimum(leave, np.where(slope > 0, t, np.inf).astype(np.float32))
    return enter, leave


def unit_normals(kind: NDArray, p: FloatArray, taper: FloatArray) -> FloatArray:
    """Outward normals [N,3] in unit space at surface points p [N,3] of solids of mixed kinds."""
    normal = p.copy()  # ellipsoid
    flat = kind == BOX
    q = p[flat]
    axis = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    faces = np.zeros_like(q)
    faces[rows, axis] = np.sign(q[rows, axis])
    normal[flat] = faces
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
    return normals[nearest, np.arange(len(q))]
