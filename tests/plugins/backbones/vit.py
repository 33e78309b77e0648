"""A vision transformer whose one map of features becomes a pyramid.

Source: Dosovitskiy et al., ICLR 2021, by timm; the pyramid as in ViTDet (Li et al., ECCV 2022):
each level is the last map, enlarged by transposed convolutions or pooled. Random weights.
"""

from timm.models.vision_transformer import VisionTransformer
from torch import nn

from mtl_bench.core.backbone import Backbone

PATCH = 16


class ViT(Backbone):
    """
    Args:
        width: of tokens and of every level.
        depth: blocks.
    """

    def __init__(self, strides=(8, 16, 32), pretrained=None, width=24, depth=2):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"this ViT has no pre-trained weights (asked for '{pretrained}')")
        self.body = VisionTransformer(
            embed_dim=width,
            depth=depth,
            num_heads=3,
            patch_size=PATCH,
            num_classes=0,
            global_pool="",
            class_token=False,
            dynamic_img_size=True,
        )
        self.channels = dict.fromkeys(strides, width)
        self.levels = nn.ModuleDict({str(stride): self._level(stride, width) for stride in strides})

    @staticmethod
    def _level(stride: int, width: int) -> nn.Module:
        if stride >= PATCH:
            return nn.MaxPool2d(stride // PATCH) if stride > PATCH else nn.Identity()
        doublings = (PATCH // stride).bit_length() - 1
        return nn.Sequential(*(nn.ConvTranspose2d(width, width, 2, 2) for _ in range(doublings)))

    def forward(self, image_B3HW):
        rows, columns = (size // PATCH for size in image_B3HW.shape[2:])
        tokens_BNC = self.body.forward_features(image_B3HW)
        map_BChw = tokens_BNC.transpose(1, 2).unflatten(2, (rows, columns)).contiguous()
        return {stride: self.levels[str(stride)](map_BChw) for stride in self.channels}
