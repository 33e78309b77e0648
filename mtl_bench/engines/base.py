"""The contract of an engine: an image as a camera delivers it in, maps of the image's size out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mtl_bench.engines.upsample import Upsample

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclass(frozen=True)
class Setting:
    """What an engine is made for; its graph has this fixed size."""

    batch: int
    height: int  # pixels
    width: int
    precision: str
    device: torch.device
    threads: int

    @property
    def size(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def dtype(self) -> torch.dtype:
        return DTYPES[self.precision]


@dataclass
class Maps:
    """What post-processing starts from, float32; what the tasks lack is None. See model.Outputs."""

    class_BHW: Tensor | None = None  # index of the largest logit, uint8 (of plain int64)
    center_B1HW: Tensor | None = None
    offset_B2HW: Tensor | None = None  # pixels
    inverse_B1HW: Tensor | None = None
    logits_BChw: Tensor | None = None  # at the image's size or at the finest stride


class InferenceEngine(ABC):
    """Base of every engine.

    Args:
        net: a model's `net` in evaluation mode, on the setting's device.
        setting: what the engine is made for.
    """

    package: ClassVar[str] = "torch"  # its version stands in the row

    def __init__(self, net: nn.Module, setting: Setting):
        self.setting = setting

    def transfer(self, image_BHW3: Tensor) -> Any:
        """8-bit RGB from host memory to where the network runs."""
        return image_BHW3.to(self.setting.device, non_blocking=True)

    @abstractmethod
    def network(self, image: Any) -> Maps:
        """What `transfer` returned -> maps of the image's size; the next call may reuse them."""


class StridedEngine(InferenceEngine):
    """Base of engines that run the graph of `graph.Strided`: subclasses say how."""

    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        self._upsample: Upsample | None = None

    def network(self, image: Any) -> Maps:
        maps = self.strided(image)
        first = next(iter(maps.values()))
        if self._upsample is None:
            small = (first.shape[2], first.shape[3])
            self._upsample = Upsample(small, self.setting.size, first.device)
        large = Maps()
        if "logits" in maps:
            large.logits_BChw = maps["logits"]
            large.class_BHW = self._upsample.classes(maps["logits"])
            large.center_B1HW = self._upsample.values(maps["center"])
            large.offset_B2HW = self._upsample.values(maps["offset"])
        if "inverse" in maps:
            large.inverse_B1HW = self._upsample.values(maps["inverse"])
        return large

    @abstractmethod
    def strided(self, image: Any) -> dict[str, Tensor]:
        """Maps at the finest stride by the names of `graph.Strided`."""
