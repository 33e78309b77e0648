"""What the network and the losses are fed: one dataclass, documented once.

Shapes: B samples, N context frames (previous, next), H x W pixels. Pixel centres are integers:
the top-left pixel is (0, 0). Images are RGB in [0, 1]. Depth 0 means no value, label 255 none.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass
class Batch:
    names: list[str]  # city_sequence_frame, or KITTI's drive_camera_frame
    image_B3HW: Tensor  # what the network sees: colour-jittered in training
    K_B33: Tensor  # intrinsics in pixels of image_B3HW
    camera_height_m_B: Tensor
    camera_pitch_rad_B: Tensor  # to the ground, positive looks down

    # Video, absent where no task asks for it. Order: previous, next.
    context_BN3HW: Tensor | None = None  # jittered like the image: the pose network's input
    clean_B3HW: Tensor | None = None  # without jitter: what the photometric loss compares
    clean_context_BN3HW: Tensor | None = None
    reprojection_mask_BHW: Tensor | None = None  # bool; False on sky, ego vehicle and padding

    # Training targets of the panoptic task
    semantic_BHW: Tensor | None = None  # int64 class index, 255 = ignored
    semantic_weight_BHW: Tensor | None = None  # 1, more on small instances, 0 on padding
    center_B1HW: Tensor | None = None  # heat map in [0, 1]
    center_weight_B1HW: Tensor | None = None  # 0 on void and crowd
    offset_B2HW: Tensor | None = None  # (y, x) from a pixel to its instance's center, pixels
    offset_weight_B1HW: Tensor | None = None  # 1 on instances that are no crowd

    # Ground truth of an evaluation split, at the frame's own size
    instance_ids_BHW: Tensor | None = None  # int32, as Cityscapes writes them (26001, 7, ...)
    depth_m_BHW: Tensor | None = None  # 0 = no value

    def to(self, device: torch.device | str, channels_last: bool = False) -> Batch:
        """A copy on a device; images in channels-last memory where asked for."""
        moved: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                value = value.to(device, non_blocking=True)
                if channels_last and field.name == "image_B3HW":
                    value = value.contiguous(memory_format=torch.channels_last)
            moved[field.name] = value
        return Batch(**moved)

    def split(self, size: int) -> list[Batch]:
        """Consecutive parts of that many samples, for what does not fit into memory at once.

        Raises:
            ValueError: a size that does not divide the batch.
        """
        count = len(self.names)
        if size < 1 or count % size:
            raise ValueError(
                f"recipe.optim.micro_batch = {size} does not divide a batch of {count}; "
                f"set it to a divisor of recipe.optim.batch"
            )
        parts = []
        for start in range(0, count, size):
            part: dict[str, Any] = {}
            for field in dataclasses.fields(self):
                value = getattr(self, field.name)
                part[field.name] = None if value is None else value[start : start + size]
            parts.append(Batch(**part))
        return parts


def collate(samples: list[Batch]) -> Batch:
    """Stack single samples (tensors without the B axis) into a batch; they must have one size."""
    merged: dict[str, Any] = {}
    for field in dataclasses.fields(Batch):
        values = [getattr(sample, field.name) for sample in samples]
        if field.name == "names":
            merged["names"] = [name for names in values for name in names]
        else:
            merged[field.name] = None if values[0] is None else torch.stack(values)
    return Batch(**merged)
