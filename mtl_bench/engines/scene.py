"""What an engine is timed on, and what follows the network: panoptic ids and metric depth."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench import config, geometry, postprocess
from mtl_bench.engines.base import Maps


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


@dataclass
class Finished:
    """What a pass ends with: `postprocess.panoptic`'s ids in 32 bits, and metres."""

    panoptic_BHW: Tensor | None = None
    depth_m_B1HW: Tensor | None = None


class Finish:
    """The last stage: grouping, and depth with its scale from the camera's height.

    The lines are those of training rows (`latency`) and of evaluation, less copies: a full-size
    map that is written once more takes a millisecond or two.
    """

    def __init__(self, subject: Subject, batch: int, device: torch.device):
        self.subject, self.camera = subject, subject.camera.batch(batch, device)

    def __call__(self, maps: Maps) -> Finished:
        subject, camera, done, road_BHW = self.subject, self.camera, Finished(), None
        if maps.class_BHW is not None:
            assert maps.center_B1HW is not None
            assert maps.offset_B2HW is not None
            class_BHW = postprocess.classes(maps.class_BHW)
            road_BHW = class_BHW == subject.road
            done.panoptic_BHW = postprocess.group(
                class_BHW,
                *postprocess.find_centers(maps.center_B1HW, subject.evaluate),
                maps.offset_B2HW,
                subject.things,
                subject.evaluate.stuff_area,
            )
        if maps.inverse_B1HW is not None:
            depth_B1HW = geometry.depth_from_inverse(maps.inverse_B1HW)
            scale_B, _ = postprocess.dgc_scale(
                depth_B1HW,
                camera.K_133,
                camera.camera_height_m_1,
                road_BHW,
                pitch_rad_B=camera.pitch_rad_1,
            )
            done.depth_m_B1HW = depth_B1HW.mul_(scale_B.view(-1, 1, 1, 1))
        return done
