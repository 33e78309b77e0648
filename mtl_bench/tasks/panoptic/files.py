"""Panoptic predictions as files that the official Cityscapes evaluator reads (COCO's format), and
such files of others.

`<out>/cityscapes_panoptic_<split>.json` and beside it a folder of that name with one PNG a frame,
whose pixels hold segment ids as R + 256 G + 65536 B:

    csEvalPanopticSemanticLabeling --gt-json-file ... --prediction-json-file <out>/...json
"""

import functools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mtl_bench.core.files import read_json, write_text
from mtl_bench.core.labels import DIVISOR, LARGEST_ID
from mtl_bench.data import png


def write_panoptic(out: Path, split: str, frames: Iterable[tuple[str, NDArray[Any]]]) -> Path:
    """Write (city_sequence_frame, map [H,W] of instance ids) pairs; returns the JSON file."""
    base = out / f"cityscapes_panoptic_{split}"
    base.mkdir(parents=True, exist_ok=True)
    annotations = []
    for name, ids_HW in frames:
        rgb_HW3 = np.stack([ids_HW & 255, ids_HW >> 8 & 255, ids_HW >> 16], 2).astype(np.uint8)
        file = base / f"{name}_panoptic.png"
        file.write_bytes(png.encode(rgb_HW3))
        segments = [
            {"id": value, "category_id": value if value < DIVISOR else value // DIVISOR}
            for value in np.flatnonzero(np.bincount(ids_HW.ravel())).tolist()  # no sort of pixels
            if value > 0
        ]
        annotations.append({"image_id": name, "file_name": file.name, "segments_info": segments})
    path = base.with_suffix(".json")
    write_text(path, json.dumps({"annotations": annotations}))  # last: it exists = all are there
    return path


def read_ids(path: Path) -> NDArray[Any]:
    """A map [H,W] of instance ids from a PNG: of 16 bits, or in colours as `write_panoptic`'s.

    The segments of colours have the categories that `<folder>.json` says; without it a segment's
    id is an instance id.

    Raises:
        ValueError: another PNG, an id that is none, or a segment that the JSON file lacks.
    """
    if png.read_header(path).bits == 16:
        return png.read(path, 16)
    try:
        with Image.open(path) as image:
            rgb_HW3 = np.asarray(image.convert("RGB"), np.int32)
    except OSError as error:
        raise ValueError(f"{path}: damaged PNG ({error})") from error
    ids_HW = rgb_HW3 @ np.array([1, 2**8, 2**16], np.int32)
    values, place_HW = np.unique(ids_HW, return_inverse=True)
    listed = _segments(path.parent.with_suffix(".json"))
    if listed is not None:
        own = listed.get(path.name, {})
        lacking = [value for value in values.tolist() if value > 0 and value not in own]
        if lacking:
            raise ValueError(f"{path}: {path.parent.name}.json has no segment {lacking[0]} of it")
        numbers: dict[int, int] = {}
        for place, value in enumerate(values.tolist()):
            category = own.get(value, 0)
            if value >= DIVISOR or category != value:  # a bare label id stays one
                numbers[category] = numbers.get(category, 0) + 1
                values[place] = category * DIVISOR + numbers[category] if category else 0
    if values.max() > LARGEST_ID:
        raise ValueError(
            f"{path}: {values.max()} is no instance id, and no {path.parent.name}.json"
        )
    return values[place_HW].reshape(ids_HW.shape)


@functools.cache
def _segments(path: Path) -> dict[str, dict[int, int]] | None:
    """Of every file the segments' ids and their categories; None without such a JSON file."""
    found = read_json(path)
    if found is None:
        return None
    return {
        each["file_name"]: {one["id"]: one["category_id"] for one in each["segments_info"]}
        for each in found["annotations"]
    }
