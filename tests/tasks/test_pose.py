"""The light pose encoder's flow is the shift that images have; its network starts forward."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mtl_bench.tasks.depth.pose import FlowEncoder, PoseNetwork, _windows


def picture(height: int = 64, width: int = 128, grain: int = 8) -> torch.Tensor:
    """Smooth random texture [1,3,H,W], `grain` pixels wide."""
    torch.manual_seed(0)
    coarse = torch.rand(1, 3, height // grain, width // grain)
    return F.interpolate(coarse, (height, width), mode="bicubic", align_corners=False).clamp(0, 1)


def shifted(image: torch.Tensor, right: float, down: float) -> torch.Tensor:
    """What was at (x, y) is at (x + right, y + down)."""
    height, width = image.shape[2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    at = torch.stack([(x - right) / (width - 1), (y - down) / (height - 1)], -1) * 2 - 1
    return F.grid_sample(image, at[None].float(), align_corners=True, padding_mode="border")


@pytest.mark.parametrize("level", FlowEncoder.LEVELS)
@pytest.mark.parametrize(("right", "down"), [(0.4, 0.0), (0.0, -0.7), (1.0, 0.5)])
def test_flow_is_the_shift(level, right, down):
    image = picture(256, 512, 4 * 2**level)  # what this level is there to see
    context = torch.stack([shifted(image, right, down), shifted(image, -right, -down)], 1)
    encoder = FlowEncoder(8)
    target, frames = image.mean(1, keepdim=True), context.mean(2)
    flow = encoder._flow(target, frames, level)[:, :4, 4:-4, 4:-4] * encoder.CELL
    assert flow.shape[1:] == (4, 24, 56)
    expected = torch.tensor([right, -right, down, -down])
    torch.testing.assert_close(
        flow.median(2).values.median(2).values[0], expected, atol=0.12, rtol=0.2
    )


@pytest.mark.parametrize(("cell", "side"), [(4, 7), (2, 3), (1, 3)])
def test_windows_are_means_of_means(cell, side):
    values = np.random.default_rng(0).random(22)
    padded = np.pad(values, side // 2)
    sliding = [padded[at : at + side].mean() for at in range(22)]
    expected = [np.mean(sliding[at : at + cell]) for at in range(0, 22 - cell + 1, cell)]
    weights = _windows(22, cell, torch.float64)
    np.testing.assert_allclose(values @ weights.numpy(), expected, rtol=1e-12)


def test_nothing_to_see_is_no_flow():
    plain = torch.full((2, 3, 64, 128), 0.5)
    features = FlowEncoder(8).eval()(plain, plain[:, None].expand(-1, 2, -1, -1, -1))
    assert features.isfinite().all()


@pytest.mark.parametrize("encoder", ["light", "resnet18"])
def test_poses_follow_the_scales(encoder):
    image = picture().repeat(2, 1, 1, 1)
    context = torch.stack([shifted(image[:1], 1, 0), shifted(image[:1], -1, 0)], 1).repeat(
        2, 1, 1, 1, 1
    )
    torch.manual_seed(0)
    still = PoseNetwork(encoder, 16, scale=(0.0, 0.0)).eval()
    moving = PoseNetwork(encoder, 16, scale=(0.0, 1.0)).eval()
    moving.load_state_dict(still.state_dict())
    assert torch.equal(still(image, context), torch.eye(4).expand(2, 2, 4, 4))
    transforms = moving(image, context)
    assert (transforms[..., :3, 3] == 0).all()
    assert (transforms[..., :3, :3] - torch.eye(3)).abs().max() > 1e-3


def test_the_light_one_starts_with_a_camera_that_moves_forward():
    torch.manual_seed(0)
    pose = PoseNetwork("light", 16, scale=(0.01, 0.01)).eval()
    grey_B3HW = torch.full((1, 3, 64, 128), 0.5)  # no flow: what is left is the start
    moved_23 = pose(grey_B3HW, grey_B3HW.expand(2, -1, -1, -1)[None])[0, :, :3, 3].detach()
    before, after = moved_23  # where the target's points are for the camera before, and after
    assert before[2] == pytest.approx(0.01, abs=1e-3)
    assert after[2] == pytest.approx(-0.01, abs=1e-3)
    assert moved_23[:, :2].abs().max() < 1e-3


def test_unknown_encoder():
    with pytest.raises(ValueError, match="no pose encoder 'big'"):
        PoseNetwork("big")
