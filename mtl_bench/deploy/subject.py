"""A network as it is deployed, and the images that it looks at."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core import config, geometry
from mtl_bench.core.backbone import check_size
from mtl_bench.core.batch import Batch, Camera, collate
from mtl_bench.core.config import Cell, Recipe, load_recipe
from mtl_bench.core.device import Compute, initial_weights
from mtl_bench.core.task import Task, tasks_of_cell
from mtl_bench.data.samples import open_samples
from mtl_bench.deploy import maps
from mtl_bench.deploy.maps import Last
from mtl_bench.model import Model, build_model

IMAGES = 50  # distinct ones
EXAMPLES = 16  # for int8
BUILT_IN = "small"  # recipe of the built-in frames that stand in where no data set is given
SEED = 0


@dataclass(frozen=True)
class Subject:
    """A network and what it looks at.

    Attributes:
        net: a model's `net` in evaluation mode.
        images: uint8 [1,H,W,3] each, as a camera delivers them, all of one size.
        trained: cell_id, slug and recipe of the run that the weights are of; None: random ones.
        examples: images of the training split, for engines in int8; none where it is not asked for.
    """

    net: nn.Module
    backbone: str
    tasks: tuple[Task, ...]
    images: list[Tensor]
    camera: Camera
    trained: dict[str, Any] | None
    examples: list[Tensor] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        return self.images[0].shape[1], self.images[0].shape[2]

    def last(self, batch: int, device: torch.device) -> Last:
        return Last(self.tasks, on_device(self.camera, batch, device))


def untrained(
    backbone: str, recipe: str | None, tasks: tuple[str, ...], settings: Iterable[str] = ()
) -> tuple[Cell, Model]:
    """A cell that nobody trained, and its model with random weights, the same every time.

    Args:
        recipe: None: the paper's network, and the frames of the default recipe to look at.
        settings: key=value, as `config.override` takes them.
    """
    chosen = load_recipe(recipe) if recipe else replace(Recipe(), data=load_recipe(BUILT_IN).data)
    cell = config.override(Cell(chosen, backbone, method="", tasks=tasks), settings)
    with initial_weights(SEED):
        return cell, build_model(cell, tasks_of_cell(cell))


def subject(
    cell: Cell,
    model: Model,
    size: tuple[int, int],
    data: Path,
    device: torch.device,
    trained: bool,
    images: int = IMAGES,
    examples: int = 0,
) -> Subject:
    """A network and the first frames at a size: of the evaluation split, and `examples` of the
    training split.

    Raises:
        ValueError: a size that the network cannot take.
    """
    check_size(cell, size, "--size")

    def first(split: str, count: int) -> tuple[list[Tensor], Camera]:
        looks = open_samples(cell.recipe, (), split, data, training=False)  # at images alone
        samples = [looks.sample(n, None) for n in range(min(count, len(looks)))]
        camera = collate(samples[:1]).camera
        assert camera is not None
        found, K_133 = prepare(
            (sample.image_B3HW for sample in samples),
            camera.K_B33[0],
            config.Latency(passes=count, height=size[0], width=size[1]),
            pin=False,
        )
        hosts = [host.permute(0, 2, 3, 1).contiguous() for host in found]
        return hosts, replace(camera, K_B33=K_133)

    hosts, camera = first(cell.recipe.evaluate.images, images)
    net = model.net.eval()
    if not trained:
        (network,) = maps.networks_of(net)
        network.like_trained(hosts[0].permute(0, 3, 1, 2) / 255)
    if device.type == "cuda":
        hosts = [host.pin_memory() for host in hosts]
    origin = {"cell_id": cell.id, "slug": cell.slug, "recipe": cell.recipe.name}
    return Subject(
        net=Compute(device).place(net),
        backbone=cell.backbone,
        tasks=maps.tasks_of(net),
        images=hosts,
        camera=camera,
        trained=origin if trained else None,
        examples=first("train", examples)[0] if examples else [],
    )


def on_device(camera: Camera, images: int, device: torch.device) -> Camera:
    """One camera's values for so many images."""
    return camera.map(lambda value: value.expand(images, *value.shape[1:]).to(device))


def prepare(
    images: Iterable[Batch | Tensor], K_33: Tensor, latency: config.Latency, pin: bool
) -> tuple[list[Tensor], Tensor]:
    """Host images, each uint8 [1,3,H,W] as a camera delivers them, and their intrinsics [1,3,3].

    Raises:
        ValueError: no images.
    """
    hosts = []
    for image_1CHW in itertools.islice(_single_images(images), max(latency.passes, 1)):
        image_1CHW = image_1CHW.detach().cpu()
        size = (latency.height or image_1CHW.shape[2], latency.width or image_1CHW.shape[3])
        if image_1CHW.dtype == torch.uint8:
            image_1CHW = image_1CHW / 255
        scale = (size[1] / image_1CHW.shape[3], size[0] / image_1CHW.shape[2])
        if scale != (1, 1):
            image_1CHW = F.interpolate(image_1CHW, size, mode="bilinear", antialias=True)
        host = (image_1CHW.clamp(0, 1) * 255).round().to(torch.uint8).contiguous()
        hosts.append(host.pin_memory() if pin else host)
    if not hosts:
        raise ValueError("no images to time: the evaluation split is empty")
    return hosts, geometry.scale_intrinsics(K_33[None].float().cpu(), *scale)


def _single_images(images: Iterable[Batch | Tensor]) -> Iterator[Tensor]:
    for item in images:
        image = item.image_B3HW if isinstance(item, Batch) else item
        yield from (image if image.dim() == 4 else image[None]).split(1)
