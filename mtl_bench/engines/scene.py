"""What an engine is timed on, and what follows the network: panoptic ids and metric depth."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.engines.base import Maps
from mtl_bench.tasks.finish import Finish


@dataclass(frozen=True)
class Camera:
    """Of one image, or of the same camera's images in a batch."""

    K_133: Tensor
    camera_height_m_1: Tensor
    pitch_rad_1: Tensor  # positive looks down

    def batch(self, images: int, device: torch.device) -> "Camera":
        return Camera(
            self.K_133.expand(images, 3, 3).to(device),
            self.camera_height_m_1.expand(images).to(device),
            self.pitch_rad_1.expand(images).to(device),
        )


@dataclass(frozen=True)
class Subject:
    """A network and what it looks at.

    Attributes:
        net: a model's `net` in evaluation mode.
        images: uint8 [1,H,W,3] each, as a camera delivers them, all of one size.
        things: class indices that have instances.
        road: class index that the depth's scale is taken from.
        trained: cell_id, slug and recipe of the run that the weights are of; None: random ones.
    """

    net: nn.Module
    backbone: str
    tasks: tuple[str, ...]
    images: list[Tensor]
    camera: Camera
    things: tuple[int, ...]
    road: int
    evaluate: config.Evaluate
    trained: dict[str, Any] | None

    @property
    def size(self) -> tuple[int, int]:
        return self.images[0].shape[1], self.images[0].shape[2]


class Last:
    """The last stage of a pass: what a car needs of the maps, seen by this camera."""

    def __init__(self, subject: Subject, batch: int, device: torch.device):
        self.finish = Finish(subject.things, subject.road, subject.evaluate)
        self.camera = subject.camera.batch(batch, device)

    def __call__(self, maps: Maps) -> dict[str, Tensor]:
        """`finish.Finish`'s results."""
        camera = self.camera
        found: dict[str, Tensor] = self.finish(
            maps.class_BHW,
            maps.center_B1HW,
            maps.offset_B2HW,
            maps.inverse_B1HW,
            camera.K_133,
            camera.camera_height_m_1,
            camera.pitch_rad_1,
        )
        return found
