"""Panoptic segmentation: a class for every pixel, an instance for every pixel of a thing.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021) after Panoptic-DeepLab (Cheng et al., CVPR
2020): a semantic decoder, and an instance decoder for a heat map of centers and offsets to them.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.columns import Column
from mtl_bench.core.dataset import LabelFrames
from mtl_bench.core.labels import DIVISOR, IGNORE, LabelSet, class_of_instance_id
from mtl_bench.core.recipe import Network, Recipe
from mtl_bench.core.task import Frame, MapInfo, Maps, Metric, Results, Size, Task, TaskHead, Trivial
from mtl_bench.core.terms import Term, present
from mtl_bench.model.layers import Decoder, Head, full, init_fan_in
from mtl_bench.tasks.panoptic import grouping, pseudo_labels
from mtl_bench.tasks.panoptic.files import read_ids, write_panoptic
from mtl_bench.tasks.panoptic.losses import center_loss, offset_loss, semantic_loss
from mtl_bench.tasks.panoptic.metrics import PanopticQuality, SemanticIoU, runs
from mtl_bench.tasks.panoptic.picture import PanopticView
from mtl_bench.tasks.panoptic.targets import panoptic_targets
from mtl_bench.tasks.pixels import sampled

THINGS_SHARE = 0.1  # of the pixels of a street scene; Cityscapes' is a bit less


class PanopticHead(TaskHead):
    """Raw maps: "semantic" logits, "center" logits of the heat map, "offset" in feature cells."""

    def __init__(self, inputs: tuple[int, ...], sizes: Network, classes: int) -> None:
        super().__init__()
        decoders = {
            name: Decoder(inputs, sizes.channels, sizes.fused) for name in ("semantic", "instance")
        }
        channels = {"semantic": classes, "center": 1, "offset": 2}
        heads = {name: Head(sizes.fused, sizes.head, n) for name, n in channels.items()}
        self.decoders, self.heads = nn.ModuleDict(decoders), nn.ModuleDict(heads)
        init_fan_in(self.decoders)
        init_fan_in(self.heads)

    def forward(
        self, pyramid: Sequence[Tensor], context_BC11: Tensor, auxiliary: bool = False
    ) -> Maps:
        semantic = self.decoders["semantic"](pyramid, context_BC11)[0]
        instance = self.decoders["instance"](pyramid, context_BC11)[0]
        return {
            "semantic": self.heads["semantic"](semantic),
            "center": self.heads["center"](instance),
            "offset": self.heads["offset"](instance),
        }


class Panoptic(Task):
    terms = (
        Term("semantic", "panoptic", "classification", 1.0),
        Term("center", "panoptic", "regression", 200.0),
        Term("offset", "panoptic", "regression", 0.01),
    )
    kind = "classification"
    needs = frozenset({"instance_ids"})
    truth = frozenset({"instance_ids"})
    maps: ClassVar[Mapping[str, MapInfo]] = {
        "semantic": MapInfo("semantic", classes=True, words="logits", ids="panoptic"),
        "center": MapInfo("center"),
        "offset": MapInfo("offset"),
    }
    exported = ("panoptic",)
    meaning: ClassVar[Mapping[str, str]] = {
        "semantic": "class index",
        "center": "heat of instances' centers, in [0, 1], not thresholded",
        "offset": "(y, x) from each pixel to its instance's center, pixels",
        "panoptic": f"class index * {DIVISOR} + instance from 1; instance 0: stuff, or a thing in "
        f"an image without any center; {grouping.VOID}: no segment",
    }
    makes_labels = True
    columns = (
        Column(
            *("pq", "panoptic.pq", "PQ", +1, 1, "%"),
            in_delta=True,
            headline=True,
            words="panoptic quality",
        ),
        Column("pq_things", "panoptic.pq_things", "PQ things", +1, 1, "%"),
        Column("pq_stuff", "panoptic.pq_stuff", "PQ stuff", +1, 1, "%"),
        Column("miou", "semantic.miou", "mIoU", +1, 1, "%", in_delta=True, short=True),
    )
    files = ("overlay", "ids")
    scored = ("_instanceIds.png", "_panoptic.png", ".png")
    drawn: ClassVar[Mapping[str, str]] = {"instance_ids": "panoptic maps"}
    agreement = (
        Column(
            *("panoptic_equal", "agreement.panoptic_equal", "panoptic", +1, 3, "% equal"),
            scale=100,
            short=True,
            words="panoptic pixels that are equal",
        ),
        Column(
            *("logits_max", "agreement.logits_max", "logits", -1, 0, "max diff."),
            scientific=True,
            words="logits absolute",
        ),
    )
    words: ClassVar[Mapping[str, str]] = {
        "trivial": "most frequent class per pixel",
        "timed": "panoptic map",
        "random": "the number of instances that post-processing finds, and its time, may be "
        "another, and nearly tied logits make equal panoptic pixels say less",
    }

    # --- network ----------------------------------------------------------------------------------

    def head(self, inputs: tuple[int, ...], sizes: Network) -> PanopticHead:
        return PanopticHead(inputs, sizes, len(self.labels))

    def activate(self, maps: Maps) -> Maps:
        """Centers in [0, 1]; offsets (y, x) in pixels: the head's unit is one feature cell."""
        cell = self.recipe.network.strides[0]
        return {
            "semantic": maps["semantic"],
            "center": maps["center"].sigmoid(),
            "offset": maps["offset"] * cell,
        }

    def like_trained(self, head: TaskHead, maps: Maps) -> None:
        """Give the classes new numbers: things then cover no more of an image than in a street,
        which is what the time of grouping depends on. Weights drawn in another order are as random.
        """
        things, classes = self.labels.things, maps["semantic"].shape[1]
        share_C = torch.bincount(maps["semantic"].argmax(1).flatten(), minlength=classes) / 1.0
        share_C /= share_C.sum()
        chosen: list[int] = []
        for number in share_C.argsort(descending=True).tolist():
            fits = share_C[[*chosen, number]].sum() <= THINGS_SHARE
            chosen += [number] if fits and len(chosen) < len(things) else []
        rest = [n for n in share_C.argsort().tolist() if n not in chosen]
        chosen += rest[: len(things) - len(chosen)]
        others = iter([number for number in range(classes) if number not in chosen])
        taken = iter(chosen)
        order = [next(taken if number in things else others) for number in range(classes)]
        last: Any = head.heads["semantic"][1]  # type: ignore[index]
        last.weight.data = last.weight.data[order].clone()

    # --- training ---------------------------------------------------------------------------------

    def targets(self, sample: Batch) -> dict[str, Tensor]:
        ids_HW = sample.fields["instance_ids"].numpy()
        found = panoptic_targets(ids_HW, self.labels, self.recipe.loss)
        return {
            "semantic": torch.from_numpy(found.semantic),
            "semantic_weight": torch.from_numpy(found.semantic_weight),
            "center": torch.from_numpy(found.center)[None],
            "center_weight": torch.from_numpy(found.center_weight)[None],
            "offset": torch.from_numpy(found.offset),
            "offset_weight": torch.from_numpy(found.offset_weight)[None],
        }

    def losses(self, maps: Maps, batch: Batch) -> dict[str, Tensor]:
        true = batch.fields
        if "semantic" not in true:
            return {}
        top = self.recipe.loss.top_fraction
        weight = full(true["semantic_weight"])
        return present(
            {
                "semantic": semantic_loss(full(maps["semantic"]), true["semantic"], weight, top),
                "center": center_loss(
                    full(maps["center"]), full(true["center"]), full(true["center_weight"])
                ),
                "offset": offset_loss(
                    full(maps["offset"]), full(true["offset"]), full(true["offset_weight"])
                ),
            }
        )

    # --- results ----------------------------------------------------------------------------------

    def resized(self, maps: Maps, size: Size) -> Maps:
        """Offsets are pixels, so they are scaled as well (MGNet's public code leaves them)."""
        found = super().resized(maps, size)
        rows, columns = maps["offset"].shape[2:]
        factor = found["offset"].new_tensor([size[0] / rows, size[1] / columns])
        found["offset"] = found["offset"] * factor.view(1, 2, 1, 1)
        return found

    def finish(
        self, maps: Maps, camera: Camera, done: Mapping[str, Results], size: Size | None = None
    ) -> Results:
        """Returns:
        "class" [B,H,W]: class index, IGNORE where there is none; "panoptic" [B,H,W] int32: see
        `grouping`; "seen_class": the classes at the network's input size.
        """
        seen_BHW = class_BHW = grouping.classes(maps["semantic"])
        if size not in (None, tuple(seen_BHW.shape[1:])):
            maps = self.resized(maps, size)
            class_BHW = grouping.classes(maps["semantic"])
        panoptic_BHW = grouping.panoptic(
            class_BHW, maps["center"], maps["offset"], self.labels.things, self.recipe.evaluate
        )
        return {"class": class_BHW, "panoptic": panoptic_BHW, "seen_class": seen_BHW}

    def metrics(self, split: str | None = None) -> list[Metric]:
        return [PanopticMetric(self.labels, split or self.recipe.evaluate.split)]

    def protocol(self, tasks: Collection[str]) -> dict[str, Any]:
        ev = self.recipe.evaluate
        return {
            "panoptic_rules": "cityscapesscripts; ignored classes are void",
            "center_threshold": ev.center_threshold,
            "nms_kernel": ev.nms_kernel,
            "top_k": ev.top_k,
            "stuff_area": ev.stuff_area,
        }

    def label(
        self,
        model: nn.Module,
        frames: LabelFrames,
        device: torch.device,
        progress: Callable[[int, int], None] | None = None,
    ) -> Path:
        return pseudo_labels.label(self, model, frames, device, progress)

    def write_results(self, out: Path, split: str, frames: Iterable[tuple[str, Results]]) -> Path:
        """As cityscapesscripts' panoptic evaluator reads them."""
        ids = (
            (name, grouping.to_instance_ids(results["panoptic"], self.labels).numpy())
            for name, results in frames
        )
        return write_panoptic(out, split, ids)

    def read_result(self, path: Path, size: Size) -> Results:
        """Instance ids, of 16 bits or as the official evaluator reads them; they give the class."""
        ids_HW = read_ids(path)
        if ids_HW.shape != size:
            raise ValueError(f"{path}: {ids_HW.shape} pixels where the truth has {size}")
        class_HW = class_of_instance_id(self.labels)[ids_HW]
        values, segment_HW = np.unique(ids_HW, return_inverse=True)
        numbered = values >= DIVISOR
        if numbered.sum() >= DIVISOR:
            raise ValueError(f"{path}: {numbered.sum()} instances; at most {DIVISOR - 1} are told")
        number = np.where(numbered, numbered.cumsum(), 0)[segment_HW].reshape(size)
        ids = np.where(
            class_HW == IGNORE, grouping.VOID, class_HW.astype(np.int32) * DIVISOR + number
        )
        return {
            "class": torch.from_numpy(class_HW)[None],
            "panoptic": torch.from_numpy(ids.astype(np.int32))[None],
        }

    def trivial(self, size: Size) -> Trivial:
        return MostFrequentClass(self.labels, self.recipe, size)

    # --- for a viewer -----------------------------------------------------------------------------

    def at_size(self, size: Size) -> "Panoptic":
        data, ev = self.recipe.data, self.recipe.evaluate
        times = (size[0] * size[1] / (data.height * data.width)) ** 0.5
        kernel = max(3, 2 * round((ev.nms_kernel * times - 1) / 2) + 1)
        scaled = replace(ev, nms_kernel=kernel, stuff_area=round(ev.stuff_area * times**2))
        return Panoptic(replace(self.recipe, evaluate=scaled), self.labels)

    def view_of(
        self, results: Mapping[str, Results], camera_height_m: float | None
    ) -> PanopticView:
        """Metrics see no class that is not evaluated, a viewer does: its bare label id."""
        found = {name: value[0].cpu() for name, value in results[self.name].items()}
        ids_HW = grouping.to_instance_ids(found["panoptic"], self.labels).numpy()
        class_HW = found["class"].numpy()
        unevaluated = [i for i in range(len(self.labels)) if i not in self.labels.evaluated]
        bare_HW = self.labels.label_id_of_class()[class_HW]
        shown_HW = np.where(np.isin(class_HW, unevaluated), bare_HW, ids_HW)
        return PanopticView(shown_HW.astype(np.int32), self.labels)

    @classmethod
    def drawn_view(cls, name: str, map_HW: NDArray[Any], labels: LabelSet) -> PanopticView:
        return PanopticView(np.asarray(map_HW, np.int32), labels)


class PanopticMetric(Metric):
    """Panoptic quality and semantic IoU of the frames that have labels, in percent."""

    def __init__(self, labels: LabelSet, split: str) -> None:
        self.labels, self.split = labels, split
        self.quality, self.iou = PanopticQuality(labels), SemanticIoU(labels)
        self.frames = self.with_truth = 0

    def update(self, truth: Frame, result: Frame) -> Frame:
        self.frames += 1
        true = [truth["instance_ids"]] if "instance_ids" in truth else []
        panoptic_HW = result["panoptic"]
        (panoptic_R, class_R, *true_R), length_R = runs(panoptic_HW, result["class"], *true)
        ids_R = grouping.to_instance_ids(torch.from_numpy(panoptic_R), self.labels).numpy()
        shown = {"instance_ids": np.repeat(ids_R, length_R).reshape(panoptic_HW.shape)}
        if not true:
            return shown
        self.with_truth += 1
        pq = self.quality.update(ids_R, true_R[0], length_R).pq
        self.iou.update(class_R, class_of_instance_id(self.labels)[true_R[0]], length_R)
        return {**shown, "true_instance_ids": true[0], "pq": pq}

    def state(self) -> dict[str, NDArray[Any]]:
        counts = np.array([self.frames, self.with_truth])
        return {**vars(self.quality.tally), "confusion": self.iou.confusion, "counts": counts}

    def add(self, state: Mapping[str, NDArray[Any]]) -> None:
        self.quality.tally += type(self.quality.tally)(
            *(state[name] for name in vars(self.quality.tally))
        )
        self.iou.confusion += state["confusion"]
        self.frames += int(state["counts"][0])
        self.with_truth += int(state["counts"][1])

    def compute(self) -> dict[str, float]:
        if not self.with_truth:
            return {}
        return {**flat("panoptic", self.quality.compute()), **flat("semantic", self.iou.compute())}

    def record(self) -> dict[str, Any]:
        if not self.with_truth:
            return {"panoptic_truth": "none in this split: no panoptic metrics"}
        return {"panoptic_truth": f"{self.with_truth} of {self.frames} frames"}


class MostFrequentClass(Trivial):
    """The class that each pixel has most often; things become one instance a class."""

    def __init__(self, labels: LabelSet, recipe: Recipe, size: Size) -> None:
        self.labels, self.recipe = labels, recipe
        self.votes = np.zeros((len(labels), *size), np.int32)

    def add(self, truth: Frame) -> None:
        if "instance_ids" not in truth:
            return
        ids_HW = sampled(truth["instance_ids"], self.votes.shape[1:])
        class_HW = class_of_instance_id(self.labels)[ids_HW]
        for index in np.unique(class_HW[class_HW != IGNORE]):
            self.votes[index] += class_HW == index

    def class_HW(self) -> NDArray[np.uint8]:
        """IGNORE where no class was ever seen; ties go to the lowest."""
        most_HW = self.votes.argmax(0).astype(np.uint8)
        most_HW[self.votes.max(0) == 0] = IGNORE
        found: NDArray[np.uint8] = most_HW
        return found

    def result(self, count: int, size: Size) -> Results:
        class_BHW = torch.from_numpy(sampled(self.class_HW(), size)).expand(count, -1, -1)
        nothing_B2HW = torch.zeros(count, 2, *size)
        panoptic_BHW = grouping.panoptic(
            class_BHW, nothing_B2HW[:, :1], nothing_B2HW, self.labels.things, self.recipe.evaluate
        )
        return {"class": class_BHW, "panoptic": panoptic_BHW}


def flat(prefix: str, values: Mapping[str, Any]) -> dict[str, float]:
    """Dotted keys: `per_class` becomes `<prefix>.class.<name>.<key>`; NaN is dropped."""
    found: dict[str, float] = {}
    for key, value in values.items():
        if key == "per_class":
            for name, numbers in value.items():
                found |= flat(f"{prefix}.class.{name}", numbers)
        elif not np.isnan(value):
            found[f"{prefix}.{key}"] = value
    return found
