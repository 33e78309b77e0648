"""CelebA's small network: seven 3x3 convolutions and two fully connected layers, one vector.

Source: FAMO (Liu et al., NeurIPS 2023), its CelebA experiments: 64, 128, 128, 256, 256, 512 and 512
channels, the mean over the image, 512 and 512 units; 5.20 M parameters with 40 linear heads. A
maximum over 2x2 follows the last convolution of each width but the last one; where it stands in
their network is not printed.
"""

from itertools import pairwise

from torch import Tensor, nn

from mtl_bench.core.backbone import VECTOR, Backbone

CHANNELS = (3, 64, 128, 128, 256, 256, 512, 512)


class CNN9(Backbone):
    vector = True
    mean = (0.0, 0.0, 0.0)  # images stay in [0, 1]
    std = (1.0, 1.0, 1.0)

    def __init__(
        self, size: tuple[int, int] = (64, 64), outputs: int = 512, pretrained: str | None = None
    ):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"there are no pre-trained weights for this: '{pretrained}'")
        layers: list[nn.Module] = []
        for number, (before, channels) in enumerate(pairwise(CHANNELS), 2):
            layers += [nn.Conv2d(before, channels, 3, padding=1), nn.BatchNorm2d(channels)]
            layers.append(nn.ReLU())
            if number < len(CHANNELS) and CHANNELS[number] > channels:
                layers.append(nn.MaxPool2d(2))
        layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten()]
        layers += [nn.Linear(CHANNELS[-1], 512), nn.ReLU(), nn.Linear(512, outputs), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.channels = {VECTOR: outputs}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        return {VECTOR: self.layers(image_B3HW)}
