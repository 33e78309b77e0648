"""From the network's outputs to instances and metres: grouping, majority vote, depth scaling.

Batched tensor code without loops over instances; CPU and CUDA run the same lines.
Shapes: B images, C classes, K centers of the image that has most, N pixels of things, H x W pixels.
Panoptic id: class index * 1000 + instance; instance 0 for stuff, VOID where nothing is predicted.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench import config
from mtl_bench.data.labels import IGNORE, LabelSet
from mtl_bench.model.network import Outputs

DIVISOR = 1000
VOID = -1
CHUNK = 2**22  # distances held at once: 16 MiB
CPU_CHUNK = 2**17  # what a core's cache holds

DGC_SOURCES = ("road", "normals", "failed")  # meaning of dgc_scale's codes
ROAD, NORMALS, FAILED = range(3)
GRID = 2**16  # pixels that depth scaling looks at; a larger map is subsampled
BELOW_HORIZON = 0.25  # ground pixels are this far down between the optical axis and the last row
MIN_GROUND = 0.005  # share of the pixels; with fewer the estimate is not tried
MAX_TILT = math.tan(math.radians(3.5))  # of the camera to the road; Cityscapes' is up to 0.05 rad
FLAT = math.cos(math.radians(5))  # ground by normals: nearer to vertical than this (MGNet's value)
REWEIGHTINGS = 20


def resize(outputs: Outputs, height: int, width: int) -> Outputs:
    """Outputs at another size: bilinear, corners not aligned, depth as inverse depth.

    Offsets are pixels, so they are scaled as well (MGNet's public code leaves them).
    """

    def to(x: Tensor) -> Tensor:
        return F.interpolate(x.float(), (height, width), mode="bilinear", align_corners=False)

    semantic, center, offset = outputs.semantic_BCHW, outputs.center_B1HW, outputs.offset_B2HW
    if offset is not None:
        rows, columns = offset.shape[2:]
        factor = offset.new_tensor([height / rows, width / columns]).view(1, 2, 1, 1)
        offset = to(offset) * factor
    return Outputs(
        semantic_BCHW=None if semantic is None else to(semantic),
        center_B1HW=None if center is None else to(center),
        offset_B2HW=offset,
        inverse_depth=[to(inverse) for inverse in outputs.inverse_depth],
    )


# --- instances ------------------------------------------------------------------------------------


def panoptic(
    semantic: Tensor,
    center_B1HW: Tensor,
    offset_B2HW: Tensor,
    things: tuple[int, ...],
    ev: config.Evaluate,
) -> Tensor:
    """Panoptic ids [B,H,W], int64: every thing pixel joins the center that it points nearest to.

    Panoptic-DeepLab's grouping (Cheng et al., CVPR 2020) with MGNet's numbering: centers count from
    1 in reading order over all classes, and an instance takes the class that most of its pixels
    have (ties: the lowest). Ties of distance go to the first center. In an image without a center,
    thing pixels keep instance 0. Stuff classes of fewer than `ev.stuff_area` pixels become void.

    Args:
        semantic: logits [B,C,H,W] or class indices [B,H,W] (IGNORE becomes void).
        center_B1HW: heat map.
        offset_B2HW: (y, x) from each pixel to its center, pixels.
        things: class indices.
        ev: `center_threshold` (strict), `nms_kernel`, `top_k` and `stuff_area` are used.
    """
    class_BHW = semantic.argmax(1) if semantic.dim() == 4 else semantic.long()
    centers_BK2, count_B = find_centers(center_B1HW, ev)
    result_BHW = class_BHW * DIVISOR
    result_BHW = _drop_small_stuff(result_BHW, class_BHW, things, ev.stuff_area)

    is_thing_BHW = _member(class_BHW, things)
    image_N, y_N, x_N = (is_thing_BHW & (count_B > 0)[:, None, None]).nonzero(as_tuple=True)
    if len(image_N) == 0:
        return result_BHW
    offset_2N = offset_B2HW.float()[image_N, :, y_N, x_N].T
    target_N2 = torch.stack([y_N + offset_2N[0], x_N + offset_2N[1]], 1)
    nearest_N = _nearest(target_N2, image_N, centers_BK2)

    # One vote per pixel: a table instance x class, filled by a single count
    order = torch.tensor(sorted(things), device=class_BHW.device)
    vote_N = torch.searchsorted(order, class_BHW[image_N, y_N, x_N])
    instance_N = image_N * centers_BK2.shape[1] + nearest_N
    cells = centers_BK2.shape[0] * centers_BK2.shape[1] * len(order)
    votes = torch.bincount(instance_N * len(order) + vote_N, minlength=cells).view(-1, len(order))
    winner_N = order[votes.argmax(1)][instance_N]
    result_BHW[image_N, y_N, x_N] = winner_N * DIVISOR + nearest_N + 1
    return result_BHW


def find_centers(center_B1HW: Tensor, ev: config.Evaluate) -> tuple[Tensor, Tensor]:
    """Local maxima above the threshold: (y, x) [B,K,2], filled up with inf; counts [B].

    In reading order. Where there are more than `ev.top_k`, the highest stay; of equals, the first.
    Equal neighbours are both centers: of two true instances closer than the kernel neither is lost.
    """
    kernel = ev.nms_kernel
    if kernel % 2 == 0:
        raise ValueError(f"evaluate.nms_kernel must be odd, not {kernel}")
    heat_B1HW = center_B1HW.float()
    is_peak_B1HW = (heat_B1HW == _highest(heat_B1HW, kernel)) & (heat_B1HW > ev.center_threshold)
    image_P, _, y_P, x_P = is_peak_B1HW.nonzero(as_tuple=True)

    images = heat_B1HW.shape[0]
    found_B = torch.bincount(image_P, minlength=images)
    first_B = found_B.cumsum(0) - found_B
    by_height = heat_B1HW[image_P, 0, y_P, x_P].sort(descending=True, stable=True).indices
    by_image = by_height[image_P[by_height].sort(stable=True).indices]
    place_P = torch.arange(len(image_P), device=image_P.device)
    rank_P = torch.empty_like(place_P).scatter_(0, by_image, place_P - first_B[image_P])
    kept_P = rank_P < ev.top_k
    image_P, y_P, x_P = image_P[kept_P], y_P[kept_P], x_P[kept_P]

    count_B = torch.bincount(image_P, minlength=images)
    number_P = torch.arange(len(image_P), device=image_P.device)
    number_P = number_P - (count_B.cumsum(0) - count_B)[image_P]
    centers_BK2 = heat_B1HW.new_full((images, int(count_B.max()), 2), torch.inf)
    centers_BK2[image_P, number_P] = torch.stack([y_P, x_P], 1).to(centers_BK2)
    return centers_BK2, count_B


def to_instance_ids(panoptic_BHW: Tensor, labels: LabelSet) -> Tensor:
    """Cityscapes' ids, int32: label id, or label id * 1000 + instance; 0 for what is not evaluated.

    A thing pixel without an instance keeps its bare label id: one segment of its class.
    """
    table = [label.label_id if label.evaluated else 0 for label in labels.labels]
    label_of_class = torch.tensor([*table, 0], device=panoptic_BHW.device)
    instance_BHW = panoptic_BHW % DIVISOR
    index_BHW = torch.where(panoptic_BHW == VOID, len(labels), panoptic_BHW // DIVISOR)
    label_BHW = label_of_class[index_BHW]
    numbered_BHW = (instance_BHW > 0) & (label_BHW > 0)
    return torch.where(numbered_BHW, label_BHW * DIVISOR + instance_BHW, label_BHW).int()


def _highest(x_B1HW: Tensor, kernel: int) -> Tensor:
    """Maximum of the window around each pixel: of its rows, then of those."""
    rows_B1HW = F.max_pool2d(x_B1HW, (1, kernel), stride=1, padding=(0, kernel // 2))
    return F.max_pool2d(rows_B1HW, (kernel, 1), stride=1, padding=(kernel // 2, 0))


def _nearest(target_N2: Tensor, image_N: Tensor, centers_BK2: Tensor) -> Tensor:
    """Index [N] of the nearest center of the pixel's image; pixels come image by image."""
    chunk = CPU_CHUNK if target_N2.device.type == "cpu" else CHUNK
    size = max(chunk // centers_BK2.shape[1], 1)
    pixels = torch.bincount(image_N, minlength=len(centers_BK2)).tolist()
    parts = []
    for target_P2, center_K2 in zip(target_N2.split(pixels), centers_BK2, strict=True):
        for target_p2 in target_P2.split(size):
            distance_pK = (target_p2[:, :1] - center_K2[:, 0]).square_()
            distance_pK += (target_p2[:, 1:] - center_K2[:, 1]).square_()
            parts.append(distance_pK.argmin(1))
    return torch.cat(parts)


def _member(class_BHW: Tensor, classes: tuple[int, ...]) -> Tensor:
    table = torch.zeros(IGNORE + 1, dtype=torch.bool, device=class_BHW.device)
    table[list(classes)] = True
    return table[class_BHW]


def _drop_small_stuff(
    result_BHW: Tensor, class_BHW: Tensor, things: tuple[int, ...], least: int
) -> Tensor:
    """Void where there is no class, and where a stuff class covers too little of its image."""
    images = torch.arange(len(class_BHW), device=class_BHW.device)[:, None, None]
    row_BHW = images * (IGNORE + 1) + class_BHW
    area = torch.bincount(row_BHW.flatten(), minlength=len(class_BHW) * (IGNORE + 1))
    drop = (area < least).view(len(class_BHW), IGNORE + 1)
    drop[:, list(things)] = False
    drop[:, IGNORE] = True
    return result_BHW.masked_fill(drop.flatten()[row_BHW], VOID)


# --- metres ---------------------------------------------------------------------------------------


def dgc_scale(
    depth_B1HW: Tensor,
    K_B33: Tensor,
    camera_height_m_B: Tensor,
    road_BHW: Tensor | None,
    max_tilt: float = MAX_TILT,
    pitch_rad_B: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Factor [B] from depth to metres, and where it came from [B] (an index into DGC_SOURCES).

    Dense geometrical constraint (Xue et al., IROS 2020; MGNet, section 3.4): the true height of the
    camera over the median height that the predicted road implies, n . X for points X of the road.
    Where the mask of the road is absent or too small, pixels whose surface is horizontal and below
    the camera stand in; where there are too few of those too, the factor is NaN: count it.

    Departs from the paper in the normal n. Its normals come from neighbouring pixels of each point
    and are biased by noise (5 % of noise shift the height by a tenth or more), least squares on
    n . X = 1 likewise. Here n is one for the image: a level camera's (0, 1, 0), tilted as far as
    the ground's inverse depth says (linear in the pixel for a plane, so that noise averages out),
    but at most by `max_tilt`. Exact on a plane within that tilt. Only pixels well below the optical
    axis count (BELOW_HORIZON): near the horizon a small tilt changes the height many times over.

    Args:
        depth_B1HW: any unit.
        K_B33: intrinsics in pixels of that map.
        camera_height_m_B: above the road.
        road_BHW: bool, predicted; None without a panoptic task.
        max_tilt: tangent of the largest pitch and roll to look for; 0 = none.
        pitch_rad_B: the calibrated pitch to start from, positive looks down; None = level.
    """
    step = math.ceil(math.sqrt(depth_B1HW.shape[2] * depth_B1HW.shape[3] / GRID))
    depth_BHW = depth_B1HW[:, 0, ::step, ::step].double()
    ray_x_BHW, ray_y_BHW = _rays(depth_BHW, K_B33.double(), step)
    usable_BHW = (depth_BHW > 0) & depth_BHW.isfinite() & (ray_y_BHW > 0)
    usable_BHW &= ray_y_BHW > BELOW_HORIZON * ray_y_BHW[:, -1:, :]

    flat_BHW = _horizontal(depth_BHW, ray_x_BHW, ray_y_BHW) & usable_BHW
    least = MIN_GROUND * depth_BHW[0].numel()
    has_flat_B = flat_BHW.sum((1, 2)) >= max(least, 3)
    ground_BHW, has_road_B = flat_BHW, torch.zeros_like(has_flat_B)
    if road_BHW is not None:
        road_BHW = road_BHW[:, ::step, ::step] & usable_BHW
        has_road_B = road_BHW.sum((1, 2)) >= max(least, 3)
        ground_BHW = torch.where(has_road_B[:, None, None], road_BHW, flat_BHW)

    pitch_B11 = torch.zeros_like(depth_BHW[:, :1, :1])
    if pitch_rad_B is not None:
        pitch_B11 = pitch_rad_B.to(depth_BHW)[:, None, None]
    down_BHW = ray_y_BHW * pitch_B11.cos() + pitch_B11.sin()
    ground_BHW = ground_BHW & (down_BHW > 0)
    height_B = _height(depth_BHW, ray_x_BHW, down_BHW, ground_BHW, max_tilt, pitch_B11[:, :, 0])
    source_B = torch.where(has_road_B, ROAD, torch.where(has_flat_B, NORMALS, FAILED))
    source_B = torch.where((height_B > 0) & height_B.isfinite(), source_B, FAILED)
    scale_B = camera_height_m_B.double() / height_B
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

    `down` is the ray's part along g, straight down for a camera of the calibrated pitch. With
    n = (g + p x + q z) / |.| a plane has 1 / (depth * down) = c (1 + p ray_x / down + q / down): a
    regression whose noise is alike everywhere. Least absolute deviations, by reweighting.
    """
    flat = depth_BHW.flatten(1).shape
    ground_BP = ground_BHW.reshape(flat)
    x_BP = torch.where(ground_BP, ray_x_BHW.reshape(flat), 0)
    y_BP = torch.where(ground_BP, down_BHW.reshape(flat), 1)
    depth_BP = torch.where(ground_BP, depth_BHW.reshape(flat), torch.nan)
    level_BP = depth_BP * y_BP  # the height, were there no tilt
    median_B1 = level_BP.nanmedian(1, keepdim=True).values
    inverse_BP = torch.nan_to_num(median_B1 / level_BP)  # about 1, which scales the regression
    basis_B3P = torch.stack([torch.ones_like(y_BP), x_BP / y_BP, 1 / y_BP], 1) * ground_BP[:, None]

    weight_BP = ground_BP.to(depth_BP)
    ridge = 1e-12 * torch.eye(3, device=depth_BP.device, dtype=depth_BP.dtype)
    for _ in range(REWEIGHTINGS):
        weighted_B3P = basis_B3P * weight_BP[:, None]
        normal_B33 = weighted_B3P @ basis_B3P.mT
        right_B31 = weighted_B3P @ inverse_BP[:, :, None]
        damping = ridge * normal_B33.diagonal(dim1=1, dim2=2).clamp(min=1e-9)[:, None]
        solution_B31 = torch.linalg.solve(normal_B33 + damping, right_B31)
        residual_BP = (inverse_BP - (basis_B3P * solution_B31).sum(1)).abs()
        weight_BP = ground_BP / residual_BP.clamp(min=1e-4)

    slope_B, tilt_x_B, tilt_z_B = solution_B31.squeeze(2).unbind(1)
    sound_B = slope_B > 0.1  # of about 1; otherwise there is no ground in this depth: no tilt
    p_B1 = torch.where(sound_B, tilt_x_B / slope_B, 0).clamp(-max_tilt, max_tilt)[:, None]
    q_B1 = torch.where(sound_B, tilt_z_B / slope_B, 0).clamp(-max_tilt, max_tilt)[:, None]
    length_B1 = (1 + p_B1**2 + q_B1**2 + 2 * q_B1 * pitch_B1.sin()).sqrt()
    height_BP = depth_BP * (p_B1 * x_BP + y_BP + q_B1) / length_B1
    return height_BP.nanmedian(1).values


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
