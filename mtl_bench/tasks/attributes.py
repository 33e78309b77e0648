"""Whether the image has an attribute, by a linear head: binary cross-entropy, F1 and accuracy.

Source: CelebA's 40 attributes as 40 tasks (Sener and Koltun, NeurIPS 2018), measured by F1 at a
probability of a half as in FAMO (Liu et al., NeurIPS 2023). True and false positives are counted
over the split. A task without any positive, found or true, has no F1.
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


class Attributes(Task):
    of_field = True
    reads_pyramid = False
    kind = "classification"
    terms = (Term("error", "attributes", "classification", 1.0),)
    maps: ClassVar[Mapping[str, MapInfo]] = {"logit": MapInfo("logit", words="logits")}
    exported = ("has",)
    columns = (Column("f1", "attributes.f1", "F1", +1, 1, "%", scale=100, in_delta=True),)
    words: ClassVar[Mapping[str, str]] = {"trivial": "constant answer of the best F1, yes"}

    def head(self, inputs: tuple[int, ...], sizes: Network) -> VectorHead:
        return VectorHead(self.name, "logit", sizes, 1)

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        truth_B1 = batch.fields[self.field]
        return {self.name: F.binary_cross_entropy_with_logits(maps["logit"].float(), truth_B1)}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        return {"has": maps["logit"][:, 0] > 0}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [Confusion(self.field, split or self.recipe.evaluate.split)]

    def trivial(self, size: Size) -> "Yes":
        return Yes()


class Confusion(Metric):
    """Counts of found and true, over the split."""

    def __init__(self, field: str, split: str) -> None:
        self.field, self.split = field, split
        self.counts_22 = np.zeros((2, 2), np.int64)  # true, found

    def update(self, truth: Frame, result: Frame) -> Frame:
        self.counts_22[int(truth[self.field][0]), int(result["has"])] += 1
        return {}

    def state(self) -> dict[str, NDArray[Any]]:
        return {"counts": self.counts_22}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.counts_22 = self.counts_22 + state["counts"]

    def compute(self) -> dict[str, float]:
        (neither, only_found), (only_true, both) = self.counts_22.tolist()
        count, positives = int(self.counts_22.sum()), 2 * both + only_found + only_true
        found = {}
        if positives:
            found[f"attributes.{self.field}.f1"] = 2 * both / positives
        if count:
            found[f"attributes.{self.field}.accuracy"] = (neither + both) / count
        return found


class Yes(Trivial):
    """The constant answer with the best F1."""

    def add(self, truth: Frame) -> None:
        """There is nothing to learn."""

    def result(self, count: int, size: Size) -> Results:
        return {"has": torch.ones(count, dtype=torch.bool)}
