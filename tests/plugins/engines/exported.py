"""The folded graph as torch.export records it, run operator by operator.

Source: torch.export.
"""

import torch

from mtl_bench.deploy.graph import GraphEngine, strided


class Exported(GraphEngine):
    precisions = {"cpu": ("fp32",), "cuda": ("fp32",)}

    def build(self, net, setting):
        graph = strided(net, (setting.batch, *setting.size))
        shape = (setting.batch, *setting.size, 3)
        example = torch.zeros(shape, dtype=torch.uint8, device=setting.device)
        self.names = graph.names
        self.program = torch.export.export(graph, (example,), strict=False).module()

    def strided(self, image):
        return dict(zip(self.names, self.program(image), strict=True))
