"""Semantic IoU: one confusion matrix over a split's pixels, mean over classes that occur."""

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.labels import IGNORE, LabelSet


class SemanticIoU:
    """IoU of a split, image by image, by Cityscapes' pixel-level rules. Results are in percent.

    Pixels whose true class is not evaluated count for nothing; predicting such a class elsewhere is
    a miss of the true one.
    """

    def __init__(self, labels: LabelSet) -> None:
        self.labels = labels
        self.confusion = np.zeros((IGNORE + 1, IGNORE + 1), np.int64)  # true, predicted

    def update(self, predicted_class_HW: NDArray, true_class_HW: NDArray) -> None:
        """Add an image: maps of class indices, IGNORE where there is none."""
        pairs = true_class_HW.astype(np.int64) * (IGNORE + 1) + predicted_class_HW
        self.confusion += np.bincount(pairs.ravel(), minlength=self.confusion.size).reshape(
            self.confusion.shape
        )

    def compute(self) -> dict:
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
