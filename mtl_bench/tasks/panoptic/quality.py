"""Panoptic quality by the official rules of Cityscapes and COCO (Kirillov et al., CVPR 2019).

A prediction and a true segment of one class match where their IoU exceeds one half. The union
leaves out what of the prediction lies on void. An unmatched prediction that lies by more than half
on void or on a crowd of its class is forgiven, as is every crowd. PQ is the sum of IoU over
(TP + FP / 2 + FN / 2), averaged over the classes that occur. Equals cityscapesscripts' evaluator,
with `ego vehicle` void in the truth and the prediction (MGNet's public code leaves its pixels in
the truth, where they count against road and cars).

Shapes: T true segments, P predicted ones, C classes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.labels import IGNORE, LabelSet
from mtl_bench.tasks.panoptic.targets import DIVISOR, class_of_instance_id

VOID = -1  # category of pixels that count for nothing


@dataclass
class Tally:
    """Matches per class; images add up."""

    iou: NDArray[np.float64]  # sum over matched pairs
    tp: NDArray[np.int64]
    fp: NDArray[np.int64]
    fn: NDArray[np.int64]

    @classmethod
    def zero(cls, classes: int) -> "Tally":
        counts = [np.zeros(classes, np.int64) for _ in range(3)]
        return cls(np.zeros(classes), *counts)

    def __iadd__(self, other: "Tally") -> "Tally":
        self.iou += other.iou
        self.tp += other.tp
        self.fp += other.fp
        self.fn += other.fn
        return self

    @property
    def present(self) -> NDArray[np.bool_]:
        """Classes that occur in the truth or the prediction; the mean is over these."""
        return self.tp + self.fp + self.fn > 0

    @property
    def pq(self) -> float:
        """Mean PQ over the classes that occur, in percent; NaN where none does."""
        present = self.present
        return float(100 * self.quality()[present, 0].mean()) if present.any() else float("nan")

    def quality(self) -> NDArray[np.float64]:
        """[C,3] PQ, SQ and RQ in [0, 1]; 0 for absent classes."""
        halves = np.maximum(self.tp + 0.5 * self.fp + 0.5 * self.fn, 0.5)
        sq = self.iou / np.maximum(self.tp, 1)
        return np.stack([self.iou / halves, sq, self.tp / halves], 1)


@dataclass
class Segments:
    """One image's segments: sorted distinct ids, their categories, and which one a pixel has."""

    index_HW: NDArray[np.intp]  # position in `ids`
    ids: NDArray[np.int64]
    category: NDArray[np.int64]  # class, or VOID
    crowd: NDArray[np.bool_]


def match(predicted: Segments, true: Segments, classes: int) -> Tally:
    """Count one image. Categories are 0..classes-1 or VOID; only the truth may hold crowds."""
    T, P = len(true.ids), len(predicted.ids)
    pairs = true.index_HW.ravel() * P + predicted.index_HW.ravel()
    overlap_TP = np.bincount(pairs, minlength=T * P).reshape(T, P)
    area_T, area_P = overlap_TP.sum(1), overlap_TP.sum(0)
    on_void_P = overlap_TP[true.category == VOID].sum(0)

    is_true_T = (true.category != VOID) & ~true.crowd
    is_predicted_P = predicted.category != VOID
    same_TP = true.category[:, None] == predicted.category[None]
    union_TP = area_T[:, None] + area_P[None] - overlap_TP - on_void_P[None]
    iou_TP = overlap_TP / np.maximum(union_TP, 1)
    match_TP = (iou_TP > 0.5) & same_TP & is_true_T[:, None] & is_predicted_P[None]

    forgiven_P = on_void_P + (overlap_TP * (same_TP & true.crowd[:, None])).sum(0)
    missed_T = is_true_T & ~match_TP.any(1)
    wrong_P = is_predicted_P & ~match_TP.any(0) & (forgiven_P / area_P <= 0.5)

    found_t, found_p = match_TP.nonzero()
    found = true.category[found_t]
    return Tally(
        iou=np.bincount(found, iou_TP[found_t, found_p], classes).astype(np.float64),
        tp=np.bincount(found, minlength=classes),
        fp=np.bincount(predicted.category[wrong_P], minlength=classes),
        fn=np.bincount(true.category[missed_T], minlength=classes),
    )


def segments(ids_HW: NDArray, labels: LabelSet) -> Segments:
    """Segments of a map of Cityscapes' instance ids; a true thing's bare label id is a crowd."""
    ids, index_HW = np.unique(ids_HW, return_inverse=True)
    classes = class_of_instance_id(labels)[ids].astype(np.int64)
    classes[~np.isin(classes, labels.evaluated)] = VOID
    crowd = np.isin(classes, labels.things) & (ids < DIVISOR)
    return Segments(index_HW.reshape(ids_HW.shape), ids.astype(np.int64), classes, crowd)


class PanopticQuality:
    """Panoptic quality of a split, image by image. Results are in percent."""

    def __init__(self, labels: LabelSet) -> None:
        self.labels = labels
        self.tally = Tally.zero(IGNORE)

    def update(self, predicted_ids_HW: NDArray, true_ids_HW: NDArray) -> Tally:
        """Add an image: maps of Cityscapes' instance ids (labelId, or labelId * 1000 + number).

        Returns:
            The image's own matches.
        """
        predicted = segments(predicted_ids_HW, self.labels)
        own = match(predicted, segments(true_ids_HW, self.labels), IGNORE)
        self.tally += own
        return own

    def compute(self) -> dict:
        """pq, sq, rq, then pq_things and pq_stuff, and per class the three with tp, fp and fn.

        A class that occurs nowhere is in no mean nor in `per_class`; a mean over nothing is NaN.
        """
        present, quality = self.tally.present, 100 * self.tally.quality()

        def mean(classes: tuple[int, ...]) -> list[float]:
            chosen = [index for index in classes if present[index]]
            return quality[chosen].mean(0).tolist() if chosen else [float("nan")] * 3

        things = tuple(i for i in self.labels.evaluated if i in self.labels.things)
        stuff = tuple(i for i in self.labels.evaluated if i not in self.labels.things)
        result: dict = dict(zip(("pq", "sq", "rq"), mean(self.labels.evaluated), strict=True))
        result["pq_things"], result["pq_stuff"] = mean(things)[0], mean(stuff)[0]
        result["per_class"] = {
            self.labels.labels[i].name: {
                **dict(zip(("pq", "sq", "rq"), quality[i].tolist(), strict=True)),
                "tp": int(self.tally.tp[i]),
                "fp": int(self.tally.fp[i]),
                "fn": int(self.tally.fn[i]),
            }
            for i in self.labels.evaluated
            if present[i]
        }
        return result
