"""Depth, or inverse depth, learned from true values: what the data set has decides which.

Source: Liu, Johns, Davison, End-to-End Multi-Task Learning with Attention, CVPR 2019: the mean
absolute error over pixels that have a value (0 means none), which is the metric, too, with the
relative one. Both are means over all pixels of the set.
Departure: published tables average over batches first; `legacy_batch_mean` has those numbers.
A relative error of raw disparity is a ratio that values near 0 rule; read it with care.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core import canvas
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.canvas import Image, LogScale
from mtl_bench.core.columns import Column
from mtl_bench.core.dataset import Kind, dataset_of
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Network, Recipe
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, Trivial
from mtl_bench.core.terms import Term
from mtl_bench.core.view import Key, View
from mtl_bench.model.layers import DenseHead, full
from mtl_bench.tasks.batch_mean import BatchMeans
from mtl_bench.tasks.depth.picture import TABLE, scale_of
from mtl_bench.tasks.pixels import sampled

ERRORS = ("abs_err", "rel_err")


class DepthSupervised(Task):
    terms = (Term("depth_l1", "depth_supervised", "regression", 1.0),)
    kind = "regression"
    needs = frozenset({"depth_m"})  # or what `field_of` finds
    maps: ClassVar[Mapping[str, MapInfo]] = {"depth_supervised": MapInfo("depth_supervised")}
    exported = ("supervised",)
    columns = (
        Column(
            *("abs_err", "depth_supervised.abs_err", "AbsErr", -1, 4),
            in_delta=True,
            headline=True,
            words="absolute depth error",
        ),
        Column("rel_err", "depth_supervised.rel_err", "RelErr", -1, 4, in_delta=True),
        Column(
            *("abs_err_legacy", "depth_supervised.legacy_batch_mean.abs_err", "AbsErr", -1, 4),
            note="mean of batches",
        ),
        Column(
            *("rel_err_legacy", "depth_supervised.legacy_batch_mean.rel_err", "RelErr", -1, 4),
            note="mean of batches",
        ),
    )
    files = ("supervised",)
    drawn: ClassVar[Mapping[str, str]] = {
        "supervised": "supervised depth (near bright, far dark, gray without value)"
    }
    words: ClassVar[Mapping[str, str]] = {"trivial": "mean depth image", "timed": "depth map"}

    def __init__(self, recipe: Recipe, labels: LabelSet, *more: str) -> None:
        super().__init__(recipe, labels, *more)
        self.true, kind = field_of(recipe)
        self.inverse = kind is Kind.INVERSE_DEPTH
        # What the class declares is the same for every data set; what this one reads is its own.
        self.needs = self.reads = self.truth = frozenset({self.true})

    def head(self, inputs: tuple[int, ...], sizes: Network) -> DenseHead:
        return DenseHead(self.name, inputs, sizes, 1)

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        true_BHW = full(batch.fields[self.true])
        valid_BHW = true_BHW > 0
        if not valid_BHW.any():
            return {}
        error_BHW = (full(maps[self.name])[:, 0] - true_BHW).abs() * valid_BHW
        return {"depth_l1": error_BHW.sum() / valid_BHW.sum()}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """Returns "supervised" [B,H,W] in the truth's unit."""
        if size not in (None, tuple(maps[self.name].shape[-2:])):
            maps = self.resized(maps, size)
        return {"supervised": maps[self.name].float()[:, 0]}

    def metrics(self, split: str | None = None) -> list[Metric]:
        chosen = split or self.recipe.evaluate.split
        return [DepthMetric(self.true, self.inverse, chosen, self.recipe.optim.batch)]

    def protocol(self, tasks: Collection[str]) -> dict[str, Any]:
        return {"depth_supervised": f"{self.true}, mean over pixels of the set that have a value"}

    def trivial(self, size: Size) -> Trivial:
        return MeanValue(self.true, size)

    # --- for a viewer -----------------------------------------------------------------------------

    def view_of(self, results: Mapping[str, Results], camera_height_m: float | None) -> "ValueView":
        found_HW = results[self.name]["supervised"][0].cpu().numpy()
        return ValueView(_near_bright(found_HW, self.inverse))

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> "ValueView":
        return ValueView(np.asarray(map_HW, np.float32))


def field_of(recipe: Recipe) -> tuple[str, Kind]:
    """The field of a recipe's data set that holds depth, or else inverse depth.

    Raises:
        ValueError: it has neither.
    """
    fields = dataset_of(recipe).fields
    for kind in (Kind.DEPTH, Kind.INVERSE_DEPTH):
        for name, own in fields.items():
            if own is kind:
                return name, kind
    raise ValueError(f"{recipe.data.dataset} has no depth: it has {', '.join(sorted(fields))}")


def _near_bright(value_HW: NDArray[Any], inverse: bool) -> NDArray[np.float32]:
    """Depth up to a factor, 0 without value."""
    known = value_HW > 0
    shown_HW = np.where(known, value_HW, 1.0)
    return np.where(known, 1 / shown_HW if inverse else shown_HW, 0).astype(np.float32)


class DepthMetric(Metric):
    """Absolute and relative error over the pixels of the set that have a value.

    Args:
        batch: frames over which `legacy_batch_mean` averages first.
    """

    def __init__(self, field: str, inverse: bool, split: str, batch: int) -> None:
        self.field, self.inverse, self.split = field, inverse, split
        self.sum_3 = np.zeros(3)  # of absolute and relative errors, and pixels
        self.legacy = BatchMeans(batch, dict.fromkeys(ERRORS, np.mean))

    def update(self, truth: Frame, result: Frame) -> Frame:
        true_HW, found_HW = truth[self.field], result["supervised"]
        valid_HW = true_HW > 0
        true_N = true_HW[valid_HW].astype(np.float64)
        absolute_N = np.abs(found_HW[valid_HW] - true_N)
        relative_N = absolute_N / true_N
        self.sum_3 += (absolute_N.sum(), relative_N.sum(), len(true_N))
        self.legacy.add(absolute_N, relative_N)
        shown = {"supervised": found_HW, "true_supervised": true_HW}
        return {
            **{key: _near_bright(map_HW, self.inverse) for key, map_HW in shown.items()},
            "abs_err": float(absolute_N.mean()) if len(true_N) else float("nan"),
        }

    def state(self) -> dict[str, NDArray[Any]]:
        return {"sum": self.sum_3, **self.legacy.state()}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.sum_3 += state["sum"]
        self.legacy.join(state)

    def compute(self) -> dict[str, float]:
        *sums, pixels = self.sum_3.tolist()
        if not pixels:
            return {}
        found = {f"depth_supervised.{n}": s / pixels for n, s in zip(ERRORS, sums, strict=True)}
        return found | self.legacy.compute("depth_supervised")


class MeanValue(Trivial):
    """The mean value of each pixel of the training split; of all pixels where one had none."""

    def __init__(self, field: str, size: Size) -> None:
        self.field = field
        self.sum_HW, self.count_HW = np.zeros(size), np.zeros(size, np.int32)

    def add(self, truth: Frame) -> None:
        true_HW = sampled(truth[self.field], self.sum_HW.shape)
        self.sum_HW += true_HW
        self.count_HW += true_HW > 0

    def result(self, count: int, size: Size) -> Results:
        mean = self.sum_HW.sum() / max(self.count_HW.sum(), 1)
        seen_HW = self.count_HW > 0
        mean_HW = np.where(seen_HW, self.sum_HW / np.maximum(self.count_HW, 1), mean)
        mean_HW = sampled(mean_HW.astype(np.float32), size)
        return {"supervised": torch.from_numpy(mean_HW).expand(count, -1, -1)}


@dataclass(frozen=True)
class ValueView(View):
    """Depth up to a factor: every picture has its own scale."""

    depth_HW: NDArray[np.float32]  # 0 = no value
    task = "depth_supervised"

    def picture(self, image_HW3: Image) -> Image:
        colors = scale_of(self.depth_HW, "").colors
        return colors(canvas.nearest(self.depth_HW, image_HW3))

    def explained(self, image_HW3: Image, whole: bool = False) -> Image:
        """The colours, enlarged where the map is tiny."""
        colors_HW3 = scale_of(self.depth_HW, "").colors(self.depth_HW)
        return np.asarray(canvas.enlarge(colors_HW3, canvas.factor(image_HW3.shape[1])))

    def files(self, kind: str, image_HW3: Image) -> dict[str, NDArray[Any]]:
        """`supervised`, in colours."""
        return {"supervised": self.explained(image_HW3)} if kind == "supervised" else {}

    @classmethod
    def key(cls, views: Sequence[View]) -> Key:
        ends = {0.0: "near", 1.0: "far"}
        return Key("Supervised depth", scale=LogScale(1, 100, "", TABLE), marks=ends)
