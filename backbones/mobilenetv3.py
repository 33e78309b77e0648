"""MobileNetV3-Large 1.0: searched mobile network; 3.0 M parameters, Apache-2.0 (ra_in1k).

Howard et al., Searching for MobileNetV3, ICCV 2019, arXiv:1905.02244.
"""

from mtl_bench.core.backbone import TimmBackbone


class MobileNetV3(TimmBackbone):
    timm_name = "mobilenetv3_large_100"
