"""One class of the image by a linear head: cross-entropy and accuracy.

Source: as in MultiMNIST (Sener and Koltun, NeurIPS 2018). The classes are the data set's.
"""

from collections import Counter
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


class Classify(Task):
    of_field = True
    reads_pyramid = False
    kind = "classification"
    terms = (Term("error", "classify", "classification", 1.0),)
    maps: ClassVar[Mapping[str, MapInfo]] = {"logits": MapInfo("logits", words="logits")}
    exported = ("class",)
    columns = (
        Column(
            *("accuracy", "classify.accuracy", "accuracy", +1, 1, "%"),
            scale=100,
            in_delta=True,
            short=True,
        ),
    )
    words: ClassVar[Mapping[str, str]] = {"trivial": "most frequent class"}

    def head(self, inputs: tuple[int, ...], sizes: Network) -> VectorHead:
        return VectorHead(self.name, "logits", sizes, len(self.labels))

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        truth_B = batch.fields[self.field][:, 0].long()
        return {self.name: F.cross_entropy(maps["logits"].float(), truth_B)}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        return {"class": maps["logits"].argmax(1)}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [Accuracy(self.field, split or self.recipe.evaluate.split)]

    def trivial(self, size: Size) -> "Most":
        return Most(self.field)


class Accuracy(Metric):
    """Share of the frames whose class is right."""

    def __init__(self, field: str, split: str) -> None:
        self.field, self.split, self.sums = field, split, np.zeros(2, np.int64)  # right ones, all

    def update(self, truth: Frame, result: Frame) -> Frame:
        self.sums += (int(result["class"]) == int(truth[self.field][0]), 1)
        return {}

    def state(self) -> dict[str, NDArray[Any]]:
        return {"sums": self.sums}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.sums = self.sums + state["sums"]

    def compute(self) -> dict[str, float]:
        right, count = self.sums.tolist()
        return {f"classify.{self.field}.accuracy": right / count} if count else {}


class Most(Trivial):
    """The most frequent class of the training split; of equals the first one seen."""

    def __init__(self, field: str) -> None:
        self.field, self.counts = field, Counter[int]()

    def add(self, truth: Frame) -> None:
        self.counts[int(truth[self.field][0])] += 1

    def result(self, count: int, size: Size) -> Results:
        return {"class": torch.full((count,), self.counts.most_common(1)[0][0])}
