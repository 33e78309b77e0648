"""Writes scenes as MTAN's archives of NYUv2 and Cityscapes: one array a frame and a field.

    {train,val}/{image,label,depth,normal}/N.npy                NYUv2, of 13 street classes
    {train,val}/{image,label_7,label_19,depth}/N.npy            Cityscapes

`train` holds the training and the validation scenes, since those archives have no validation split,
and `val` the test scenes. Images are float32 in [0, 1]. Depth is in metres up to 80; Cityscapes' is
a disparity / 65535 as its camera of 2048 pixels would have it, in its steps. The sky and the ego
vehicle have neither depth nor normal (0), the ego vehicle no label (-1).
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.labels import GROUND, NO_SURFACE, Label, LabelSet
from mtl_bench.data.labels import CITYSCAPES19
from mtl_bench.data.scenes import render
from mtl_bench.data.scenes.cityscapes import encode_disparity
from mtl_bench.data.scenes.settings import NYUV2, Settings

PUBLISHED_WIDTH = 2048  # of Cityscapes' images, which its disparities are pixels of
FARTHEST_M = 80.0  # a sensor's reach: what is beyond has no depth
NONE = -1
_ROLES = {"road": GROUND, "sky": NO_SURFACE}
_JOINED = {  # Cityscapes' class -> the one of 13 that it is part of
    **{"fence": "wall", "traffic light": "traffic sign", "rider": "person"},
    **{"bus": "truck", "train": "truck", "bicycle": "motorcycle"},
}
_ALONE = [label for label in CITYSCAPES19.labels if label.name not in _JOINED]
STREET13 = LabelSet(
    "street-13",
    tuple(
        Label(label.name, index, False, label.color, role=_ROLES.get(label.name, ""))
        for index, label in enumerate(_ALONE)
    ),
)
# Of Cityscapes' label ids: 7 flat, 11 construction, 17 object, 21 nature, 23 sky, 24 human, 26 ...
_FIRST_OF_CATEGORY = (7, 11, 17, 21, 23, 24, 26)


def _tables() -> dict[str, NDArray[np.int8]]:
    """By folder, from the renderer's label ids to the folder's labels."""
    made = {name: np.full(256, NONE, np.int8) for name in ("label", "label_7", "label_19")}
    for index, label in enumerate(CITYSCAPES19.labels):
        made["label_19"][label.label_id] = index
        made["label"][label.label_id] = STREET13.index(_JOINED.get(label.name, label.name))
        category = np.searchsorted(_FIRST_OF_CATEGORY, label.label_id, "right") - 1
        made["label_7"][label.label_id] = category
    return made


_TABLES = _tables()


def write_scene(root: Path, settings: Settings, split: int, number: int) -> dict[str, Any]:
    """Render and write one scene."""
    scene = render.draw_scene((settings.seed, split, number), *settings.video)
    frame = settings.annotated
    seen = render.truth(scene, frame)
    fields: dict[str, NDArray[Any]] = {"image": render.image(scene, frame).astype(np.float32) / 255}
    if settings.layout == NYUV2:
        fields["label"] = _TABLES["label"][seen.label_HW]
        near_HW = np.where(seen.depth_HW <= FARTHEST_M, seen.depth_HW, 0)
        fields["depth"] = near_HW[..., None]
        fields["normal"] = render.normals(scene, frame, seen)
    else:
        fields |= {name: _TABLES[name][seen.label_HW] for name in ("label_7", "label_19")}
        focal = scene.camera.fx * PUBLISHED_WIDTH / settings.width
        steps = encode_disparity(seen.depth_HW, focal)
        fields["depth"] = (steps / 65535).astype(np.float32)[..., None]
    first = settings.train_scenes if split == 1 else 0
    for name, array in fields.items():
        folder = root / ("val" if split == 2 else "train") / name
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{first + number}.npy", array)
    return {}


def write_summary(root: Path, settings: Settings, entries: list[dict[str, Any]]) -> None:
    """There is none."""
