"""The pose network: how the camera moved between the three frames of a sample.

Source: MGNet's pose network. It sees [t, t-1, t+1] as nine channels and answers with two
6-vectors (translation, Euler angles), scaled by 0.01 so that training starts near the identity.
"""

import timm
import torch
from torch import Tensor, nn

from mtl_bench.geometry import pose_from_vector
from mtl_bench.model.backbone import Backbone, Normalize
from mtl_bench.model.layers import ConvNorm, init_fan_in

import os
SCALE = float(os.environ.get("PS","0.01"))


class PoseNetwork(nn.Module):
    """Three frames -> the target camera's motion to each context camera.

    Args:
        encoder: "resnet18" (the paper's, 11.2 M parameters) or "light" (five strided convolutions,
            for small images).
        channels: hidden width of the decoder; the paper's 256.
        pretrained: "timm" starts the ResNet-18 encoder from ImageNet weights, its first kernel
            repeated over the frames and divided by three.
    """

    def __init__(self, encoder: str = "resnet18", channels: int = 256, pretrained: bool = False):
        super().__init__()
        self.normalize = Normalize(Backbone.mean, Backbone.std)
        if encoder == "resnet18":
            self.encoder: nn.Module = timm.create_model(
                "resnet18", pretrained=pretrained, in_chans=9, num_classes=0, global_pool=""
            )
            width = 512
        elif encoder == "light":
            self.encoder, width = _light_encoder()
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

    def forward(self, image_B3HW: Tensor, context_B23HW: Tensor) -> Tensor:
        """transform_B244: target-camera points -> points of the previous and the next camera."""
        frames = [image_B3HW, context_B23HW[:, 0], context_B23HW[:, 1]]
        features = self.encoder(torch.cat([self.normalize(frame) for frame in frames], 1))
        vector_B26 = SCALE * self.decoder(features).float().mean((2, 3)).view(-1, 2, 6)
        return torch.stack([pose_from_vector(v_B6) for v_B6 in vector_B26.unbind(1)], 1)


def _light_encoder() -> tuple[nn.Module, int]:
    widths = [9, 16, 32, 64, 128]
    stages: list[nn.Module] = []
    for inputs, outputs in zip(widths, widths[1:], strict=False):
        conv = ConvNorm(inputs, outputs, 3)
        conv[0] = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, bias=False)
        stages.append(conv)
    return nn.Sequential(*stages), widths[-1]
