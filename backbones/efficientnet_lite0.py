"""EfficientNet-Lite0: B0 without squeeze-and-excite; 3.4 M parameters, Apache-2.0 (ra_in1k).

Tan, Le, EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks, ICML 2019,
arXiv:1905.11946; the Lite variant is the TensorFlow team's.
"""

from mtl_bench.core.backbone import TimmBackbone


class EfficientNetLite0(TimmBackbone):
    timm_name = "efficientnet_lite0"
