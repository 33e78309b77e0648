"""One image -> its tasks' results at the image's own size, by a trained model.

Without the camera's height that counts as 1: what is scaled by it is then in camera heights, which
is one scale for all frames of a video.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core import config
from mtl_bench.core.backbone import divisor_of
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.canvas import Image
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.geometry import scale_intrinsics
from mtl_bench.core.view import Segments, Surface, View
from mtl_bench.evaluate.walk import evaluating, predict
from mtl_bench.model import Model

SQUEEZED = 1.25  # a change of shape by more is worth a note


@dataclass(frozen=True)
class Predicted:
    """An image and what the cell's tasks see in it."""

    image_HW3: Image  # RGB
    K_33: NDArray[np.float64]  # intrinsics in pixels of that image
    views: tuple[View, ...]  # in the tasks' order, of the image's size

    @property
    def segments(self) -> Segments | None:
        """Which segment each pixel belongs to, where a task says so."""
        return next((view for view in self.views if isinstance(view, Segments)), None)

    @property
    def surface(self) -> Surface | None:
        """How far away each pixel is, where a task says so."""
        return next((view for view in self.views if isinstance(view, Surface)), None)


class Predictor:
    """A model with all that it takes to be asked about single images.

    Args:
        model: of `cell`, on `device`.
        size: height and width that the network sees; None: those that it was trained with.

    Raises:
        ValueError: a size that the network's deepest stride does not divide.
    """

    def __init__(
        self,
        model: Model,
        cell: config.Cell,
        device: torch.device,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.model, self.cell, self.device = model, cell, device
        self.labels = dataset_of(cell.recipe).labels
        data, stride = cell.recipe.data, divisor_of(cell)
        self.stride = stride
        self.size = size or (data.height, data.width)
        if min(self.size) < stride or any(pixels % stride for pixels in self.size):
            raise ValueError(
                f"size {self.size[0]}x{self.size[1]} is not divisible by the network's deepest "
                f"stride {stride}: try {_near(self.size[0], stride)}x{_near(self.size[1], stride)}"
            )

    def __call__(
        self,
        image_HW3: Image,
        K_33: NDArray[np.floating[Any]],
        camera_height_m: float | None = None,
        pitch_rad: float = 0.0,
    ) -> Predicted:
        """Results of one RGB image of any size.

        Args:
            K_33: intrinsics in pixels of the image.
            camera_height_m: above the ground; None leaves what it scales relative.
            pitch_rad: the camera's to the ground, positive looks down.

        Raises:
            ValueError: a prediction that is not finite.
        """
        own = (image_HW3.shape[0], image_HW3.shape[1])
        batch = self._batch(image_HW3, K_33, camera_height_m or 1.0, pitch_rad)
        tasks = [task.at_size(own) for task in self.model.tasks]
        with evaluating(self.model), torch.inference_mode():
            found = predict(self.model, batch, tasks, own)
        views = (task.view_of(found, camera_height_m) for task in tasks)
        seen = tuple(view for view in views if view is not None)
        return Predicted(image_HW3, np.asarray(K_33, np.float64), seen)

    def unsqueezed(self, height: int, width: int) -> tuple[int, int] | None:
        """A size of the network's input that keeps the shape of an image which this one changes."""
        stretch = self.size[0] * width / (self.size[1] * height)
        if 1 / SQUEEZED < stretch < SQUEEZED:
            return None
        return self.size[0], _near(round(self.size[0] * width / height), self.stride)

    def _batch(
        self, image_HW3: Image, K_33: NDArray[Any], camera_height_m: float, pitch_rad: float
    ) -> Batch:
        height, width = self.size
        rows, columns = image_HW3.shape[:2]
        shrunk = height * width < rows * columns
        if (rows, columns) != self.size:
            how = cv2.INTER_AREA if shrunk else cv2.INTER_CUBIC
            image_HW3 = np.asarray(cv2.resize(image_HW3, (width, height), interpolation=how))
        K_B33 = torch.from_numpy(np.asarray(K_33, np.float32))[None]
        return Batch(
            names=["the image"],
            image_B3HW=torch.from_numpy(image_HW3).permute(2, 0, 1)[None].float() / 255,
            camera=Camera(
                scale_intrinsics(K_B33, width / columns, height / rows),
                torch.tensor([camera_height_m]),
                torch.tensor([pitch_rad]),
            ),
        ).to(self.device)


def _near(pixels: int, stride: int) -> int:
    return max(stride, round(pixels / stride) * stride)
