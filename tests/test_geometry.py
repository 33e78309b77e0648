"""The camera: published reference values, kornia as the oracle, and what is in view."""

import pytest
import torch
from torch import Tensor

from mtl_bench.core import geometry

F64 = torch.float64


def pattern(a: int, b: int, c: int, m: int, channels: int = 3) -> Tensor:
    """((a i + b j + c k) mod m) / (m - 1) for row i, column j, channel k: [1,channels,12,16]."""
    k, i, j = torch.meshgrid(*(torch.arange(n) for n in (channels, 12, 16)), indexing="ij")
    return (((a * i + b * j + c * k) % m).to(F64) / (m - 1))[None]


@pytest.fixture
def K_133() -> Tensor:
    return torch.tensor([[[10, 0, 7.5], [0, 12, 5.5], [0, 0, 1]]], dtype=F64)


@pytest.fixture
def pose_144() -> Tensor:
    return geometry.pose_from_vector(torch.tensor([[0.1, -0.2, 0.3, 0.05, -0.1, 0.2]], dtype=F64))


def test_pose_reference_values(pose_144: Tensor) -> None:
    expected = torch.tensor(
        [
            [0.97517033, -0.19767681, -0.09983342, 0.1],
            [0.19353091, 0.97983303, -0.04972948, -0.2],
            [0.10765044, 0.02917386, 0.99376067, 0.3],
            [0, 0, 0, 1],
        ],
        dtype=F64,
    )
    torch.testing.assert_close(pose_144[0], expected, rtol=0, atol=5e-9)


def test_pose_keeps_leading_axes_and_is_rigid() -> None:
    vectors = torch.randn(2, 3, 6, dtype=F64)
    poses = geometry.pose_from_vector(vectors)
    assert poses.shape == (2, 3, 4, 4)
    R = poses[..., :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=F64).expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(2, 3, dtype=F64))
    torch.testing.assert_close(poses[..., :3, 3], vectors[..., :3])


def test_warp_reference_values(K_133: Tensor, pose_144: Tensor) -> None:
    depth = 2 + pattern(1, 2, 0, 5, channels=1)
    warped, _ = geometry.warp(pattern(7, 13, 5, 17), depth, pose_144, K_133)
    assert warped.mean().item() == pytest.approx(0.446649562313, abs=1e-12)
    assert warped[0, 0, 5, 7].item() == pytest.approx(0.334989422249, abs=1e-12)
    assert warped[0, 2, 3, 10].item() == pytest.approx(0.426128087288, abs=1e-12)
    assert (warped == 0).all(1).to(F64).mean().item() == 0.0625


def test_warp_by_nothing_changes_nothing(K_133: Tensor) -> None:
    image, depth = pattern(7, 13, 5, 17), 2 + pattern(1, 2, 0, 5, channels=1)
    still = torch.eye(4, dtype=F64)[None]
    warped, valid = geometry.warp(image, depth, still, K_133)
    assert (warped - image).abs().max().item() < 3e-15
    assert valid.all()


def test_rounding_at_the_border_is_not_out_of_view() -> None:
    torch.manual_seed(0)
    K = torch.tensor([[[101.7, 0, 63.3], [0, 98.9, 30.1], [0, 0, 1]]])
    depth, still = 1 + 50 * torch.rand(1, 1, 64, 128), torch.eye(4)[None]
    _, valid = geometry.warp(torch.rand(1, 3, 64, 128), depth, still, K)
    assert valid.all()


def test_warp_is_projection_of_moved_points(K_133: Tensor, pose_144: Tensor) -> None:
    image, depth = pattern(7, 13, 5, 17), 2 + pattern(1, 2, 0, 5, channels=1)
    points = geometry.back_project(depth, K_133)
    moved = pose_144[:, :3, :3] @ points.flatten(2) + pose_144[:, :3, 3:]
    x, y, z = (K_133 @ moved).view_as(points)[0]
    grid = torch.stack([x / z / 7.5 - 1, y / z / 5.5 - 1], -1)[None]
    in_view = (grid.abs() <= 1 + 1e-9).all(-1)[:, None]
    expected = torch.nn.functional.grid_sample(image, grid, align_corners=True)
    warped, valid = geometry.warp(image, depth, pose_144, K_133)
    torch.testing.assert_close(warped, expected)
    assert torch.equal(valid, in_view)
    assert 0 < valid.sum() < valid.numel()


def test_warp_and_back_projection_equal_kornia(K_133: Tensor, pose_144: Tensor) -> None:
    from kornia.geometry.depth import depth_to_3d_v2, warp_frame_depth

    image, depth = pattern(7, 13, 5, 17), 2 + pattern(1, 2, 0, 5, channels=1)
    points = depth_to_3d_v2(depth.squeeze(1), K_133).permute(0, 3, 1, 2)
    torch.testing.assert_close(geometry.back_project(depth, K_133), points)
    warped, _ = geometry.warp(image, depth, pose_144, K_133)
    torch.testing.assert_close(warped, warp_frame_depth(image, depth, pose_144, K_133))


def test_project_inverts_back_project(K_133: Tensor) -> None:
    depth = 2 + pattern(1, 2, 0, 5, channels=1)
    pixels, in_view = geometry.project(geometry.back_project(depth, K_133), K_133)
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    torch.testing.assert_close(pixels[0], torch.stack((x, y), -1).to(F64))
    assert in_view.all()


def test_points_of_each_image_and_nan_where_there_is_no_depth(K_133: Tensor) -> None:
    depth = 2 + torch.cat([pattern(1, 2, 0, 5, channels=1)] * 2)
    K = K_133.repeat(2, 1, 1)
    K[1, 0, 0] *= 2
    points = geometry.back_project(depth, K)
    alone = [geometry.back_project(depth[i : i + 1], K[i : i + 1]) for i in range(2)]
    assert torch.equal(points, torch.cat(alone))
    assert not torch.equal(*alone)
    depth[0, 0, 3, 5], depth[1, 0, 0, 0] = 0.0, float("nan")
    empty = geometry.back_project(depth, K).isnan()
    assert empty.sum() == 6
    assert empty[0, :, 3, 5].all()
    assert empty[1, :, 0, 0].all()


def test_out_of_view_and_behind_the_camera(K_133: Tensor) -> None:
    image, depth = torch.ones(1, 3, 12, 16, dtype=F64), torch.full((1, 1, 12, 16), 2.0, dtype=F64)
    move = torch.eye(4, dtype=F64)[None]
    move[0, 0, 3] = 1.0  # 1 / 2 * fx = 5 pixels to the right
    warped, valid = geometry.warp(image, depth, move, K_133)
    assert valid[..., :11].all()
    assert not valid[..., 11:].any()
    assert (warped[..., :11] == 1).all()
    assert (warped[..., 11:].abs() < 1e-12).all()

    move[0, :3, 3] = torch.tensor([0, 0, -3.0])  # the points come to lie behind the camera
    K_133[0, :2, 2] = torch.tensor([8, 6])  # one of them right behind it
    depth.requires_grad_()
    warped, valid = geometry.warp(image, depth, move, K_133)
    assert not valid.any()
    warped.sum().backward()
    assert depth.grad is not None
    assert depth.grad.isfinite().all()


def test_extreme_depths_stay_finite(K_133: Tensor, pose_144: Tensor) -> None:
    inverse = torch.tensor([0.0, 1e-30, 1e-6, 2.0]).repeat(1, 1, 12, 4).requires_grad_()
    depth = geometry.depth_from_inverse(inverse)
    assert depth.max().item() == pytest.approx(1e6)
    image = torch.rand(1, 3, 12, 16)
    warped, _ = geometry.warp(image, depth, pose_144.float(), K_133.float())
    warped.sum().backward()
    assert warped.isfinite().all()
    assert inverse.grad is not None
    assert inverse.grad.isfinite().all()


def test_scaled_intrinsics(K_133: Tensor) -> None:
    expected = torch.tensor([[[5, 0, 3.5], [0, 3, 1.0], [0, 0, 1]]], dtype=F64)
    torch.testing.assert_close(geometry.scale_intrinsics(K_133, 0.5, 0.25), expected)


def plane_depth(normal: Tensor, distance: float, K_133: Tensor) -> Tensor:
    """Depth at which every pixel's ray meets the plane normal . X = distance: [1,1,12,16]."""
    rays = geometry.back_project(torch.ones(1, 1, 12, 16, dtype=F64), K_133)
    return distance / (rays * normal.view(1, 3, 1, 1)).sum(1, keepdim=True)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 1, 0.5), (0.3, -0.2, 0.9)])
def test_normals_of_a_plane(normal: tuple[float, ...], K_133: Tensor) -> None:
    expected = torch.nn.functional.normalize(torch.tensor(normal, dtype=F64), dim=0)
    # below the camera's axis only, where the slanted planes are in front of it
    K_133[0, 1, 2] = -1
    K_133[0, :2, :2] *= 3
    points = geometry.back_project(plane_depth(expected, 1.5, K_133), K_133)
    normals = geometry.normals(points)
    torch.testing.assert_close(normals, expected.view(1, 3, 1, 1).expand_as(normals))


def test_ground_height_from_normals(K_133: Tensor) -> None:
    K_133[0, 1, 2] = -1  # every ray goes down
    down = torch.tensor([0, 1, 0], dtype=F64)
    points = geometry.back_project(plane_depth(down, 1.22, K_133), K_133)
    height = (geometry.normals(points) * points).sum(1)
    torch.testing.assert_close(height, torch.full_like(height, 1.22))


def test_all_four_neighbour_pairs_count_alike() -> None:
    """Diagonal neighbours on one plane, the others on another: the normal lies between the two."""
    y, x = torch.meshgrid(torch.arange(-1.0, 2), torch.arange(-1.0, 2), indexing="ij")
    diagonal = (x * y).abs() > 0
    z = 5 + torch.where(diagonal, 0.5 * x, -0.5 * x)
    normal = geometry.normals(torch.stack((x, y, z))[None])[0, :, 1, 1]
    torch.testing.assert_close(normal, torch.tensor([0.0, 0.0, 1.0]))
