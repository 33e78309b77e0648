"""The network as it was trained, in float32, nothing fused: what every engine is held against."""

from torch import Tensor, nn

from mtl_bench.engines.base import InferenceEngine, Maps, Setting


class Plain(InferenceEngine):
    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        self.net = net

    def transfer(self, image_BHW3: Tensor) -> Tensor:
        image_BHW3 = super().transfer(image_BHW3)
        return image_BHW3.permute(0, 3, 1, 2).float().contiguous() / 255

    def network(self, image: Tensor) -> Maps:
        out = self.net(image)
        logits_BCHW = out.semantic_BCHW
        return Maps(
            class_BHW=None if logits_BCHW is None else logits_BCHW.argmax(1),
            center_B1HW=out.center_B1HW,
            offset_B2HW=out.offset_B2HW,
            inverse_B1HW=out.inverse_depth[0] if out.inverse_depth else None,
            logits_BChw=logits_BCHW,
        )
