"""A five-convolution pyramid for tests and smoke runs: 25 k parameters, no pre-training.

Not a published network; its numbers mean nothing.
"""

from collections.abc import Iterator
from itertools import pairwise

from torch import Tensor, nn

from mtl_bench.core.backbone import Backbone


class Tiny(Backbone):
    def __init__(
        self, strides: tuple[int, ...] = (8, 16, 32), pretrained: str | None = None, width: int = 8
    ):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"there are no pre-trained weights for this: '{pretrained}'")
        widths = [3, width, width, 2 * width, 4 * width, 4 * width]
        depth = max(strides).bit_length() - 1
        self.stages = nn.ModuleList(
            nn.Sequential(nn.Conv2d(i, o, 3, 2, 1), nn.GroupNorm(4, o), nn.ReLU())
            for i, o in pairwise(widths[: depth + 1])
        )
        self.channels = {stride: widths[stride.bit_length() - 1] for stride in strides}

    def stem(self) -> Iterator[nn.Parameter]:
        return self.stages[0].parameters()

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        found, x = {}, image_B3HW
        for level, stage in enumerate(self.stages):
            x = stage(x)
            found[2 ** (level + 1)] = x
        return {stride: found[stride] for stride in self.channels}
