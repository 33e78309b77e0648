"""Networks with weights as training leaves them, without training: for what runs networks."""

import functools

import torch
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.engines.scene import Camera, Subject
from mtl_bench.model import Model, build_model

SIZE = (64, 128)


@functools.cache
def model(backbone: str = "tiny", tasks: tuple[str, ...] = config.TASKS) -> Model:
    """Statistics, factors and shifts of batch normalisations are drawn, so that they matter; the
    heads are strong enough for clear classes and a few centers."""
    torch.manual_seed(0)
    found = build_model(Cell(load_recipe("smoke"), backbone, "", tasks), CITYSCAPES20)
    for module in found.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.5, 2)
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0, 0.3)
    if "panoptic" in tasks:
        with torch.no_grad():
            found.net.heads["semantic"][1].weight *= 5
    return found.eval()


def images(count: int, size: tuple[int, int] = SIZE) -> list[Tensor]:
    """uint8 [1,H,W,3], smooth enough that neighbours look alike."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(count, 3, 4, 8, generator=generator)
    fine = nn.functional.interpolate(coarse, size, mode="bicubic").clamp(0, 1)
    return list((fine * 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous().split(1))


def subject(
    backbone: str = "tiny", tasks: tuple[str, ...] = config.TASKS, count: int = 3
) -> Subject:
    K_133 = torch.tensor([[[115.0, 0, 63.5], [0, 115, 31.5], [0, 0, 1]]])
    return Subject(
        net=model(backbone, tasks).net,
        backbone=backbone,
        tasks=tasks,
        images=images(count),
        camera=Camera(K_133, torch.tensor([1.4]), torch.zeros(1)),
        things=CITYSCAPES20.things,
        road=CITYSCAPES20.index("road"),
        evaluate=load_recipe("smoke").evaluate,
        trained=None,
    )
