"""The ego camera: intrinsics, and where it stands and looks in every frame.

World and camera axes: x right, y down, z forward; the road's surface is y = 0. Pixel centres are
integers, so the ray of pixel (u, v) is ((u - u0) / fx, (v - v0) / fy, 1), and the distance along it
is the depth z itself. At the annotated frame the camera stands at x = 0, z = 0.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]  # float32 wherever there is one value a ray
DoubleArray = NDArray[np.float64]
BASELINE_M = (
    0.22  # as in Cityscapes; half a disparity step is < 2 % of the depth at 80 m from 32x64 on
)
FRAMES_PER_S = 17.0


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
    return yaw @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


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
    along = np.cumsum(
        np.stack([np.sin(yaws), np.zeros(frames), np.cos(yaws)], 1) * steps_m[:, None], 0
    )
    places = along - along[annotated] - [0, camera.mount_m, 0]
    poses = (Pose(places[i], rotation(yaws[i], pitches[i])) for i in range(frames))
    return Motion(step_m, yaw_step, tuple(poses), float(pitches[annotated]))


def context_from_target(target: Pose, context: Pose) -> DoubleArray:
    """[4,4] T with X_context = T X_target, both in camera axes, metres."""
    return np.linalg.inv(context.matrix_44) @ target.matrix_44
