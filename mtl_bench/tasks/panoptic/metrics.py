"""Panoptic quality and semantic IoU by the official rules of Cityscapes and COCO.

Panoptic quality (Kirillov et al., CVPR 2019): a prediction and a true segment of one class match
where their IoU exceeds one half. The union leaves out what of the prediction lies on void. An
unmatched prediction that lies by more than half on void or on a crowd of its class is forgiven, as
is every crowd. PQ is the sum of IoU over (TP + FP / 2 + FN / 2), averaged over the classes that
occur. Equals cityscapesscripts' evaluator, with classes that are not evaluated void in the truth
and the prediction (MGNet's public code leaves the ego vehicle's pixels in the truth, where they
count against road and cars).

Maps are compared by runs of equal pixels, of which an image has some ten thousand, and counted into
tables, so that an image's two million pixels are only read once.

Shapes: T true segments, P predicted ones, C classes, R runs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.labels import DIVISOR, IGNORE, LARGEST_ID, LabelSet, class_of_instance_id

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
    """One image's segments: sorted distinct ids, their categories, and which one each run has."""

    index_R: NDArray[np.intp]  # position in `ids`
    ids: NDArray[np.int64]
    category: NDArray[np.int64]  # class, or VOID
    crowd: NDArray[np.bool_]


def runs(*maps_HW: NDArray[Any]) -> tuple[list[NDArray[Any]], NDArray[np.int64]]:
    """Each map's values in the runs of pixels over which no map changes, and their lengths."""
    flat = [map_HW.ravel() for map_HW in maps_HW]
    changes = flat[0][1:] != flat[0][:-1]
    for values in flat[1:]:
        changes |= values[1:] != values[:-1]
    start_R = np.concatenate([[0], np.flatnonzero(changes) + 1])
    length_R = np.diff(start_R, append=flat[0].size)
    return [values[start_R] for values in flat], length_R


def _table(row_R: NDArray[Any], column_R: NDArray[Any], length_R: NDArray[Any], *size: int) -> Any:
    """Pixels of every pair, [rows,columns] int64; exact, as a sum in float64 below 2 ** 53 is."""
    pair_R = row_R.astype(np.intp) * size[1] + column_R
    return np.bincount(pair_R, length_R, size[0] * size[1]).reshape(size).astype(np.int64)


def match(predicted: Segments, true: Segments, length_R: NDArray[np.int64], classes: int) -> Tally:
    """Count one image. Categories are 0..classes-1 or VOID; only the truth may hold crowds."""
    T, P = len(true.ids), len(predicted.ids)
    overlap_TP = _table(true.index_R, predicted.index_R, length_R, T, P)
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


def segments(ids_R: NDArray[Any], labels: LabelSet) -> Segments:
    """Segments of runs of Cityscapes' instance ids; a true thing's bare label id is a crowd."""
    ids = np.flatnonzero(np.bincount(ids_R, minlength=LARGEST_ID + 1))
    position = np.zeros(LARGEST_ID + 1, np.intp)
    position[ids] = np.arange(len(ids))
    classes = class_of_instance_id(labels)[ids].astype(np.int64)
    classes[~np.isin(classes, labels.evaluated)] = VOID
    crowd = np.isin(classes, labels.things) & (ids < DIVISOR)
    return Segments(position[ids_R], ids, classes, crowd)


class PanopticQuality:
    """Panoptic quality of a split, image by image. Results are in percent."""

    def __init__(self, labels: LabelSet) -> None:
        self.labels = labels
        self.tally = Tally.zero(IGNORE)

    def update(
        self,
        predicted_ids: NDArray[Any],
        true_ids: NDArray[Any],
        length_R: NDArray[np.int64] | None = None,
    ) -> Tally:
        """Add an image: maps of Cityscapes' instance ids (labelId, or labelId * 1000 + number).

        Args:
            length_R: where the maps are given by their `runs`.

        Returns:
            The image's own matches.
        """
        if length_R is None:
            (predicted_ids, true_ids), length_R = runs(predicted_ids, true_ids)
        predicted, true = (segments(ids_R, self.labels) for ids_R in (predicted_ids, true_ids))
        own = match(predicted, true, length_R, IGNORE)
        self.tally += own
        return own

    def compute(self) -> dict[str, Any]:
        """pq, sq, rq, then pq_things and pq_stuff, and per class the three with tp, fp and fn.

        A class that occurs nowhere is in no mean nor in `per_class`; a mean over nothing is NaN.
        """
        present, quality = self.tally.present, 100 * self.tally.quality()

        def mean(classes: tuple[int, ...]) -> list[float]:
            chosen = [index for index in classes if present[index]]
            return quality[chosen].mean(0).tolist() if chosen else [float("nan")] * 3

        things = tuple(i for i in self.labels.evaluated if i in self.labels.things)
        stuff = tuple(i for i in self.labels.evaluated if i not in self.labels.things)
        result: dict[str, Any] = dict(
            zip(("pq", "sq", "rq"), mean(self.labels.evaluated), strict=True)
        )
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


class SemanticIoU:
    """IoU of a split, image by image, by Cityscapes' pixel-level rules. Results are in percent.

    Pixels whose true class is not evaluated count for nothing; predicting such a class elsewhere is
    a miss of the true one.
    """

    def __init__(self, labels: LabelSet) -> None:
        self.labels = labels
        self.confusion = np.zeros((IGNORE + 1, IGNORE + 1), np.int64)  # true, predicted

    def update(
        self,
        predicted_class: NDArray[Any],
        true_class: NDArray[Any],
        length_R: NDArray[np.int64] | None = None,
    ) -> None:
        """Add an image: maps of class indices, IGNORE where there is none.

        Args:
            length_R: where the maps are given by their `runs`.
        """
        if length_R is None:
            (predicted_class, true_class), length_R = runs(predicted_class, true_class)
        self.confusion += _table(true_class, predicted_class, length_R, *self.confusion.shape)

    def compute(self) -> dict[str, Any]:
        """miou, and the IoU per class; a class that occurs nowhere is in neither."""
        evaluated = list(self.labels.evaluated)
        true = self.confusion[evaluated]
        tp = self.confusion[evaluated, evaluated]
        union = true.sum(1) + true[:, evaluated].sum(0) - tp
        per_class = {
            self.labels.labels[index].name: {"iou": 100 * float(tp[row] / union[row])}
            for row, index in enumerate(evaluated)
            if union[row] > 0
        }
        ious = [values["iou"] for values in per_class.values()]
        return {"miou": float(np.mean(ious)) if ious else float("nan"), "per_class": per_class}
