"""The network as engines run it: 8-bit image in, maps at the finest stride out.

The network's own forward pass ends with maps of the image's size. They hold no more than the
strided ones, which are a 64th of them at stride 8; `upsample` makes what is needed of them.
Shapes: B images, C classes, H x W input pixels, h x w cells of the finest stride.
"""

from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.engines.folding import fold
from mtl_bench.model.network import Network


class Body(nn.Module):
    """Normalised image -> what the last convolutions say, in `names`' order."""

    def __init__(self, net: nn.Module):
        super().__init__()
        # of single-task cells several stand side by side
        self.networks = nn.ModuleList(getattr(net, "networks", [net]))
        networks: Any = self.networks
        tasks = {name for network in networks for name in network.decoders}
        self.names = [name for name, decoder in HEADS.items() if decoder in tasks]

    def forward(self, x_B3HW: Tensor) -> tuple[Tensor, ...]:
        found: dict[str, Tensor] = {}
        networks: Any = self.networks
        for network in networks:
            features = network.backbone(x_B3HW)
            pyramid = [features[stride] for stride in network.strides]
            context = network.context(pyramid[2])
            decoded = {key: d(pyramid, context)[0] for key, d in network.decoders.items()}
            if "semantic" in decoded:
                found["logits"] = network.heads["semantic"](decoded["semantic"])
                found["center"] = network.heads["center"](decoded["instance"])
                found["offset"] = network.heads["offset"](decoded["instance"])
            if "depth" in decoded:
                found["inverse"] = network.heads["depth"][0](decoded["depth"])
        return tuple(found[name] for name in self.names)


HEADS = {"logits": "semantic", "center": "instance", "offset": "instance", "inverse": "depth"}


class Strided(nn.Module):
    """Image uint8 [B,H,W,3] -> float32 maps [B,.,h,w] in the order of `names`.

    `logits`; `center` in [0, 1]; `offset` (y, x) in pixels; `inverse` depth.

    Args:
        body: `Body`, or its folded graph.
        net: whose constants are used; of several networks side by side the first one's, as they
            have the same backbone and recipe.
        dtype: that the body computes in.
    """

    def __init__(self, body: nn.Module, net: nn.Module, names: list[str], dtype: torch.dtype):
        super().__init__()
        first: Network = getattr(net, "networks", [net])[0]
        self.body, self.names, self.dtype = body, names, dtype
        self.stride, self.min_depth = first.strides[0], first.min_depth
        mean_311, std_311 = first.normalize.mean_311, first.normalize.std_311
        self.register_buffer("scale_311", 1 / (255 * std_311), persistent=False)
        self.register_buffer("shift_311", -mean_311 / std_311, persistent=False)
        self.scale_311: Tensor
        self.shift_311: Tensor

    def forward(self, image_BHW3: Tensor) -> tuple[Tensor, ...]:
        image_B3HW = image_BHW3.permute(0, 3, 1, 2).float() * self.scale_311 + self.shift_311
        raw = dict(zip(self.names, self.body(image_B3HW.to(self.dtype)), strict=True))
        maps = {name: map_.float() for name, map_ in raw.items()}
        if "logits" in maps:
            maps["center"] = maps["center"].sigmoid()
            maps["offset"] = maps["offset"] * self.stride
        if "inverse" in maps:
            maps["inverse"] = maps["inverse"].sigmoid() / self.min_depth
        return tuple(maps[name] for name in self.names)


def strided(
    net: nn.Module, shape: tuple[int, int, int], dtype: torch.dtype = torch.float32
) -> Strided:
    """The graph of a network in evaluation mode, folded, channels last; the network stays as it is.

    Args:
        shape: B, H, W.
        dtype: of weights and activations; folding is done in float32 before.
    """
    body = Body(net)
    device = next(net.parameters()).device
    example_B3HW = torch.zeros(shape[0], 3, *shape[1:], device=device)
    folded = fold(body, example_B3HW.contiguous(memory_format=torch.channels_last)).to(dtype)
    graph = Strided(folded, net, body.names, dtype)
    for module in graph.modules():
        module.training = False  # an exported graph has no eval()
    return graph.to(memory_format=torch.channels_last)
