"""The network as it was trained, in float32, nothing fused: what every engine is held against.

Source: torch, as in evaluation.
"""

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Engine, Setting
from mtl_bench.deploy import maps


class Plain(Engine):
    precisions = {"cpu": ("fp32",), "cuda": ("fp32",)}

    def build(self, net: nn.Module, setting: Setting) -> None:
        self.net, self.tasks = net, maps.tasks_of(net)

    def transfer(self, image_BHW3: Tensor) -> Tensor:
        image_BHW3 = super().transfer(image_BHW3)
        image_B3HW = image_BHW3.permute(0, 3, 1, 2)
        return image_B3HW.to(torch.float32, memory_format=torch.channels_last) / 255

    def run(self, image: Tensor) -> dict[str, Tensor]:
        return maps.of_outputs(self.net(image), self.tasks)
