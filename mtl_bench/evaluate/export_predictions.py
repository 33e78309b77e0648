"""Panoptic predictions as files that the official Cityscapes evaluator reads (COCO's format).

`<out>/cityscapes_panoptic_<split>.json` and beside it a folder of that name with one PNG a frame,
whose pixels hold segment ids as R + 256 G + 65536 B:

    csEvalPanopticSemanticLabeling --gt-json-file ... --prediction-json-file <out>/...json
"""

import json
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core import config
from mtl_bench.data.labels import labels_of
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.evaluate.walk import Progress, evaluating, predict, true_size
from mtl_bench.model import Model
from mtl_bench.tasks.panoptic.targets import DIVISOR


def export_predictions(
    model: Model,
    cell: config.Cell,
    root: Path,
    out: Path,
    device: torch.device,
    split: str | None = None,
    batch_size: int = 8,
    progress: Progress | None = None,
) -> Path:
    """Predict a split (None: the recipe's) and write it; returns the JSON file.

    Raises:
        ValueError: a cell without the panoptic task.
    """
    if "panoptic" not in cell.tasks:
        raise ValueError(f"cell {cell.slug} has no panoptic task: nothing to export")
    split = split or cell.recipe.evaluate.split
    dataset = open_dataset(cell, split, root, training=False)
    labels = labels_of(cell.recipe.data.dataset)

    def frames() -> Iterable[tuple[str, NDArray]]:
        done = 0
        for batch in eval_batches(dataset, batch_size):
            batch = batch.to(device)
            ids_BHW = predict(model, batch, cell, labels, true_size(batch)).instance_ids_BHW
            assert ids_BHW is not None
            yield from zip(batch.names, ids_BHW.cpu().numpy(), strict=True)
            done += len(batch.names)
            if progress:
                progress(done, len(dataset))

    with evaluating(model), torch.inference_mode():
        return write_panoptic(out, split, frames())


def write_panoptic(out: Path, split: str, frames: Iterable[tuple[str, NDArray]]) -> Path:
    """Write (city_sequence_frame, map [H,W] of instance ids) pairs; returns the JSON file."""
    base = out / f"cityscapes_panoptic_{split}"
    base.mkdir(parents=True, exist_ok=True)
    annotations = []
    for name, ids_HW in frames:
        bgr_HW3 = np.stack([ids_HW >> 16, ids_HW >> 8 & 255, ids_HW & 255], 2).astype(np.uint8)
        file = base / f"{name}_panoptic.png"
        if not cv2.imwrite(str(file), bgr_HW3):
            raise ValueError(f"cannot write {file}")
        segments = [
            {"id": value, "category_id": value if value < DIVISOR else value // DIVISOR}
            for value in np.unique(ids_HW).tolist()
            if value > 0
        ]
        annotations.append({"image_id": name, "file_name": file.name, "segments_info": segments})
    path = base.with_suffix(".json")
    path.write_text(json.dumps({"annotations": annotations}))  # last: it exists = all are there
    return path
