"""One number of the image by a linear head: mean squared error.

Source: the toy problem of GradNorm (Chen et al., ICML 2018, section 4), with a head a task.
`unexplained` is the share of the truth's variance that is left, 1 - R^2; the mean's is 1.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.recipe import Network
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, Trivial
from mtl_bench.core.terms import Term
from mtl_bench.model.layers import VectorHead


class Regress(Task):
    of_field = True
    reads_pyramid = False
    terms = (Term("error", "regress", "regression", 1.0),)
    maps: ClassVar[Mapping[str, MapInfo]] = {"number": MapInfo("number", words="numbers")}
    exported = ("number",)
    columns = (
        Column(
            *("unexplained", "regress.unexplained", "1 - R2", -1, 3),
            in_delta=True,
            short=True,
        ),
        Column("rmse", "regress.rmse", "RMSE", -1, 4),
    )
    words: ClassVar[Mapping[str, str]] = {"trivial": "mean number"}

    def head(self, inputs: tuple[int, ...], sizes: Network) -> VectorHead:
        return VectorHead(self.name, "number", sizes, 1)

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        return {self.name: F.mse_loss(maps["number"], batch.fields[self.field])}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        return {"number": maps["number"]}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [SquaredError(self.field, split or self.recipe.evaluate.split)]

    def trivial(self, size: Size) -> "Mean":
        return Mean(self.field)


class SquaredError(Metric):
    """Sums over the split of 1, the truth, its square and the squared error."""

    def __init__(self, field: str, split: str) -> None:
        self.field, self.split, self.sums = field, split, np.zeros(4)

    def update(self, truth: Frame, result: Frame) -> Frame:
        true, found = float(truth[self.field][0]), float(result["number"][0])
        self.sums += (1, true, true**2, (found - true) ** 2)
        return {}

    def state(self) -> dict[str, NDArray[Any]]:
        return {"sums": self.sums}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.sums = self.sums + state["sums"]

    def compute(self) -> dict[str, float]:
        count, total, squares, errors = self.sums.tolist()
        if not count:
            return {}
        found = {f"regress.{self.field}.rmse": (errors / count) ** 0.5}
        around_mean = squares - total**2 / count
        if around_mean > 0:
            found[f"regress.{self.field}.unexplained"] = errors / around_mean
        return found


class Mean(Trivial):
    """The mean of the training split."""

    def __init__(self, field: str) -> None:
        self.field, self.sum, self.count = field, 0.0, 0

    def add(self, truth: Frame) -> None:
        self.sum += float(truth[self.field][0])
        self.count += 1

    def result(self, count: int, size: Size) -> Results:
        return {"number": torch.full((count, 1), self.sum / self.count)}
