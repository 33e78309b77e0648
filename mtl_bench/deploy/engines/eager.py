"""torch without a compiler: folded batch normalisation, channels last, weights in the precision.

Source: torch.
"""

from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.graph import GraphEngine, strided


class Eager(GraphEngine):
    precisions = {"cpu": ("fp32", "bf16"), "cuda": ("fp32", "bf16", "fp16")}

    def build(self, net: nn.Module, setting: Setting) -> None:
        self.graph = strided(net, (setting.batch, *setting.size), setting.dtype)

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.graph.names, self.graph(image), strict=True))
