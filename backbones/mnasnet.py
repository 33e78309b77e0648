"""MNASNet-B1 1.0: latency-aware searched network; 3.1 M parameters, Apache-2.0 (rmsp_in1k).

Tan et al., MnasNet: Platform-Aware Neural Architecture Search for Mobile, CVPR 2019,
arXiv:1807.11626.
"""

from mtl_bench.core.backbone import TimmBackbone


class MNASNet(TimmBackbone):
    timm_name = "mnasnet_100"
