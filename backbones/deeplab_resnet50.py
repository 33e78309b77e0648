"""ResNet-50 with output stride 8, DeepLabV3's encoder; 23.5 M parameters, Apache-2 weights in timm.

Chen et al., Rethinking Atrous Convolution for Semantic Image Segmentation, 2017, arXiv:1706.05587:
the last two stages are dilated instead of strided. For recipes with `network.strides = [8]` and
`network.decoder = "aspp"`; with three heads of 256 channels it has 71.9 M parameters.
"""

from mtl_bench.core.backbone import TimmBackbone


class DeepLabResNet50(TimmBackbone):
    timm_name = "resnet50"
    output_stride = 8
    offered = (8,)
    divisor = 8

    def __init__(self, strides: tuple[int, ...] = (8,), pretrained: str | None = None):
        super().__init__(strides, pretrained)
