"""torch without a compiler: folded batch normalisation, channels last, weights in the precision."""

from torch import Tensor, nn

from mtl_bench.engines.base import Setting, StridedEngine
from mtl_bench.engines.graph import strided


class Eager(StridedEngine):
    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        self.graph = strided(net, (setting.batch, *setting.size), setting.dtype)

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.graph.names, self.graph(image), strict=True))
