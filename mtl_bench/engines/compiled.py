"""torch.compile: on the CPU with weights laid out for its convolutions ("freezing"), on CUDA as
CUDA graphs, which take the launches of single kernels off the host."""

import torch
from torch import Tensor, nn

from mtl_bench.engines.base import Maps, Setting
from mtl_bench.engines.eager import Eager


class Compiled(Eager):
    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        cuda = setting.device.type == "cuda"
        options: dict[str, str | int | bool] = {"triton.cudagraphs": True} if cuda else {}
        self._run = torch.compile(self.graph, options={"freezing": True, **options})

    def network(self, image: Tensor) -> Maps:
        torch.compiler.cudagraph_mark_step_begin()  # the last pass's maps may be overwritten
        return super().network(image)

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.graph.names, self._run(image), strict=True))
