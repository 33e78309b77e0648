"""Panoptic predictions as files that the official Cityscapes evaluator reads (COCO's format).

`<out>/cityscapes_panoptic_<split>.json` and beside it a folder of that name with one PNG a frame,
whose pixels hold segment ids as R + 256 G + 65536 B:

    csEvalPanopticSemanticLabeling --gt-json-file ... --prediction-json-file <out>/...json
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.files import write_text
from mtl_bench.core.labels import DIVISOR


def write_panoptic(out: Path, split: str, frames: Iterable[tuple[str, NDArray[Any]]]) -> Path:
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
            for value in np.flatnonzero(np.bincount(ids_HW.ravel())).tolist()  # no sort of pixels
            if value > 0
        ]
        annotations.append({"image_id": name, "file_name": file.name, "segments_info": segments})
    path = base.with_suffix(".json")
    write_text(path, json.dumps({"annotations": annotations}))  # last: it exists = all are there
    return path
