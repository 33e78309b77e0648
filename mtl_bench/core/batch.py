"""What the network and the losses are fed: an image, its camera, and named fields.

Shapes: B samples, N neighbours in time (previous, next), H x W pixels. Pixel centres are integers:
the top-left pixel is (0, 0). Images are RGB in [0, 1]. Depth 0 means no value, label 255 none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass
class Camera:
    """Of a batch of images, or of one without the B axis."""

    K_B33: Tensor  # intrinsics in pixels
    height_m_B: Tensor  # above the ground
    pitch_rad_B: Tensor  # to the ground, positive looks down

    def map(self, change: Callable[[Tensor], Tensor]) -> Camera:
        return Camera(change(self.K_B33), change(self.height_m_B), change(self.pitch_rad_B))


@dataclass
class Batch:
    """Samples of one size.

    `fields` holds all else by name: what the data set has and a task asked for (its neighbours in
    time, ground truth at the frame's own size), and the targets that tasks made of it.
    """

    names: list[str]
    image_B3HW: Tensor  # what the network sees: colour-jittered in training
    camera: Camera | None = None
    fields: dict[str, Tensor] = field(default_factory=dict)

    @property
    def device(self) -> torch.device:
        return self.image_B3HW.device

    def map(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """The same names, every tensor changed."""
        return dataclasses.replace(
            self,
            image_B3HW=change(self.image_B3HW),
            camera=self.camera and self.camera.map(change),
            fields={name: change(value) for name, value in self.fields.items()},
        )

    def to(self, device: torch.device | str) -> Batch:
        """A copy on a device, its image in channels-last memory as the model's weights are."""
        moved = self.map(lambda value: value.to(device, non_blocking=True))
        moved.image_B3HW = moved.image_B3HW.contiguous(memory_format=torch.channels_last)
        return moved

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
            chosen = slice(start, start + size)
            part = self.map(lambda value, chosen=chosen: value[chosen])  # type: ignore[misc]
            parts.append(dataclasses.replace(part, names=self.names[chosen]))
        return parts

    # --- as flat tensors: what processes hand to each other ---------------------------------------

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor by one name; `from_tensors` turns it back."""
        found = {"image": self.image_B3HW}
        if self.camera is not None:
            found |= {f"camera.{name}": value for name, value in vars(self.camera).items()}
        return found | {f"fields.{name}": value for name, value in self.fields.items()}

    @staticmethod
    def from_tensors(names: list[str], tensors: dict[str, Tensor]) -> Batch:
        def below(prefix: str) -> dict[str, Tensor]:
            named = {key.partition("."): value for key, value in tensors.items()}
            return {last: value for (first, _, last), value in named.items() if first == prefix}

        camera = below("camera")
        return Batch(names, tensors["image"], Camera(**camera) if camera else None, below("fields"))


def collate(samples: list[Batch]) -> Batch:
    """Stack single samples (tensors without the B axis) into a batch; they must have one size."""
    names = [name for sample in samples for name in sample.names]
    columns = [sample.tensors() for sample in samples]
    stacked = {key: torch.stack([column[key] for column in columns]) for key in columns[0]}
    return Batch.from_tensors(names, stacked)
