"""ResNet-18: the paper's choice; 11.2 M parameters, BSD-3 weights in timm (a1_in1k).

He, Zhang, Ren, Sun, Deep Residual Learning for Image Recognition, CVPR 2016, arXiv:1512.03385.
"""

from mtl_bench.core.backbone import TimmBackbone


class ResNet18(TimmBackbone):
    timm_name = "resnet18"
