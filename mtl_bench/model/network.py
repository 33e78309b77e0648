"""The multi-task network: one backbone, one context module, a decoder and heads per task.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 3.1 and figure 2.
Shapes: B images, C classes, H x W input pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core import config, plugins
from mtl_bench.core.backbone import Backbone, Normalize
from mtl_bench.data.labels import LabelSet
from mtl_bench.model.layers import Decoder, GlobalContext, Head, init_fan_in
from mtl_bench.tasks.depth.pose import PoseNetwork


@dataclass
class Outputs:
    """Predictions at the input's size; what a task that was not asked for would fill is None."""

    semantic_BCHW: Tensor | None = None  # logits
    center_B1HW: Tensor | None = None  # in [0, 1]
    offset_B2HW: Tensor | None = None  # (y, x) to the instance's center, pixels
    inverse_depth: list[Tensor] = field(default_factory=list)  # each B1HW, finest first
    representation: list[Tensor] = field(default_factory=list)  # in training: what decoders read


class Network(nn.Module):
    """What runs at inference. In training mode it also predicts the auxiliary depth maps."""

    def __init__(
        self, backbone: Backbone, sizes: config.Network, classes: int, tasks: tuple[str, ...]
    ):
        super().__init__()
        self.normalize = Normalize(backbone.mean, backbone.std)
        self.backbone = backbone
        self.strides = sizes.strides
        self.min_depth = sizes.min_depth
        inputs = tuple(backbone.channels[stride] for stride in sizes.strides)
        assert len(inputs) == 3
        self.context = GlobalContext(inputs[2], sizes.channels)
        init_fan_in(self.context)

        def decoder() -> Decoder:
            return Decoder(inputs, sizes.channels, sizes.fused)

        self.decoders = nn.ModuleDict()
        self.heads = nn.ModuleDict()
        if "panoptic" in tasks:
            self.decoders["semantic"] = decoder()
            self.decoders["instance"] = decoder()
            self.heads["semantic"] = Head(sizes.fused, sizes.head, classes)
            self.heads["center"] = Head(sizes.fused, sizes.head, 1)
            self.heads["offset"] = Head(sizes.fused, sizes.head, 2)
            init_fan_in(self.decoders)
            init_fan_in(self.heads)
        if "depth" in tasks:
            self.decoders["depth"] = decoder()
            widths = (sizes.fused, sizes.channels, sizes.channels)
            self.heads["depth"] = nn.ModuleList(Head(width, sizes.head, 1) for width in widths)

    def forward(self, image_B3HW: Tensor) -> Outputs:
        size = image_B3HW.shape[2:]
        features = self.backbone(self.normalize(image_B3HW))
        pyramid = [features[stride] for stride in self.strides]
        context = self.context(pyramid[2])
        outputs = Outputs()
        if self.training:
            # Views: a gradient with respect to the last level then leaves out its way through the
            # context module, which has a gradient of its own.
            *pyramid, context = (x.view_as(x) for x in (*pyramid, context))
            outputs.representation = [*pyramid, context]
        if "semantic" in self.decoders:
            semantic = self.decoders["semantic"](pyramid, context)[0]
            instance = self.decoders["instance"](pyramid, context)[0]
            outputs.semantic_BCHW = _resize(self.heads["semantic"](semantic), size)
            outputs.center_B1HW = _resize(self.heads["center"](instance).sigmoid(), size)
            offset = _resize(self.heads["offset"](instance), size)
            outputs.offset_B2HW = offset * self.strides[0]  # the head's unit is one feature cell
        if "depth" in self.decoders:
            maps = self.decoders["depth"](pyramid, context)
            heads = list(self.heads["depth"])  # type: ignore[call-overload]
            for features_BCHW, head in zip(
                maps, heads if self.training else heads[:1], strict=False
            ):
                inverse = head(features_BCHW).sigmoid() / self.min_depth
                outputs.inverse_depth.append(_resize(inverse, size))
        return outputs


class Model(nn.Module):
    """The network and, where depth is trained, the pose network; says which weights are whose."""

    def __init__(self, net: Network, pose: PoseNetwork | None):
        super().__init__()
        self.net = net
        self.pose = pose

    def shared_parameters(self) -> Iterator[nn.Parameter]:
        """Encoder and context module: what all tasks train."""
        yield from self.net.backbone.parameters()
        yield from self.net.context.parameters()

    def task_parameters(self) -> Iterator[nn.Parameter]:
        """Decoders, heads and the pose network: each trained by one task only."""
        yield from self.head_parameters()
        if self.pose is not None:
            yield from self.pose.parameters()

    def head_parameters(self) -> Iterator[nn.Parameter]:
        """Decoders and heads: what the head learning-rate factor applies to."""
        yield from self.net.decoders.parameters()
        yield from self.net.heads.parameters()


def build_model(cell: config.Cell, labels: LabelSet) -> Model:
    """The cell's model with fresh (or, where the cell says so, pre-trained) weights.

    Raises:
        ValueError: an unknown backbone, or an input that the pyramid does not divide.
    """
    sizes, data = cell.recipe.network, cell.recipe.data
    if data.height % sizes.strides[2] or data.width % sizes.strides[2]:
        raise ValueError(
            f"input {data.height}x{data.width} is not divisible by the deepest stride "
            f"{sizes.strides[2]}: change data.height, data.width or network.strides"
        )
    kind = plugins.load("backbones", cell.backbone)
    backbone = kind(strides=sizes.strides, pretrained=cell.pretrained, **cell.backbone_args)
    net = Network(backbone, sizes, len(labels), cell.tasks)
    pose = None
    if "depth" in cell.tasks:
        pose = PoseNetwork(
            sizes.pose, sizes.pose_channels, sizes.pose_scale, cell.pretrained == "timm"
        )
    model = Model(net, pose)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = sizes.batch_norm_momentum
    return model


def _resize(x_BCHW: Tensor, size: torch.Size) -> Tensor:
    """To the input's size, in float32 and with the paper's alignment of corners."""
    return F.interpolate(x_BCHW.float(), size, mode="bilinear", align_corners=True)
