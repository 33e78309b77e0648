"""A grey picture of the image's size out of one vector, by two linear layers: mean squared error.

Source: the heterogeneous MultiMNIST of arXiv 2505.10347, which classifies one digit and
reconstructs the other. `unexplained` is the share of the truth's variance about the training
split's mean picture that is left; that picture's own is about 1.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.recipe import Network
from mtl_bench.core.task import (
    Frame,
    MapInfo,
    Maps,
    Metric,
    Results,
    Size,
    Task,
    TaskHead,
    Trivial,
)
from mtl_bench.core.terms import Term

HIDDEN = 128  # units of the head's first layer


class Reconstruct(Task):
    of_field = True
    reads_pyramid = False
    terms = (Term("error", "reconstruct", "regression", 1.0),)
    maps: ClassVar[Mapping[str, MapInfo]] = {"grey": MapInfo("grey", words="grey levels")}
    exported = ("grey",)
    columns = (
        Column(
            "unexplained", "reconstruct.unexplained", "1 - R2", -1, 3, in_delta=True, short=True
        ),
        Column("rmse", "reconstruct.rmse", "RMSE", -1, 4),
    )
    words: ClassVar[Mapping[str, str]] = {"trivial": "mean picture"}

    def head(self, inputs: tuple[int, ...], sizes: Network) -> "PictureHead":
        data = self.recipe.data
        return PictureHead(self.name, sizes, (data.height, data.width))

    def activate(self, maps: Maps) -> Maps:
        return {"grey": maps["grey"].sigmoid()}

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        return {self.name: F.mse_loss(maps["grey"][:, 0], batch.fields[self.field])}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        if size not in (None, tuple(maps["grey"].shape[2:])):
            maps = self.resized(maps, size)
        return {"grey": maps["grey"][:, 0]}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [PictureError(self.field, split or self.recipe.evaluate.split)]

    def trivial(self, size: Size) -> "MeanPicture":
        return MeanPicture(self.field)


class PictureHead(TaskHead):
    """The context through one hidden layer to every pixel."""

    def __init__(self, name: str, sizes: Network, size: Size) -> None:
        super().__init__()
        self.name, self.size = name, size
        hidden = nn.Linear(sizes.channels, HIDDEN)
        self.decoders = nn.ModuleDict({name: nn.Sequential(nn.Flatten(), hidden, nn.ReLU())})
        self.heads = nn.ModuleDict({name: nn.Linear(HIDDEN, size[0] * size[1])})

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        hidden_BC = self.decoders[self.name](context_BC11)
        return {"grey": self.heads[self.name](hidden_BC).unflatten(1, (1, *self.size))}


class PictureError(Metric):
    """Squared errors over all pixels of the split, and the truth's own mean and variance there."""

    def __init__(self, field: str, split: str) -> None:
        self.field, self.split = field, split
        self.sums = np.zeros(2)  # frames; squared errors, each the mean of a frame's
        self.pixels_2HW = np.zeros((2, 1, 1))  # sums of the truth and of its square

    def update(self, truth: Frame, result: Frame) -> Frame:
        true_HW = truth[self.field].astype(np.float64)
        self.sums += (1, float(((result["grey"] - true_HW) ** 2).mean()))
        self.pixels_2HW = self.pixels_2HW + np.stack([true_HW, true_HW**2])
        return {}

    def state(self) -> dict[str, NDArray[Any]]:
        return {"sums": self.sums, "pixels": self.pixels_2HW}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.sums = self.sums + state["sums"]
        self.pixels_2HW = self.pixels_2HW + state["pixels"]

    def compute(self) -> dict[str, float]:
        count, errors = self.sums.tolist()
        if not count:
            return {}
        found = {f"reconstruct.{self.field}.rmse": (errors / count) ** 0.5}
        mean_HW, square_HW = self.pixels_2HW / count
        variance = float((square_HW - mean_HW**2).mean())
        if variance > 0:
            found[f"reconstruct.{self.field}.unexplained"] = errors / count / variance
        return found


class MeanPicture(Trivial):
    """The mean picture of the training split."""

    def __init__(self, field: str) -> None:
        self.field, self.count = field, 0
        self.sum_HW: NDArray[np.float64] = np.zeros((1, 1))

    def add(self, truth: Frame) -> None:
        self.sum_HW = self.sum_HW + truth[self.field]
        self.count += 1

    def result(self, count: int, size: Size) -> Results:
        mean_HW = torch.from_numpy(self.sum_HW / self.count).float()
        return {"grey": mean_HW.expand(count, *mean_HW.shape)}
