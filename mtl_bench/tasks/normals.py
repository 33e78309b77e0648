"""Surface normals, learned from true ones.

Source: Eigen and Fergus, ICCV 2015: one minus the mean cosine between the predicted and the true
direction, where there is one (a normal of length 0 is none). Angles are in degrees, mean and median
over all pixels of the set, and the share of pixels within 11.25, 22.5 and 30 degrees.
Departure: published tables average each batch's mean and median; `legacy_batch_mean` has those
numbers. Their test of validity, a sum of components that is not 0, drops some true normals.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mtl_bench.core import canvas
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.canvas import Image
from mtl_bench.core.columns import Column
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Network
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, Trivial
from mtl_bench.core.terms import Term
from mtl_bench.core.view import Key, View
from mtl_bench.model.layers import DenseHead, full
from mtl_bench.tasks.batch_mean import BatchMeans
from mtl_bench.tasks.pixels import sampled

WITHIN = {"within_11": 11.25, "within_22": 22.5, "within_30": 30.0}  # degrees
BINS = 180_000  # of angles, for the median: a thousandth of a degree each
DIRECTIONS = {"right": (255, 128, 128), "down": (128, 255, 128), "to the camera": (128, 128, 0)}


class Normals(Task):
    terms = (Term("normal_cosine", "normals", "regression", 1.0),)
    kind = "regression"
    needs = reads = truth = frozenset({"normals"})
    maps: ClassVar[Mapping[str, MapInfo]] = {"normals": MapInfo("normals")}
    exported = ("normals",)
    columns = (
        Column(
            *("normal_mean", "normals.mean", "normals mean", -1, 2, "deg"),
            in_delta=True,
            headline=True,
            words="mean error of normals",
        ),
        Column("normal_median", "normals.median", "normals median", -1, 2, "deg", in_delta=True),
        Column("normal_11", "normals.within_11", "< 11.25 deg", +1, 2, "%", in_delta=True),
        Column("normal_22", "normals.within_22", "< 22.5 deg", +1, 2, "%", in_delta=True),
        Column("normal_30", "normals.within_30", "< 30 deg", +1, 2, "%", in_delta=True),
        Column(
            *("normal_mean_legacy", "normals.legacy_batch_mean.mean", "normals mean", -1, 2, "deg"),
            note="mean of batches",
        ),
        Column(
            *("normal_median_legacy", "normals.legacy_batch_mean.median", "normals median", -1, 2),
            unit="deg",
            note="mean of batches",
        ),
    )
    files = ("normals",)
    drawn: ClassVar[Mapping[str, str]] = {"normals": "normals"}
    words: ClassVar[Mapping[str, str]] = {"trivial": "mean normal", "timed": "normals"}

    def head(self, inputs: tuple[int, ...], sizes: Network) -> DenseHead:
        return DenseHead(self.name, inputs, sizes, 3)

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        """One minus the mean cosine over the pixels that have a normal."""
        true_B3HW = full(batch.fields["normals"])
        valid_BHW = true_B3HW.square().sum(1) > 0.5
        if not valid_BHW.any():
            return {}
        map_B3HW = full(maps[self.name])
        # F.normalize's norm over channels takes 20 times as long on a CPU
        length_B1HW = map_B3HW.square().sum(1, keepdim=True).clamp_min(1e-24).sqrt()
        lost_BHW = 1 - (map_B3HW / length_B1HW * true_B3HW).sum(1)
        return {"normal_cosine": (lost_BHW * valid_BHW).sum() / valid_BHW.sum()}

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """Returns "normals" [B,3,H,W] of length 1, x right, y down, z forward."""
        if size not in (None, tuple(maps[self.name].shape[-2:])):
            maps = self.resized(maps, size)
        return {"normals": F.normalize(maps[self.name].float(), dim=1)}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [AngleMetric(split or self.recipe.evaluate.split, self.recipe.optim.batch)]

    def protocol(self, tasks: Collection[str]) -> dict[str, Any]:
        return {"normals": "angles, mean and median over pixels of the set that have a normal"}

    def trivial(self, size: Size) -> Trivial:
        return MeanNormal(size)

    # --- for a viewer -----------------------------------------------------------------------------

    def view_of(
        self, results: Mapping[str, Results], camera_height_m: float | None
    ) -> "NormalView":
        return NormalView(colors(results[self.name]["normals"][0].cpu().numpy()))

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> "NormalView":
        return NormalView(np.asarray(map_HW, np.uint8))


class AngleMetric(Metric):
    """Angles between predicted and true normals, degrees.

    Args:
        batch: frames over which `legacy_batch_mean` averages first.
    """

    def __init__(self, split: str, batch: int) -> None:
        self.split = split
        self.degrees = np.zeros(())  # sum over pixels
        self.within_3 = np.zeros(len(WITHIN), np.int64)
        self.histogram = np.zeros(BINS, np.int64)
        self.legacy = BatchMeans(batch, {"mean": np.mean, "median": np.median})

    def update(self, truth: Frame, result: Frame) -> Frame:
        true_3HW, found_3HW = truth["normals"].astype(np.float64), result["normals"]
        valid_HW = np.square(true_3HW).sum(0) > 0.5
        cosine_N = (true_3HW * found_3HW).sum(0)[valid_HW]
        angle_N = np.degrees(np.arccos(np.clip(cosine_N, -1, 1)))
        self.degrees += angle_N.sum()
        self.within_3 += [(angle_N < limit).sum() for limit in WITHIN.values()]
        index_N = np.minimum((angle_N * (BINS / 180)).astype(np.int64), BINS - 1)
        self.histogram += np.bincount(index_N, minlength=BINS)
        self.legacy.add(angle_N, angle_N)
        return {
            "normals": colors(found_3HW),
            "true_normals": colors(true_3HW),
            "normal_mean": float(angle_N.mean()) if angle_N.size else float("nan"),
        }

    def state(self) -> dict[str, NDArray[Any]]:
        own = {"degrees": self.degrees, "within": self.within_3, "histogram": self.histogram}
        return own | self.legacy.state()

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.degrees += state["degrees"]
        self.within_3 += state["within"]
        self.histogram += state["histogram"]
        self.legacy.join(state)

    def compute(self) -> dict[str, float]:
        pixels = int(self.histogram.sum())
        if not pixels:
            return {}
        found = {"normals.mean": float(self.degrees) / pixels, "normals.median": self._median()}
        for name, count in zip(WITHIN, self.within_3.tolist(), strict=True):
            found[f"normals.{name}"] = 100 * count / pixels
        return found | self.legacy.compute("normals")

    def _median(self) -> float:
        """The middle of the bin, or of the two bins, that the middle pixels are in."""
        below = self.histogram.cumsum()
        middle = np.array([(below[-1] - 1) // 2, below[-1] // 2])
        return float((np.searchsorted(below, middle, "right") + 0.5).mean() * 180 / BINS)


class MeanNormal(Trivial):
    """The mean direction of each pixel of the training split; of all where one had none."""

    def __init__(self, size: Size) -> None:
        self.sum_3HW = np.zeros((3, *size))

    def add(self, truth: Frame) -> None:
        size = self.sum_3HW.shape[1:]
        self.sum_3HW += np.stack([sampled(axis_HW, size) for axis_HW in truth["normals"]])

    def result(self, count: int, size: Size) -> Results:
        empty_HW = np.square(self.sum_3HW).sum(0) == 0
        mean_3HW = np.where(empty_HW, self.sum_3HW.sum((1, 2), keepdims=True), self.sum_3HW)
        scaled = np.stack([sampled(axis_HW.astype(np.float32), size) for axis_HW in mean_3HW])
        return {"normals": F.normalize(torch.from_numpy(scaled), dim=0).expand(count, -1, -1, -1)}


def colors(normal_3HW: NDArray[Any]) -> Image:
    """RGB [H,W,3]: the components from -1 to 1 as 0 to 255; gray without a normal."""
    return np.rint((normal_3HW.transpose(1, 2, 0) + 1) * 127.5).clip(0, 255).astype(np.uint8)


@dataclass(frozen=True)
class NormalView(View):
    """Normals as colours."""

    colors_HW3: Image
    task = "normals"

    def picture(self, image_HW3: Image) -> Image:
        return canvas.nearest(self.colors_HW3, image_HW3)

    def explained(self, image_HW3: Image, whole: bool = False) -> Image:
        return np.asarray(canvas.enlarge(self.colors_HW3, canvas.factor(image_HW3.shape[1])))

    def files(self, kind: str, image_HW3: Image) -> dict[str, NDArray[Any]]:
        """`normals`: red to the right, green down, blue ahead."""
        return {"normals": self.colors_HW3} if kind == "normals" else {}

    @classmethod
    def key(cls, views: Sequence[View]) -> Key:
        return Key("Normals", DIRECTIONS)
