"""SegNet: an encoder and its mirror image, features at the image's own size; 24.9 M parameters.

Badrinarayanan, Kendall, Cipolla, SegNet, TPAMI 2017, arXiv:1511.00561: VGG-16's convolutions,
pooled by maxima whose places the decoder puts them back to. As the tables of multi-task papers have
it (after MTAN, CVPR 2019), a stage of the decoder narrows in its first convolution, and images are
not normalised. For recipes with `network.strides = [1]` and `network.decoder = "none"`; with three
heads of 64 channels it has 25.06 M parameters. There are no pre-trained weights.
"""

from itertools import pairwise

import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core.backbone import Backbone

WIDTHS = (64, 128, 256, 512, 512)
CONVOLUTIONS = (2, 2, 3, 3, 3)  # of a stage


def stage(inputs: int, outputs: int, convolutions: int) -> nn.Sequential:
    """Convolutions with BatchNorm and ReLU; the first one changes the width."""
    layers: list[nn.Module] = []
    for i, o in pairwise([inputs, *[outputs] * convolutions]):
        layers += [nn.Conv2d(i, o, 3, padding=1), nn.BatchNorm2d(o), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class SegNet(Backbone):
    mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    offered = (1,)
    divisor = 2 ** len(WIDTHS)

    def __init__(self, strides: tuple[int, ...] = (1,), pretrained: str | None = None):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"there are no pre-trained weights for this: '{pretrained}'")
        ways = list(zip(pairwise([3, *WIDTHS]), CONVOLUTIONS, strict=True))
        self.down = nn.ModuleList(stage(i, o, count) for (i, o), count in ways)
        back = zip(pairwise([WIDTHS[0], *WIDTHS]), CONVOLUTIONS, strict=True)
        self.up = nn.ModuleList(stage(i, o, count) for (o, i), count in back)
        self.channels = dict.fromkeys(strides, WIDTHS[0])

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        x, places = image_B3HW, []
        for down in self.down:
            x, place = F.max_pool2d(down(x), 2, return_indices=True)
            places.append(place)
        for up, place in zip(reversed(self.up), reversed(places), strict=True):
            x = up(F.max_unpool2d(x, place, [2, 2]))
        return dict.fromkeys(self.channels, x)
