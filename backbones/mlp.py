"""Fully connected layers over the pixels of a small image: one vector, for made problems.

Not a published network. The last layer is linear, so that `outputs` is how many functions of the
image the tasks can share: the trunk's capacity. SiLU leaves no unit dead, by which seeds would
differ.
"""

from itertools import pairwise

from torch import Tensor, nn

from mtl_bench.core.backbone import VECTOR, Backbone


class MLP(Backbone):
    """
    Args:
        size: height and width of the input.
        outputs: width of the vector, `recipe.network.channels`.
        hidden: width of the layers before it.
        layers: how many there are of those.
    """

    vector = True
    mean = (0.5, 0.5, 0.5)  # of numbers that are uniform in [0, 1]
    std = (12**-0.5,) * 3

    def __init__(
        self,
        size: tuple[int, int] = (64, 64),
        outputs: int = 64,
        pretrained: str | None = None,
        hidden: int = 64,
        layers: int = 2,
    ):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"there are no pre-trained weights for this: '{pretrained}'")
        widths = [3 * size[0] * size[1], *[hidden] * layers, outputs]
        steps = [part for i, o in pairwise(widths) for part in (nn.Linear(i, o), nn.SiLU())]
        self.layers = nn.Sequential(nn.Flatten(), *steps[:-1])
        self.channels = {VECTOR: outputs}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        return {VECTOR: self.layers(image_B3HW)}
