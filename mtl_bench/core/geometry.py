"""The pinhole camera: pixels to points and back, warping one frame into another, surface normals.

Shapes: B samples, H x W pixels. Pixel centres are integers, the top-left one is (0, 0). Camera
axes: x right, y down, z forward; intrinsics K without skew. Metres, or any other unit that depth
and translation share. Everything works in the precision of what it is given, on its device.

kornia's `warp_frame_depth` gives the same image in two to three times the time, but no mask; its
normals come from Sobel filters. It serves the tests as the oracle.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

MIN_Z = 1e-5  # nearer points, and those behind the camera, are projected from here
SLACK = 1e-3  # pixels: a projection this far outside the image is rounding, not out of view


def depth_from_inverse(inverse_B1HW: Tensor) -> Tensor:
    """Depth of an inverse depth, at most 1e6."""
    return inverse_B1HW.clamp(min=1e-6).reciprocal()


def scale_intrinsics(K_B33: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """Intrinsics of the image resized by these factors.

    With integer pixel centres the image begins at -0.5, so c becomes (c + 0.5) * scale - 0.5.
    """
    scale = K_B33.new_tensor([scale_x, scale_y, 1.0]).diag()
    shift = K_B33.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return scale @ (K_B33 + shift) - shift


def pose_from_vector(vector_B6: Tensor) -> Tensor:
    """Rigid transforms [...,4,4] of vectors [...,6]: tx, ty, tz, then Euler angles rx, ry, rz.

    The rotation is Rx @ Ry @ Rz, in radians (MGNet's public code; Monodepth2 uses axis-angle).
    """
    tx, ty, tz, *angles = vector_B6.unbind(-1)
    (sx, cx), (sy, cy), (sz, cz) = ((angle.sin(), angle.cos()) for angle in angles)
    zero, one = torch.zeros_like(tx), torch.ones_like(tx)
    rows = (
        (cy * cz, -cy * sz, sy, tx),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, ty),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy, tz),
        (zero, zero, zero, one),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def back_project(depth_B1HW: Tensor, K_B33: Tensor) -> Tensor:
    """Points [B,3,H,W] in the camera's frame that are seen at these depths; NaN without one."""
    height, width = depth_B1HW.shape[-2:]
    y_H1 = torch.arange(height, device=K_B33.device, dtype=K_B33.dtype)[:, None]
    x_1W = torch.arange(width, device=K_B33.device, dtype=K_B33.dtype)[None]
    fx, fy, cx, cy = (K_B33[:, i, j, None, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    z_B1HW = depth_B1HW.masked_fill(depth_B1HW <= 0, torch.nan)
    return torch.cat([(x_1W - cx) / fx * z_B1HW, (y_H1 - cy) / fy * z_B1HW, z_B1HW], 1)


def project(points_B3HW: Tensor, K_B33: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [B,H,W,2] as (x, y), and where they are in view [B,1,H,W], of points.

    In view: in front of the camera and inside an image of the points' own height and width.
    """
    scaled_B3HW = (K_B33 @ points_B3HW.flatten(2)).view_as(points_B3HW)
    offset_B2HW, half_211, in_view_B1HW = _divide(scaled_B3HW)
    return (offset_B2HW + half_211).permute(0, 2, 3, 1), in_view_B1HW


def warp(
    image_B3HW: Tensor,
    depth_B1HW: Tensor,
    transform_B44: Tensor,
    K_B33: Tensor,
    padding: str = "zeros",
) -> tuple[Tensor, Tensor]:
    """Rebuild a target frame from another frame's image; also where it is in that frame's view.

    Args:
        image_B3HW: the source frame.
        depth_B1HW: the target frame's depth.
        transform_B44: takes points from the target's camera to the source's.
        K_B33: intrinsics of both.
        padding: out of view, "zeros" (black) or "border" (the nearest pixel in view).

    Returns:
        The warped image, bilinear, and the mask [B,1,H,W] of valid
        projections (the paper's M_v, which its public code does not have).
    """
    height, width = depth_B1HW.shape[-2:]
    # K (R depth K^-1 pixel + t), ordered so that only the depth is multiplied out per pixel
    turned_B3N = (K_B33 @ transform_B44[:, :3, :3] @ _inverse(K_B33)) @ _pixels(depth_B1HW)
    shift_B311 = (K_B33 @ transform_B44[:, :3, 3:]).unsqueeze(-1)
    scaled_B3HW = torch.addcmul(shift_B311, turned_B3N.unflatten(-1, (height, width)), depth_B1HW)
    offset_B2HW, half_211, valid_B1HW = _divide(scaled_B3HW)
    # out of view is out of view: the bound keeps points near the camera plane from overflowing
    grid_BHW2 = (offset_B2HW / half_211).clamp(-4, 4).permute(0, 2, 3, 1)
    warped = F.grid_sample(image_B3HW, grid_BHW2, padding_mode=padding, align_corners=True)
    return warped, valid_B1HW


def normals(points_B3HW: Tensor) -> Tensor:
    """Unit surface normals [B,3,H,W], pointing away from the camera: +y on the ground.

    Mean of the unit cross products of four pairs of neighbours, each a right angle apart; border
    pixels take their inner neighbour's. All four turn the same way, unlike in MGNet's public code,
    where one does not and cancels another.
    """

    def toward(down: int, right: int) -> Tensor:
        height, width = points_B3HW.shape[-2:]
        neighbor = points_B3HW[..., 1 + down : height - 1 + down, 1 + right : width - 1 + right]
        return neighbor - points_B3HW[..., 1:-1, 1:-1]

    pairs = (
        (toward(0, -1), toward(-1, 0)),  # left, up
        (toward(0, 1), toward(1, 0)),  # right, down
        (toward(1, -1), toward(-1, -1)),  # down left, up left
        (toward(-1, 1), toward(1, 1)),  # up right, down right
    )
    units = [F.normalize(torch.linalg.cross(a, b, dim=1), dim=1) for a, b in pairs]
    return F.pad(F.normalize(torch.stack(units).sum(0), dim=1), (1, 1, 1, 1), mode="replicate")


def _pixels(like_B1HW: Tensor) -> Tensor:
    """Homogeneous pixel coordinates [3, H*W], row by row."""
    height, width = like_B1HW.shape[-2:]
    y = torch.arange(height, device=like_B1HW.device, dtype=like_B1HW.dtype)
    x = torch.arange(width, device=like_B1HW.device, dtype=like_B1HW.dtype)
    y_N, x_N = y.repeat_interleave(width), x.repeat(height)
    return torch.stack((x_N, y_N, torch.ones_like(x_N)))


def _inverse(K_B33: Tensor) -> Tensor:
    """K^-1 in closed form: exact, exportable, and no solver on the device."""
    inverse = torch.zeros_like(K_B33)
    inverse[:, 0, 0] = 1 / K_B33[:, 0, 0]
    inverse[:, 1, 1] = 1 / K_B33[:, 1, 1]
    inverse[:, 0, 2] = -K_B33[:, 0, 2] / K_B33[:, 0, 0]
    inverse[:, 1, 2] = -K_B33[:, 1, 2] / K_B33[:, 1, 1]
    inverse[:, 2, 2] = 1
    return inverse


def _divide(scaled_B3HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(x, y) from the image's middle [B,2,H,W] in pixels, the middle, and where it is in view."""
    height, width = scaled_B3HW.shape[-2:]
    half_211 = scaled_B3HW.new_tensor([width - 1, height - 1]).view(2, 1, 1) / 2
    xy_B2HW, z_B1HW = scaled_B3HW.split((2, 1), 1)
    offset_B2HW = xy_B2HW / z_B1HW.clamp(min=MIN_Z) - half_211
    with torch.no_grad():
        inside_B2HW = offset_B2HW.abs() <= half_211 + SLACK
        in_view_B1HW = inside_B2HW[:, :1] & inside_B2HW[:, 1:] & (z_B1HW > MIN_Z)
    return offset_B2HW, half_211, in_view_B1HW
