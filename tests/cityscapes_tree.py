"""A tiny data set in Cityscapes' layout, written with OpenCV: noise images, a few segments."""

import json
from pathlib import Path

import cv2
import numpy as np

from mtl_bench.core import config
from mtl_bench.data.cityscapes import Cityscapes

HEIGHT, WIDTH = 16, 32
CAMERA = {
    "extrinsic": {"baseline": 0.209313, "pitch": 0.038, "roll": 0.0, "x": 1.7, "y": 0.1, "z": 1.22},
    "intrinsic": {"fx": 2262.52, "fy": 2265.3, "u0": 16.98, "v0": 8.137},
}


def put_png(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), array)


def file(root: Path, folder: str, name: str, suffix: str, split: str = "train") -> Path:
    return root / folder / split / name.split("_")[0] / f"{name}_{suffix}"


def instance_ids(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    ids = np.full((height, width), 7, np.uint16)
    ids[: height // 4] = 23
    ids[-2:] = 1
    ids[height // 2 : height // 2 + 4, 4:10] = 26001
    ids[height // 2 : height // 2 + 2, 20:24] = 24
    return ids


def write_frame(root: Path, name: str, split: str = "train", size=(HEIGHT, WIDTH), seed=0) -> None:
    """The annotated frame, its neighbours, labels, camera and disparity."""
    city, sequence, frame = name.split("_")
    random = np.random.default_rng([seed, int(sequence), int(frame)])
    for step in (-1, 0, 1):
        image = random.integers(0, 256, (*size, 3), np.uint8)
        shown = f"{city}_{sequence}_{int(frame) + step:06d}"
        put_png(file(root, "leftImg8bit_sequence", shown, "leftImg8bit.png", split), image)
        if step == 0:
            put_png(file(root, "leftImg8bit", name, "leftImg8bit.png", split), image)
    put_png(file(root, "gtFine", name, "gtFine_instanceIds.png", split), instance_ids(*size))
    disparity = np.full(size, 5121, np.uint16)
    disparity[0, :2] = 0, 1
    put_png(file(root, "disparity", name, "disparity.png", split), disparity)
    camera = file(root, "camera", name, "camera.json", split)
    camera.parent.mkdir(parents=True, exist_ok=True)
    camera.write_text(json.dumps(CAMERA))


def write_tree(root: Path, frames: int = 3, split: str = "train", size=(HEIGHT, WIDTH)) -> Path:
    for number in range(frames):
        city = ("aachen", "bochum")[number % 2]
        write_frame(root, f"{city}_{number:06d}_000019", split, size)
    return root


def open_tree(root: Path, split: str = "train", **changes) -> Cityscapes:
    data = changes.pop("data", config.Data(height=HEIGHT, width=WIDTH))
    settings = {
        "video": True,
        "panoptic": True,
        "augment": config.Augment(),
        "loss": config.Loss(center_sigma=2.0, small_area=10),
    }
    return Cityscapes(root, split, data, **{**settings, **changes})


def put_ego_mask(root: Path, size=(HEIGHT, WIDTH)) -> np.ndarray:
    """The bottom left quarter of every frame, as 8-bit white; returns where it is."""
    mask = np.zeros(size, np.uint8)
    mask[size[0] // 2 :, : size[1] // 2] = 255
    put_png(root / "ego_mask.png", mask)
    return mask > 0
