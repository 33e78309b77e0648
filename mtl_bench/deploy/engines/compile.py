"""torch.compile: the same graph as eager's, compiled; on CUDA as CUDA graphs.

Source: torch. On the CPU weights are laid out for its convolutions ("freezing"); CUDA graphs take
the launches of single kernels off the host.
"""

import os
import shutil

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.graph import GraphEngine, strided


class Compiled(GraphEngine):
    precisions = {"cpu": ("fp32", "bf16"), "cuda": ("fp32", "bf16", "fp16")}

    @classmethod
    def lack(cls) -> str | None:
        compiler = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")
        if compiler is None and not torch.cuda.is_available():
            return "needs a C++ compiler: install g++, or name one in the variable CXX"
        return super().lack()

    def build(self, net: nn.Module, setting: Setting) -> None:
        graph = strided(net, (setting.batch, *setting.size), setting.dtype)
        cuda = setting.device.type == "cuda"
        options: dict[str, str | int | bool] = {"triton.cudagraphs": True} if cuda else {}
        self.names = graph.names
        self.compiled = torch.compile(graph, options={"freezing": True, **options})

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        torch.compiler.cudagraph_mark_step_begin()  # the last pass's maps may be overwritten
        return dict(zip(self.names, self.compiled(image), strict=True))
