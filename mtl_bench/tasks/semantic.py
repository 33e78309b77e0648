"""Semantic segmentation: one class per pixel, whatever things it may belong to.

Source: Long, Shelhamer, Darrell, Fully Convolutional Networks, CVPR 2015: cross-entropy where there
is a label; mean IoU and pixel accuracy of one confusion matrix over the whole set.
Departure from the published tables: a class that the set lacks is left out of the mean, where
their code divides 0 by 0. The labels are a data set's `instance_ids`, of which plain label ids are
a case.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.labels import IGNORE, LabelSet, class_of_instance_id
from mtl_bench.core.recipe import Network
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, Trivial
from mtl_bench.core.terms import Term
from mtl_bench.core.view import Key, View
from mtl_bench.model.layers import DenseHead, full
from mtl_bench.tasks.panoptic import MostFrequentClass, flat, grouping
from mtl_bench.tasks.panoptic.metrics import SemanticIoU
from mtl_bench.tasks.panoptic.picture import PanopticView
from mtl_bench.tasks.pixels import sampled


class Semantic(Task):
    terms = (Term("cross_entropy", "semantic", "classification", 1.0),)
    kind = "classification"
    needs = frozenset({"instance_ids"})
    truth = frozenset({"instance_ids"})
    maps: ClassVar[Mapping[str, MapInfo]] = {
        "semantic": MapInfo("classes", classes=True, words="logits", ids="class")
    }
    exported = ("class",)
    columns = (
        Column(
            *("seg_miou", "segmentation.miou", "mIoU", +1, 2, "%"),
            in_delta=True,
            headline=True,
            words="segmentation mIoU",
        ),
        Column("pixel_acc", "segmentation.pixel_acc", "PixAcc", +1, 2, "%", in_delta=True),
    )
    files = ("classes",)
    drawn: ClassVar[Mapping[str, str]] = {"class": "classes"}
    words: ClassVar[Mapping[str, str]] = {
        "trivial": "most frequent class per pixel",
        "timed": "class map",
    }

    def head(self, inputs: tuple[int, ...], sizes: Network) -> DenseHead:
        return DenseHead(self.name, inputs, sizes, len(self.labels))

    def targets(self, sample: Batch) -> dict[str, Tensor]:
        class_HW = class_of_instance_id(self.labels)[sample.fields["instance_ids"].numpy()]
        return {"class": torch.from_numpy(class_HW)}

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        """Mean over the pixels that have a label."""
        true_BHW = batch.fields["class"].long()
        if not (true_BHW != IGNORE).any():
            return {}
        loss = F.cross_entropy(full(maps[self.name]), true_BHW, ignore_index=IGNORE)
        return {"cross_entropy": loss}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """Returns "class" [B,H,W]: class indices."""
        if size not in (None, tuple(maps[self.name].shape[-2:])):
            maps = self.resized(maps, size)
        return {"class": grouping.classes(maps[self.name])}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [ClassMetric(self.labels, split or self.recipe.evaluate.split)]

    def trivial(self, size: Size) -> Trivial:
        return MostFrequent(self.labels, self.recipe, size)

    # --- for a viewer -----------------------------------------------------------------------------

    def view_of(self, results: Mapping[str, Results], camera_height_m: float | None) -> "ClassView":
        return ClassView.of(results[self.name]["class"][0].cpu().numpy(), self.labels)

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> "ClassView":
        return ClassView.of(map_HW, labels)


class ClassMetric(Metric):
    """One confusion matrix over the set; IoU by Cityscapes' rules, in percent."""

    def __init__(self, labels: LabelSet, split: str) -> None:
        self.labels, self.split, self.iou = labels, split, SemanticIoU(labels)

    def update(self, truth: Frame, result: Frame) -> Frame:
        true_HW = class_of_instance_id(self.labels)[truth["instance_ids"]]
        own = SemanticIoU(self.labels)
        own.update(result["class"], true_HW)
        self.iou.confusion += own.confusion
        return {"class": result["class"], "true_class": true_HW, "seg_miou": own.compute()["miou"]}

    def state(self) -> dict[str, NDArray[Any]]:
        return {"confusion": self.iou.confusion}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.iou.confusion += state["confusion"]

    def compute(self) -> dict[str, float]:
        rows = self.iou.confusion[list(self.labels.evaluated)]
        right = sum(row[index] for row, index in zip(rows, self.labels.evaluated, strict=True))
        accuracy = 100 * float(right / rows.sum()) if rows.sum() else float("nan")
        return flat("segmentation", {**self.iou.compute(), "pixel_acc": accuracy})


class MostFrequent(MostFrequentClass):
    """The class that each pixel has most often in the training split."""

    def result(self, count: int, size: Size) -> Results:
        return {"class": torch.from_numpy(sampled(self.class_HW(), size)).expand(count, -1, -1)}


@dataclass(frozen=True)
class ClassView(PanopticView):
    """A class map."""

    task = "semantic"

    @classmethod
    def of(cls, class_HW: NDArray[Any], labels: LabelSet) -> "ClassView":
        """Void where the class is none."""
        label_id = np.append(labels.label_id_of_class()[: len(labels)].astype(np.int32), IGNORE)
        return cls(label_id[np.minimum(class_HW, len(labels))], labels)

    def files(self, kind: str, image_HW3: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """`classes`, over the image and with a legend."""
        return {"classes": self.explained(image_HW3)} if kind == "classes" else {}

    @classmethod
    def key(cls, views: Sequence[View]) -> Key:
        return Key("Semantic segmentation", super().key(views).swatches)
