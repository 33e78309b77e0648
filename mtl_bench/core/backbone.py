"""What a backbone is: an image in, a feature pyramid out, keyed by stride; or one vector."""

from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import timm
import torch
from torch import Tensor, nn

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell

VECTOR = 0  # stands for a stride where a backbone gives one vector


class Backbone(nn.Module):
    """Base of every file in `backbones/`.

    A subclass sets `channels` and implements `forward`. Its constructor takes `strides`, the
    pyramid levels that will be read (deeper ones need not be built), and `pretrained`.

    One that gives a vector says `vector = True`. Its constructor takes `size`, the input's height
    and width, and `outputs`, how many numbers the vector has, in place of `strides`; VECTOR is the
    only key of `channels` and of what `forward` gives, [B, outputs].
    """

    vector: ClassVar[bool] = False

    mean: tuple[float, float, float] = (
        0.485,
        0.456,
        0.406,
    )  # RGB in [0, 1], what it was trained with
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    channels: dict[int, int]  # stride -> channels
    offered: ClassVar[tuple[int, ...]] = (2, 4, 8, 16, 32)  # strides of what it can give
    divisor: ClassVar[int] = 1  # of height and width, where that is more than the deepest stride
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {"train": ("stem",)}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        """Normalised image -> {stride: features [B, channels[stride], H/stride, W/stride]}."""
        raise NotImplementedError

    def stem(self) -> Iterable[nn.Parameter]:
        """The parameters before the first stage, for `backbone.frozen=stem`."""
        raise ValueError(f"{type(self).__name__} names no stem; set backbone.frozen=all")


class TimmBackbone(Backbone):
    """Any timm model with `features_only`: a subclass needs `timm_name` and a docstring.

    Args:
        strides: pyramid levels to return; stages deeper than the last are not built.
        pretrained: None for random weights, "timm" for timm's own (hub or local cache), or the
            path of a .pth or .safetensors file with timm's parameter names.
    """

    timm_name: str
    output_stride: ClassVar[int] = 32  # 8 or 16: the stages behind it are dilated in place of that

    def __init__(self, strides: tuple[int, ...] = (8, 16, 32), pretrained: str | None = None):
        super().__init__()
        overlay = None
        if pretrained not in (None, "timm"):
            if not Path(str(pretrained)).is_file():
                raise ValueError(
                    f"no weights file '{pretrained}'; --pretrained takes 'timm' or a file"
                )
            overlay = {"file": str(pretrained)}
        dilated = {} if self.output_stride == 32 else {"output_stride": self.output_stride}
        deepest = 32 if dilated and max(strides) == self.output_stride else max(strides)
        levels = tuple(range(deepest.bit_length() - 1))  # stride 2 is level 0
        self.pyramid = timm.create_model(
            self.timm_name,
            pretrained=pretrained is not None,
            pretrained_cfg_overlay=overlay,
            features_only=True,
            out_indices=levels,
            **dilated,
        )
        info = self.pyramid.feature_info
        reductions = dict(zip(info.reduction(), info.channels(), strict=True))
        self.channels = {stride: reductions[stride] for stride in strides}
        self._stride_of_level = info.reduction()
        config = self.pyramid.default_cfg if pretrained else {}
        self.mean = config.get("mean", Backbone.mean)
        self.std = config.get("std", Backbone.std)

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        features = self.pyramid(image_B3HW)
        found = dict(zip(self._stride_of_level, features, strict=True))
        return {stride: found[stride] for stride in self.channels}

    def stem(self) -> Iterable[nn.Parameter]:
        """All that the finest level is made of."""
        training = self.training
        self.eval()
        finest = self.pyramid(torch.zeros(1, 3, *2 * [4 * max(self._stride_of_level)]))[0]
        self.train(training)
        own = list(self.parameters())
        found = torch.autograd.grad(finest.sum(), own, allow_unused=True)
        return [p for p, gradient in zip(own, found, strict=True) if gradient is not None]


def divisor_of(cell: Cell) -> int:
    """What the height and width of a cell's images are multiples of."""
    backbone = plugins.load("backbones", cell.backbone)
    return 1 if backbone.vector else int(max(cell.recipe.network.strides[-1], backbone.divisor))
