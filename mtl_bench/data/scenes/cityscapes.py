"""Writes scenes as Cityscapes would: one folder tree, one set of file names, one set of encodings.

Under `<type>/<split>/<city>/<city>_<sequence>_<frame>_`: leftImg8bit and, with every frame of the
snippet, leftImg8bit_sequence; gtFine (instanceIds, labelIds, panoptic), disparity, camera, vehicle.
Beyond Cityscapes, `egomotion/` holds the exact relative camera poses.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.labels import CITYSCAPES19
from mtl_bench.data.scenes import render
from mtl_bench.data.scenes.rays import FloatArray, context_from_target
from mtl_bench.data.scenes.settings import SPLITS, Settings, write_png

BASELINE_M = 0.22  # Cityscapes'; half a disparity step is < 2 % of 80 m from 32x64 on
FRAMES_PER_S = 17.0
_CITY_SCENES = 50
_SUPERCATEGORIES = (
    "flat", "flat", "construction", "construction", "construction", "object", "object", "object",
    "nature", "nature", "sky", "human", "human", *["vehicle"] * 6,
)  # fmt: skip
_CATEGORIES = [
    {"id": x.label_id, "name": x.name, "color": x.color, "supercategory": s,
     "isthing": int(x.is_thing)}
    for x, s in zip(CITYSCAPES19.labels, _SUPERCATEGORIES, strict=True)
]  # fmt: skip
_EVALUATED = {label.label_id: label for label in CITYSCAPES19.labels}


def encode_disparity(
    depth_m: FloatArray, fx: float, baseline_m: float = BASELINE_M
) -> NDArray[np.uint16]:
    """Cityscapes' uint16 disparity of a depth map: round(256 d) + 1 with d = baseline fx / depth.

    0 = invalid: no depth, or a disparity that 16 bits cannot hold.
    """
    valid = depth_m > 0
    steps = np.round(256.0 * baseline_m * fx / np.where(valid, depth_m, 1.0))
    return np.where(valid & (steps > 0) & (steps < 65535), steps + 1, 0).astype(np.uint16)


def place(settings: Settings, split: int, scene: int) -> tuple[str, str]:
    """City and `<city>_<sequence>`; no city has scenes of two splits."""
    before = sum(-(-count // _CITY_SCENES) for count in settings.counts[:split])
    city = f"syn{before + scene // _CITY_SCENES:02d}"
    return city, f"{city}_{scene % _CITY_SCENES:06d}"


def write_scene(root: Path, settings: Settings, split: int, number: int) -> dict[str, Any]:
    """Render and write one scene; returns its entries of the split's panoptic JSON."""
    scene = render.draw_scene((settings.seed, split, number), *settings.video)
    name = SPLITS[split]
    city, stem = place(settings, split, number)

    def path(kind: str, frame: int, ending: str) -> Path:
        folder = root / kind / name / city
        folder.mkdir(parents=True, exist_ok=True)
        return folder / f"{stem}_{frame:06d}_{ending}"

    target = settings.annotated
    for frame in range(settings.frames):
        image = render.image(scene, frame)
        write_png(path("leftImg8bit_sequence", frame, "leftImg8bit.png"), image)
        if frame == target:
            write_png(path("leftImg8bit", frame, "leftImg8bit.png"), image)
    seen = render.truth(scene, target)
    ids = render.instance_ids(seen, settings.min_instance_area)
    write_png(path("gtFine", target, "gtFine_instanceIds.png"), ids)
    write_png(path("gtFine", target, "gtFine_labelIds.png"), seen.label_HW)
    disparity = encode_disparity(seen.depth_HW, scene.camera.fx)
    write_png(path("disparity", target, "disparity.png"), disparity)
    for kind, values in _records(scene).items():
        text = json.dumps(values, indent=4, sort_keys=True)
        path(kind, target, f"{kind}.json").write_text(text + "\n")
    image_id = f"{stem}_{target:06d}"
    picture, entries = panoptic(ids, image_id)
    folder = root / "gtFine" / f"cityscapes_panoptic_{name}"
    folder.mkdir(parents=True, exist_ok=True)
    write_png(folder / f"{image_id}_gtFine_panoptic.png", picture)
    return {"split": split, "sort": f"{city}/{stem}", **entries}


def panoptic(ids_HW: NDArray[np.uint16], image_id: str) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """COCO-style panoptic image [H,W,3] (id = R + 256 G) and its JSON entries."""
    picture = np.zeros((*ids_HW.shape, 3), np.uint8)
    segments = []
    for number in np.unique(ids_HW).tolist():
        group = number < 1000
        label = _EVALUATED.get(number if group else number // 1000)
        if label is None:
            continue
        mask = ids_HW == number
        picture[mask] = (number % 256, number // 256, 0)
        rows, cols = np.flatnonzero(mask.any(1)).tolist(), np.flatnonzero(mask.any(0)).tolist()
        box = [cols[0], rows[0], cols[-1] - cols[0] + 1, rows[-1] - rows[0] + 1]
        segments.append({"id": number, "category_id": label.label_id, "area": int(mask.sum()),
                         "bbox": box, "iscrowd": int(group and label.is_thing)})  # fmt: skip
    height, width = ids_HW.shape
    file_name = f"{image_id}_gtFine_leftImg8bit.png"
    entry = {"id": image_id, "width": width, "height": height, "file_name": file_name}
    annotation = {"image_id": image_id, "file_name": f"{image_id}_gtFine_panoptic.png"}
    return picture, {"image": entry, "annotation": {**annotation, "segments_info": segments}}


def write_summary(root: Path, settings: Settings, entries: list[dict[str, Any]]) -> None:
    """The panoptic JSON of every split."""
    for split, name in enumerate(SPLITS):
        own = sorted((e for e in entries if e["split"] == split), key=lambda e: e["sort"])
        if own:
            content = {
                "images": [e["image"] for e in own],
                "annotations": [e["annotation"] for e in own],
                "categories": _CATEGORIES,
            }
            text = json.dumps(content, sort_keys=True, indent=4)
            (root / "gtFine" / f"cityscapes_panoptic_{name}.json").write_text(text)


def _records(scene: render.Scene) -> dict[str, dict[str, Any]]:
    """The JSON files beside a frame, by folder; metres and radians.

    The camera's extrinsics and the odometry are in the ISO 8855 vehicle frame (x forward, y left,
    z up), in which yaw counts to the left. Egomotion has matrices [4,4] with
    X_context = T X_target in camera axes (x right, y down, z forward), None beyond the snippet.
    """
    camera, motion, target = scene.camera, scene.motion, scene.annotated

    def transform(frame: int) -> Any:
        inside = 0 <= frame < len(motion.poses)
        pose = motion.poses[target]
        return context_from_target(pose, motion.poses[frame]).tolist() if inside else None

    return {
        "camera": {
            "extrinsic": {
                "baseline": BASELINE_M, "pitch": motion.pitch_rad, "roll": 0.0, "x": 1.7,
                "y": 0.0, "yaw": 0.0, "z": camera.mount_m,
            },
            "intrinsic": {"fx": camera.fx, "fy": camera.fy, "u0": camera.u0, "v0": camera.v0},
        },
        "vehicle": {
            "gpsHeading": 0.0, "gpsLatitude": 0.0, "gpsLongitude": 0.0, "outsideTemperature": 20.0,
            "speed": motion.step_m * FRAMES_PER_S, "yawRate": -motion.yaw_step_rad * FRAMES_PER_S,
        },
        "egomotion": {"previous": transform(target - 1), "next": transform(target + 1)},
    }  # fmt: skip
