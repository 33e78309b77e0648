"""The building blocks behind the backbone: GCM, ARM, FFM, decoder, head.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), after BiSeNet (Yu et al., ECCV 2018).
Departure: BatchNorm followed by LeakyReLU(0.01) where the paper has InPlaceABN. Same parameters
and shapes; InPlaceABN scales by |gamma| + eps, BatchNorm by gamma.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core.recipe import Network
from mtl_bench.core.task import Maps, TaskHead

MGNET, ASPP = "mgnet", "aspp"  # decoders of a recipe; "none" is the third
LEAK = 0.01  # LeakyReLU slope of the paper's InPlaceABN


class ConvNorm(nn.Sequential):
    """Convolution without bias, BatchNorm, LeakyReLU (or nothing where `leaky` is off)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, leaky: bool = True):
        layers: list[nn.Module] = [
            nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
        ]
        super().__init__(*layers, *([nn.LeakyReLU(LEAK, inplace=True)] if leaky else []))


class GlobalContext(nn.Module):
    """GCM: the image's mean feature, as a map of one pixel that broadcasts."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = ConvNorm(inputs, outputs, 1)

    def forward(self, deepest_BCHW: Tensor) -> Tensor:
        found: Tensor = self.conv(deepest_BCHW.mean((2, 3), keepdim=True))
        return found


class AttentionRefinement(nn.Module):
    """ARM: a 3x3 convolution whose channels are gated by their own global mean."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = ConvNorm(inputs, outputs, 3)
        self.gate = ConvNorm(outputs, outputs, 1, leaky=False)

    def forward(self, x_BCHW: Tensor) -> Tensor:
        features = self.conv(x_BCHW)
        found: Tensor = features * self.gate(features.mean((2, 3), keepdim=True)).sigmoid()
        return found


class FeatureFusion(nn.Module):
    """FFM: a 1x1 convolution over the concatenation, plus itself gated by its global mean."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = ConvNorm(inputs, outputs, 1)
        self.gate = nn.Sequential(  # neither bias nor norm, as in the paper's code
            nn.Conv2d(outputs, outputs, 1, bias=False),
            nn.ReLU(inplace=True),
            nn.Conv2d(outputs, outputs, 1, bias=False),
        )

    def forward(self, skip_BCHW: Tensor, deep_BCHW: Tensor) -> Tensor:
        features = self.conv(torch.cat([skip_BCHW, deep_BCHW], 1))
        found: Tensor = (
            features + features * self.gate(features.mean((2, 3), keepdim=True)).sigmoid()
        )
        return found


class Decoder(nn.Module):
    """One task's way from three pyramid levels back to the finest of them.

    Args:
        inputs: channels of the finest, middle and deepest level.
        channels: width of the refinement; the paper's 128.
        fused: width of the output; the paper's 256.
    """

    def __init__(self, inputs: tuple[int, ...], channels: int, fused: int):
        super().__init__()
        if len(inputs) != 3:
            raise ValueError(
                f"network.decoder = '{MGNET}' reads three levels, and network.strides has "
                f"{len(inputs)}: name three, or choose another decoder"
            )
        skip, middle, deep = inputs
        self.arm_deep = AttentionRefinement(deep, channels)
        self.arm_middle = AttentionRefinement(middle, channels)
        self.refine_deep = ConvNorm(channels, channels, 3)
        self.refine_middle = ConvNorm(channels, channels, 3)
        self.fusion = FeatureFusion(skip + channels, fused)

    def forward(self, pyramid: Sequence[Tensor], context_BC11: Tensor) -> list[Tensor]:
        """Finest first: the output, and the two inner maps that auxiliary depth heads read."""
        skip, middle, deep = pyramid
        inner_deep = self.arm_deep(deep) + context_BC11
        up = self.refine_deep(F.interpolate(inner_deep, middle.shape[2:]))
        inner_middle = self.arm_middle(middle) + up
        up = self.refine_middle(F.interpolate(inner_middle, skip.shape[2:]))
        return [self.fusion(skip, up), inner_middle, inner_deep]


class Head(nn.Sequential):
    """3x3 ConvNorm and a 1x1 convolution without bias: features -> logits."""

    def __init__(self, inputs: int, hidden: int, outputs: int):
        super().__init__(ConvNorm(inputs, hidden, 3), nn.Conv2d(hidden, outputs, 1, bias=False))


def _conv_relu(inputs: int, outputs: int, kernel: int, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, 1, kernel // 2 * dilation, dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class AtrousPyramid(nn.Module):
    """ASPP: convolutions of several reaches over the deepest level, beside its global mean.

    Source: Chen et al., Rethinking Atrous Convolution, 2017 (DeepLabV3): rates for stride 8, and
    the dropout of its common implementations.

    Args:
        inputs: channels of the level.
        outputs: of every branch, and of the result.
    """

    def __init__(
        self, inputs: int, outputs: int, rates: Sequence[int] = (12, 24, 36), dropout: float = 0.5
    ):
        super().__init__()
        wide = (_conv_relu(inputs, outputs, 3, rate) for rate in rates)
        self.branches = nn.ModuleList([_conv_relu(inputs, outputs, 1), *wide])
        self.image = _conv_relu(inputs, outputs, 1)
        self.project = _conv_relu((len(rates) + 2) * outputs, outputs, 1)
        self.dropout = nn.Dropout(dropout)

    def forward(self, pyramid: Sequence[Tensor], context_BC11: Tensor) -> list[Tensor]:
        deep = pyramid[-1]
        image = self.image(deep.mean((2, 3), keepdim=True)).expand(-1, -1, *deep.shape[2:])
        found = torch.cat([*(branch(deep) for branch in self.branches), image], 1)
        return [self.dropout(self.project(found))]


class Finest(nn.Module):
    """No decoder: the finest level, of a backbone that has one of its own."""

    def forward(self, pyramid: Sequence[Tensor], context_BC11: Tensor) -> list[Tensor]:
        return [pyramid[0]]


class DenseHead(TaskHead):
    """One decoder and one head: a raw map of some channels at the finest stride.

    The recipe's `network.decoder` says which. With `aspp` the head is DeepLabV3's; with `none` it
    is the two plain convolutions with which published tables divide a SegNet.

    Args:
        name: of the task; its map has it, too.
        inputs: channels of the features, finest first.
        outputs: channels of the map.
    """

    def __init__(self, name: str, inputs: tuple[int, ...], sizes: Network, outputs: int):
        super().__init__()
        self.name = name
        decoder: nn.Module
        head: nn.Module
        if sizes.decoder == MGNET:
            decoder = Decoder(inputs, sizes.channels, sizes.fused)
            head = Head(sizes.fused, sizes.head, outputs)
        elif sizes.decoder == ASPP:
            decoder = AtrousPyramid(inputs[-1], sizes.channels)
            last = nn.Conv2d(sizes.head, outputs, 1)
            head = nn.Sequential(_conv_relu(sizes.channels, sizes.head, 3), last)
        else:
            decoder = Finest()
            first = nn.Conv2d(inputs[0], sizes.head, 3, padding=1)
            head = nn.Sequential(first, nn.Conv2d(sizes.head, outputs, 1))
        self.decoders, self.heads = nn.ModuleDict({name: decoder}), nn.ModuleDict({name: head})

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        features_BChw = self.decoders[self.name](pyramid, context_BC11)[0]
        return {self.name: self.heads[self.name](features_BChw)}


class VectorHead(TaskHead):
    """A linear layer on the context: numbers of the whole image.

    Args:
        name: of the task.
        map_: what its numbers are called.
        outputs: how many they are.
    """

    def __init__(self, name: str, map_: str, sizes: Network, outputs: int):
        super().__init__()
        self.name, self.map = name, map_
        self.decoders = nn.ModuleDict()
        self.heads = nn.ModuleDict({name: nn.Linear(sizes.channels, outputs)})

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        return {self.map: self.heads[self.name](context_BC11.flatten(1))}


def init_fan_in(module: nn.Module) -> None:
    """Normal weights of standard deviation 1/sqrt(fan_in), zero bias: the paper's initialisation
    of every decoder and head but depth's."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            fan_in = layer.in_channels // layer.groups * math.prod(layer.kernel_size)
            nn.init.normal_(layer.weight, std=fan_in**-0.5)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def full(tensor: Tensor) -> Tensor:
    """At least float32, whatever autocast made of it."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


class Normalize(nn.Module):
    """RGB in [0, 1] -> zero mean, unit variance per channel of the pre-training images."""

    def __init__(self, mean: tuple[float, ...], std: tuple[float, ...]):
        super().__init__()
        self.register_buffer("mean_311", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std_311", torch.tensor(std).view(3, 1, 1), persistent=False)
        self.mean_311: Tensor
        self.std_311: Tensor

    def forward(self, image_B3HW: Tensor) -> Tensor:
        return (image_B3HW - self.mean_311) / self.std_311
