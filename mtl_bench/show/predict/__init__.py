"""One image -> panoptic segments and depth at the image's own size, by a trained model.

The camera's height above the road turns depth into metres (`depth_scale`: the dense geometrical
constraint). Without it the height counts as 1: depth is then in camera heights, which is one scale
for all frames of a video.
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core import config
from mtl_bench.core.geometry import scale_intrinsics
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import LabelSet, labels_of
from mtl_bench.evaluate.walk import evaluating, predict
from mtl_bench.model import Model
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.targets import class_of_instance_id

METRES, HEIGHTS, UNSCALED = "m", "camera heights", "network units"
SQUEEZED = 1.25  # a change of shape by more is worth a note
NO_SURFACE = ("ego vehicle", "sky")  # classes that have no depth

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Predicted:
    """An image, what is in it and where; what the cell's tasks lack is None."""

    image_HW3: Image  # RGB
    K_33: NDArray[np.float64]  # intrinsics in pixels of that image
    instance_ids_HW: NDArray[np.int32] | None  # Cityscapes' ids; 0 is void
    class_HW: NDArray[np.uint8] | None  # class index of those, IGNORE where void
    depth_HW: NDArray[np.float32] | None  # in `unit`; 0 on sky and ego vehicle
    unit: str | None  # METRES, HEIGHTS, or UNSCALED where no ground was found to take a scale from
    scale_source: str | None  # one of postprocess.DGC_SOURCES
    camera_height: float | None  # above the road, in `unit`; None without a scale


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
        self.labels = labels_of(cell.recipe.data.dataset)
        data, stride = cell.recipe.data, cell.recipe.network.strides[2]
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
        """Segments and depth of one RGB image of any size.

        Args:
            K_33: intrinsics in pixels of the image.
            camera_height_m: above the road; None leaves depth relative.
            pitch_rad: the camera's to the road, positive looks down.

        Raises:
            ValueError: a predicted depth that is not finite.
        """
        own = (image_HW3.shape[0], image_HW3.shape[1])
        batch = self._batch(image_HW3, K_33, camera_height_m or 1.0, pitch_rad)
        cell = _for_size(self.cell, own)
        with evaluating(self.model), torch.inference_mode():
            found = predict(self.model, batch, cell, self.labels, own)
        ids_HW = class_HW = depth_HW = unit = source = height = None
        surface_HW: NDArray | None = None
        if found.instance_ids_BHW is not None and found.class_BHW is not None:
            ids_HW = found.instance_ids_BHW[0].cpu().numpy()
            pixel_class_HW = found.class_BHW[0].cpu().numpy()
            ids_HW = _with_unevaluated(ids_HW, pixel_class_HW, self.labels)
            class_HW = class_of_instance_id(self.labels)[ids_HW]
            surface_HW = ~np.isin(pixel_class_HW, without_surface(self.labels))
        if found.depth_B1HW is not None:
            assert found.dgc_scale_B is not None
            assert found.dgc_source_B is not None
            code = int(found.dgc_source_B[0])
            source = postprocess.DGC_SOURCES[code]
            unit = METRES if camera_height_m else HEIGHTS
            depth_HW = found.depth_B1HW[0, 0].cpu().numpy()
            if code == postprocess.FAILED:
                unit = UNSCALED
            else:
                depth_HW = depth_HW * np.float32(found.dgc_scale_B[0].item())
                height = camera_height_m or 1.0
            if surface_HW is not None:
                depth_HW = depth_HW * surface_HW
        K = np.asarray(K_33, np.float64)
        return Predicted(image_HW3, K, ids_HW, class_HW, depth_HW, unit, source, height)

    def unsqueezed(self, height: int, width: int) -> tuple[int, int] | None:
        """A size of the network's input that keeps the shape of an image which this one changes."""
        stretch = self.size[0] * width / (self.size[1] * height)
        if 1 / SQUEEZED < stretch < SQUEEZED:
            return None
        return self.size[0], _near(round(self.size[0] * width / height), self.stride)

    def _batch(
        self, image_HW3: Image, K_33: NDArray, camera_height_m: float, pitch_rad: float
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
            K_B33=scale_intrinsics(K_B33, width / columns, height / rows),
            camera_height_m_B=torch.tensor([camera_height_m]),
            camera_pitch_rad_B=torch.tensor([pitch_rad]),
        ).to(self.device)


def without_surface(labels: LabelSet) -> list[int]:
    """Class indices of sky and, where it is a class, ego vehicle."""
    return [i for i, label in enumerate(labels.labels) if label.name in NO_SURFACE]


def _with_unevaluated(ids_HW: NDArray, class_HW: NDArray, labels: LabelSet) -> NDArray[np.int32]:
    """Metrics see no class that is not evaluated, a viewer does: its bare label id."""
    label_ids = labels.label_id_of_class()
    unevaluated = [i for i in range(len(labels)) if i not in labels.evaluated]
    shown_HW = np.isin(class_HW, unevaluated)
    return np.where(shown_HW, label_ids[class_HW], ids_HW).astype(np.int32)


def _for_size(cell: config.Cell, size: tuple[int, int]) -> config.Cell:
    """Its post-processing's lengths and areas are pixels of the recipe's size: as many of this."""
    data, ev = cell.recipe.data, cell.recipe.evaluate
    times = (size[0] * size[1] / (data.height * data.width)) ** 0.5
    kernel = max(3, 2 * round((ev.nms_kernel * times - 1) / 2) + 1)
    scaled = replace(ev, nms_kernel=kernel, stuff_area=round(ev.stuff_area * times**2))
    return replace(cell, recipe=replace(cell.recipe, evaluate=scaled))


def _near(pixels: int, stride: int) -> int:
    return max(stride, round(pixels / stride) * stride)
