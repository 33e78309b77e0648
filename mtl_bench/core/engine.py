"""The contract of an engine: what runs a network fast, from a camera's image to named maps.

One engine a file; its name is the file's. Many engines run one and the same graph:
`mtl_bench.deploy.graph.GraphEngine` is the base of those.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mtl_bench.core import plugins
from mtl_bench.core.device import DTYPES

PRECISIONS = {**DTYPES, "int8": torch.int8}  # what networks can run in, and its numbers' type


@dataclass(frozen=True)
class Setting:
    """What an engine is made for; its graph has this fixed size.

    Attributes:
        examples: uint8 [1,H,W,3] images of the training split, for int8: what is measured on them
            is the range of every map.
    """

    batch: int
    height: int  # pixels
    width: int
    precision: str
    device: torch.device
    threads: int
    examples: tuple[Tensor, ...] = field(default=(), compare=False, repr=False)

    @property
    def size(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def dtype(self) -> torch.dtype:
        return PRECISIONS[self.precision]


class Engine(ABC):
    """Base of every engine.

    A subclass declares `precisions` as a literal, which is read without importing the file, and
    implements `build` and `run`. What it imports beyond torch it imports inside `build`.

    Args:
        net: a model's `net` in evaluation mode, on the setting's device.
        setting: what the engine is made for.
    """

    precisions: ClassVar[Mapping[str, tuple[str, ...]]]  # kind of device -> some of PRECISIONS
    packages: ClassVar[tuple[str, ...]] = ("torch",)  # it imports; the first's version is in rows
    extra: ClassVar[tuple[str, ...]] = ()  # what to pip install where one of them is lacking

    def __init__(self, net: nn.Module, setting: Setting):
        self.setting = setting
        self.build(net, setting)

    @classmethod
    def lack(cls) -> str | None:
        """Why the engine cannot run here, and what would change that; None where it can."""
        return plugins.lack(cls.packages, cls.extra)

    @abstractmethod
    def build(self, net: nn.Module, setting: Setting) -> None:
        """Prepare everything that `run` needs.

        Raises:
            ValueError: this machine does not compute in the setting's precision.
        """

    def transfer(self, image_BHW3: Tensor) -> Any:
        """8-bit RGB from host memory to where the network runs."""
        return image_BHW3.to(self.setting.device, non_blocking=True)

    @abstractmethod
    def run(self, image: Any) -> dict[str, Tensor]:
        """What `transfer` returned -> maps by name; the next call may reuse their memory.

        Float32 maps of the image's size. A map that is reduced to classes may stay at the finest
        stride; beside it stands the index of its largest channel at the image's size.
        """
