"""The pose network: how the camera moved between the three frames of a sample.

Source: MGNet's pose network. It sees [t, t-1, t+1] and answers with two 6-vectors (translation,
Euler angles), scaled down so that training starts near the identity. Two encoders: the paper's
ResNet-18, and a light one for small images and short trainings.
"""

from functools import lru_cache
from typing import Any

import timm
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core.backbone import Backbone
from mtl_bench.core.geometry import pose_from_vector
from mtl_bench.model.layers import ConvNorm, Normalize, init_fan_in

FORWARD = 2  # of a 6-vector, the translation along the optical axis


class PoseNetwork(nn.Module):
    """Three frames -> the target camera's motion to each context camera.

    Args:
        encoder: "resnet18" (the paper's, 11.2 M parameters) or "light" (see `FlowEncoder`), with
            which training starts from a camera that moves forward, by one unit of `scale` a frame.
        channels: hidden width of the decoder; the paper's 256.
        scale: factors on translation and rotation; the paper's 0.01 and 0.01.
        pretrained: start the ResNet-18 from timm's ImageNet weights, its first kernel repeated over
            the frames and divided by three.
    """

    scale_6: Tensor

    def __init__(
        self,
        encoder: str = "resnet18",
        channels: int = 256,
        scale: tuple[float, float] = (0.01, 0.01),
        pretrained: bool = False,
    ):
        super().__init__()
        factors = torch.tensor(scale).repeat_interleave(3)
        self.register_buffer("scale_6", factors, persistent=False)
        if encoder == "resnet18":
            self.encoder: nn.Module = StackEncoder(pretrained)
            width = 512
        elif encoder == "light":
            self.encoder = FlowEncoder(channels)
            width = channels
        else:
            raise ValueError(f"no pose encoder '{encoder}' (known: light, resnet18)")
        self.decoder = nn.Sequential(
            nn.Conv2d(width, channels, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, 12, 1),
        )
        init_fan_in(self.decoder)
        if encoder == "light":
            last: Any = self.decoder[-1]
            last.bias.data[[FORWARD, 6 + FORWARD]] = torch.tensor([1.0, -1.0])

    def forward(self, image_B3HW: Tensor, context_B23HW: Tensor) -> Tensor:
        """transform_B244: target-camera points -> points of the previous and the next camera."""
        features = self.encoder(image_B3HW, context_B23HW)
        vector_B26 = (
            self.decoder(features).float().mean((2, 3)).unflatten(-1, (2, 6)) * self.scale_6
        )
        return torch.stack([pose_from_vector(v_B6) for v_B6 in vector_B26.unbind(1)], 1)


class StackEncoder(nn.Module):
    """A ResNet-18 over the three frames as nine channels."""

    def __init__(self, pretrained: bool):
        super().__init__()
        self.normalize = Normalize(Backbone.mean, Backbone.std)
        self.resnet = timm.create_model(
            "resnet18", pretrained=pretrained, in_chans=9, num_classes=0, global_pool=""
        )

    def forward(self, image_B3HW: Tensor, context_B23HW: Tensor) -> Tensor:
        frames = [image_B3HW, context_B23HW[:, 0], context_B23HW[:, 1]]
        found: Tensor = self.resnet(torch.cat([self.normalize(frame) for frame in frames], 1))
        return found


class FlowEncoder(nn.Module):
    """Two convolutions over the local optical flow to both context frames.

    The flow is Lucas and Kanade's (IJCAI 1981): per cell, the shift that explains the brightness
    change best. A stack of convolutions has to learn the product of a spatial and a temporal
    derivative before it can see a rotation of a third of a pixel, and did not in 300 steps at
    64 x 128; here it is given, and what is left to learn is nearly linear.
    """

    CELL = 8  # pixels of the input per cell
    LEVELS = (1, 2, 3)  # the input halved this often: from small and precise to large shifts

    def __init__(self, channels: int):
        super().__init__()
        inputs = 2 * 3 * len(self.LEVELS)
        self.conv = nn.Sequential(ConvNorm(inputs, channels, 3), ConvNorm(channels, channels, 3))

    def forward(self, image_B3HW: Tensor, context_B23HW: Tensor) -> Tensor:
        with torch.no_grad(), torch.autocast(image_B3HW.device.type, enabled=False):
            target_B1HW = image_B3HW.float().mean(1, keepdim=True)
            context_B2HW = context_B23HW.float().mean(2)
            cells = [self._flow(target_B1HW, context_B2HW, level) for level in self.LEVELS]
        found: Tensor = self.conv(torch.cat(cells, 1))
        return found

    def _flow(self, target_B1HW: Tensor, context_B2HW: Tensor, level: int) -> Tensor:
        """[B,6,H/8,W/8]: for both frames the shift (x, y) in cells, and how textured it is."""
        target, context = (F.avg_pool2d(x, 2**level) for x in (target_B1HW, context_B2HW))
        middle = F.pad((target + context) / 2, (1, 1, 1, 1), mode="replicate")
        dx = (middle[..., 1:-1, 2:] - middle[..., 1:-1, :-2]) / 2
        dy = (middle[..., 2:, 1:-1] - middle[..., :-2, 1:-1]) / 2
        dt = context - target

        # A product an axis takes a quarter of the time of pools for every pixel, up to 256 x 512
        cell, kind, device = self.CELL >> level, target.dtype, target.device
        down, right = (_windows(length, cell, kind).to(device) for length in target.shape[-2:])

        def in_cells(x: Tensor) -> Tensor:  # means over windows of 2 x 2 cells, at every cell
            return down.T @ x @ right

        xx, xy, yy = in_cells(dx * dx), in_cells(dx * dy), in_cells(dy * dy)
        xt, yt = in_cells(dx * dt), in_cells(dy * dt)
        xx, yy = xx + 1e-5, yy + 1e-5  # no shift where there is nothing to see it by
        determinant = xx * yy - xy * xy
        u, v = (xy * yt - yy * xt) / determinant, (xy * xt - xx * yt) / determinant
        cells = 2**level / self.CELL
        return torch.cat([cells * u, cells * v, (xx + yy).sqrt()], 1)


@lru_cache(maxsize=16)
def _windows(length: int, cell: int, dtype: torch.dtype) -> Tensor:
    """[length, length // cell]: takes the pixels of an axis to means over windows of about two
    cells, averaged over every cell. Beyond the border there are zeros."""
    window = max(2 * cell, 3)
    side, reach = window - 1 + window % 2, (window - 1) // 2
    pixels = torch.eye(length, dtype=dtype)[None]
    return F.avg_pool1d(F.avg_pool1d(pixels, side, 1, reach), cell)[0]
