"""LeNet for two overlaid digits: two 5x5 convolutions and a fully connected layer, one vector.

Source: MultiLeNet of Sener and Koltun (NeurIPS 2018), after LeCun et al. (1998): 10 and 20
channels, a maximum over 2x2 after each, 320 -> 50. Departure: convolutions are padded, so that
16x16 pixels leave the same 320 numbers as their 28x28 without padding.
"""

from torch import Tensor, nn

from mtl_bench.core.backbone import VECTOR, Backbone

CHANNELS = (10, 20)


class LeNet(Backbone):
    vector = True
    mean = (0.1307,) * 3  # MNIST's
    std = (0.3081,) * 3

    def __init__(
        self, size: tuple[int, int] = (64, 64), outputs: int = 50, pretrained: str | None = None
    ):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"there are no pre-trained weights for this: '{pretrained}'")
        first, second = CHANNELS
        flat = second * (size[0] // 4) * (size[1] // 4)
        self.layers = nn.Sequential(
            *(nn.Conv2d(3, first, 5, padding=2), nn.MaxPool2d(2), nn.ReLU()),
            *(nn.Conv2d(first, second, 5, padding=2), nn.MaxPool2d(2), nn.ReLU()),
            *(nn.Flatten(), nn.Linear(flat, outputs), nn.ReLU()),
        )
        self.channels = {VECTOR: outputs}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        return {VECTOR: self.layers(image_B3HW)}
