"""Metres for a depth that has none: the camera's true height over the one that the road implies.

Batched tensor code. Camera axes: x right, y down, z forward; a ray is a pixel's point at depth 1.
Shapes: B images, H x W pixels, P = H * W after subsampling.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

DGC_SOURCES = ("road", "normals", "failed")  # meaning of dgc_scale's codes
ROAD, NORMALS, FAILED = range(3)
GRID = 2**12  # pixels that depth scaling looks at; a larger map is subsampled
BELOW_HORIZON = 0.25  # ground pixels are this far down between the optical axis and the last row
MIN_GROUND = 0.005  # share of the pixels; with fewer the estimate is not tried
MAX_TILT = math.tan(math.radians(3.5))  # of the camera to the road; Cityscapes' is up to 0.05 rad
FLAT = math.cos(math.radians(5))  # ground by normals: nearer to vertical than this (MGNet's value)
REWEIGHTINGS = 10


def dgc_scale(
    depth_B1HW: Tensor,
    K_B33: Tensor,
    camera_height_m_B: Tensor,
    road_BHW: Tensor | None,
    max_tilt: float = 0.0,
    pitch_rad_B: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Factor [B] from depth to metres, and where it came from [B] (an index into DGC_SOURCES).

    Dense geometrical constraint (Xue et al., IROS 2020; MGNet, section 3.4): the true height of the
    camera over the median height that the predicted road implies, n . X for points X of the road.
    Where the mask of the road is absent or too small, pixels whose surface is horizontal and below
    the camera stand in; where there are too few of those too, the factor is NaN: count it.

    Departs from the paper in the normal n. Its normals come from neighbouring pixels of each point
    and are biased by noise (5 % of noise shift the height by a tenth or more), least squares on
    n . X = 1 likewise. Here n is one for the image: straight down by the camera's calibrated pitch.
    With `max_tilt` it is tilted further, as far as the ground's inverse depth says (linear in the
    pixel for a plane, so that noise averages out): exact on a plane within that tilt where the
    pitch is not known, but a prediction that bends the road pulls it off, so it is off by default.
    Only pixels well below the optical axis count (BELOW_HORIZON): near the horizon a small tilt
    changes the height many times over.

    Args:
        depth_B1HW: any unit.
        K_B33: intrinsics in pixels of that map.
        camera_height_m_B: above the road.
        road_BHW: bool, predicted; None without a panoptic task.
        max_tilt: tangent of the largest pitch and roll to look for; 0 = none; try MAX_TILT.
        pitch_rad_B: the calibrated pitch to start from, positive looks down; None = level.
    """
    step = math.ceil(math.sqrt(depth_B1HW.shape[2] * depth_B1HW.shape[3] / GRID))
    # ONNX Runtime lacks some operators in double precision
    dtype = torch.float32 if torch.compiler.is_exporting() else torch.float64
    depth_BHW = depth_B1HW[:, 0, ::step, ::step].to(dtype)
    ray_x_BHW, ray_y_BHW = _rays(depth_BHW, K_B33.to(dtype), step)
    usable_BHW = (depth_BHW > 0) & depth_BHW.isfinite() & (ray_y_BHW > 0)
    usable_BHW &= ray_y_BHW > BELOW_HORIZON * ray_y_BHW[:, -1:, :]

    flat_BHW = _horizontal(depth_BHW, ray_x_BHW, ray_y_BHW) & usable_BHW
    least = MIN_GROUND * depth_BHW[0].numel()
    has_flat_B = flat_BHW.sum((1, 2)) >= max(least, 3)
    ground_BHW, has_road_B = flat_BHW, torch.zeros_like(has_flat_B)
    if road_BHW is not None:
        road_BHW = road_BHW[:, ::step, ::step] & usable_BHW
        has_road_B = road_BHW.sum((1, 2)) >= max(least, 3)
        by_road_B11 = has_road_B[:, None, None]
        ground_BHW = (by_road_B11 & road_BHW) | (~by_road_B11 & flat_BHW)

    pitch_B11 = torch.zeros_like(depth_BHW[:, :1, :1])
    if pitch_rad_B is not None:
        pitch_B11 = pitch_rad_B.to(depth_BHW)[:, None, None]
    down_BHW = ray_y_BHW * pitch_B11.cos() + pitch_B11.sin()
    ground_BHW = ground_BHW & (down_BHW > 0)
    height_B = _height(depth_BHW, ray_x_BHW, down_BHW, ground_BHW, max_tilt, pitch_B11[:, :, 0])
    source_B = torch.where(has_road_B, ROAD, torch.where(has_flat_B, NORMALS, FAILED))
    source_B = torch.where((height_B > 0) & height_B.isfinite(), source_B, FAILED)
    scale_B = camera_height_m_B.to(dtype) / height_B
    return scale_B.masked_fill(source_B == FAILED, torch.nan).to(depth_B1HW.dtype), source_B


def _rays(depth_BHW: Tensor, K_B33: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """x and y of the points at depth 1 that pixels of a map subsampled by `step` see."""
    _, height, width = depth_BHW.shape
    y = torch.arange(height, device=depth_BHW.device, dtype=depth_BHW.dtype) * step
    x = torch.arange(width, device=depth_BHW.device, dtype=depth_BHW.dtype) * step
    fx, fy, cx, cy = (K_B33[:, i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    ray_x_BHW, ray_y_BHW = (x - cx) / fx, (y[:, None] - cy) / fy
    return ray_x_BHW.expand_as(depth_BHW), ray_y_BHW.expand_as(depth_BHW)


def _height(
    depth_BHW: Tensor,
    ray_x_BHW: Tensor,
    down_BHW: Tensor,
    ground_BHW: Tensor,
    max_tilt: float,
    pitch_B1: Tensor,
) -> Tensor:
    """Median height [B] of the camera above the ground pixels; NaN without any.

    `down` is the ray's part along g, straight down for a camera of the calibrated pitch.
    """
    flat = depth_BHW.flatten(1).shape
    ground_BP = ground_BHW.reshape(flat)
    down_BP = torch.where(ground_BP, down_BHW.reshape(flat), 1)
    depth_BP = torch.where(ground_BP, depth_BHW.reshape(flat), torch.inf)
    median_B = _median(depth_BP * down_BP, ground_BP)  # the height, were there no tilt
    if max_tilt == 0:
        return median_B
    x_BP = torch.where(ground_BP, ray_x_BHW.reshape(flat), 0)
    p_B1, q_B1 = _tilt(depth_BP * down_BP / median_B[:, None], x_BP, down_BP, ground_BP, max_tilt)
    length_B1 = (1 + p_B1**2 + q_B1**2 + 2 * q_B1 * pitch_B1.sin()).sqrt()
    return _median(depth_BP * (p_B1 * x_BP + down_BP + q_B1) / length_B1, ground_BP)


def _median(value_BP: Tensor, counts_BP: Tensor) -> Tensor:
    """The lower median [B] of what counts, NaN where nothing does; the rest has to be inf.

    torch.nanmedian cannot be exported.
    """
    count_B1 = counts_BP.sum(1, keepdim=True)
    median_B1 = value_BP.sort(1).values.gather(1, (count_B1 - 1).clamp(min=0) // 2)
    return torch.where(count_B1 > 0, median_B1, torch.nan)[:, 0]


def _tilt(
    level_BP: Tensor, x_BP: Tensor, down_BP: Tensor, ground_BP: Tensor, max_tilt: float
) -> tuple[Tensor, Tensor]:
    """Tangents p and q [B,1] of the ground's roll and pitch against g.

    With n = (g + p x + q z) / |.| a plane has 1 / (depth * down) = c (1 + p ray_x / down + q /
    down): a regression whose noise is alike everywhere. Least absolute deviations, by reweighting.
    `level` is depth * down in units of its median, which scales the regression.
    """
    inverse_BP = torch.nan_to_num(1 / level_BP)
    basis_B3P = torch.stack([torch.ones_like(x_BP), x_BP / down_BP, 1 / down_BP], 1)
    basis_B3P = basis_B3P * ground_BP[:, None]
    weight_BP = ground_BP.to(level_BP)
    ridge = 1e-12 * torch.eye(3, device=x_BP.device, dtype=x_BP.dtype)
    for _ in range(REWEIGHTINGS):
        weighted_B3P = basis_B3P * weight_BP[:, None]
        normal_B33 = weighted_B3P @ basis_B3P.mT
        right_B31 = weighted_B3P @ inverse_BP[:, :, None]
        damping = ridge * normal_B33.diagonal(dim1=1, dim2=2).clamp(min=1e-9)[:, None]
        solution_B31 = torch.linalg.solve_ex(normal_B33 + damping, right_B31).result
        residual_BP = (inverse_BP - (basis_B3P * solution_B31).sum(1)).abs()
        weight_BP = ground_BP / residual_BP.clamp(min=1e-4)

    slope_B, tilt_x_B, tilt_z_B = solution_B31.squeeze(2).unbind(1)
    sound_B = slope_B > 0.1  # of about 1; otherwise there is no ground in this depth: no tilt
    p_B = torch.where(sound_B, tilt_x_B / slope_B, 0).clamp(-max_tilt, max_tilt)
    q_B = torch.where(sound_B, tilt_z_B / slope_B, 0).clamp(-max_tilt, max_tilt)
    return p_B[:, None], q_B[:, None]


def _horizontal(depth_BHW: Tensor, ray_x_BHW: Tensor, ray_y_BHW: Tensor) -> Tensor:
    """Where the surface is horizontal [B,H,W], from the slopes of smoothed inverse depth.

    A plane's inverse depth is linear in the ray, with the normal as its coefficients; a 5 x 5 mean
    keeps it exactly. The outer two pixels have no full window and are never ground.
    """
    if min(depth_BHW.shape[1:]) < 7:
        return torch.zeros_like(depth_BHW, dtype=torch.bool)
    inverse_BHW = 1 / depth_BHW.clamp(min=1e-6)
    inverse_BHW = F.avg_pool2d(inverse_BHW[:, None], 5, stride=1)[:, 0]
    x_BHW, y_BHW = ray_x_BHW[:, 2:-2, 2:-2], ray_y_BHW[:, 2:-2, 2:-2]
    slope_y, slope_x = torch.gradient(inverse_BHW, dim=(1, 2))
    slope_x = slope_x / (x_BHW[:, :1, 1:2] - x_BHW[:, :1, :1])
    slope_y = slope_y / (y_BHW[:, 1:2, :1] - y_BHW[:, :1, :1])
    slope_z = inverse_BHW - slope_x * x_BHW - slope_y * y_BHW
    length = (slope_x**2 + slope_y**2 + slope_z**2).sqrt()
    return F.pad(slope_y > FLAT * length, (2, 2, 2, 2), value=False)
