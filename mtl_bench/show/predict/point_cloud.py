"""Point clouds with colours, classes and instances: from depth maps, into PLY and NPZ files.

Axes are those of the camera, which is at the origin: x right, y down, z forward.
N points, H x W pixels.
"""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.geometry import back_project
from mtl_bench.data.labels import LabelSet
from mtl_bench.show.predict import Image, Predicted, without_surface
from mtl_bench.tasks.panoptic.targets import DIVISOR, class_of_instance_id

_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")
_VERTEX = np.dtype(
    [
        *((name, "<f4") for name in _POSITION),
        *((name, "u1") for name in (*_COLOR, "class")),
        ("instance", "<u2"),
    ]
)
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}


@dataclass(frozen=True)
class PointCloud:
    """Points in reading order of the pixels that saw them."""

    points_N3: NDArray[np.float32]  # in `unit`
    colors_N3: Image  # RGB, the image's
    class_N: NDArray[np.uint8]  # Cityscapes' label id (7 = road), the instance's; 0 = none
    instance_N: NDArray[np.uint16]  # Cityscapes' instance id (26001) of a thing; 0 = none
    unit: str  # as predict.METRES, HEIGHTS, UNSCALED

    def __len__(self) -> int:
        return len(self.points_N3)

    @property
    def ids_N(self) -> NDArray[np.int32]:
        """Cityscapes' instance ids, of stuff its label id: what `render.segment_colors` takes."""
        return np.where(self.instance_N > 0, self.instance_N, self.class_N).astype(np.int32)


def from_prediction(predicted: Predicted, labels: LabelSet) -> PointCloud:
    """The cloud of an image's prediction; without a panoptic task all classes are 0.

    Raises:
        ValueError: a prediction without depth.
    """
    if predicted.depth_HW is None or predicted.unit is None:
        raise ValueError("no depth is predicted, so there is no point cloud: train the task depth")
    ids_HW = predicted.instance_ids_HW
    if ids_HW is None:
        ids_HW = np.zeros(predicted.depth_HW.shape, np.int32)
    image_HW3, K_33 = predicted.image_HW3, predicted.K_33
    return from_maps(image_HW3, predicted.depth_HW, ids_HW, K_33, labels, predicted.unit)


def from_maps(
    image_HW3: Image,
    depth_HW: NDArray[np.floating[Any]],
    instance_ids_HW: NDArray[np.integer[Any]],
    K_33: NDArray[np.floating[Any]],
    labels: LabelSet,
    unit: str,
) -> PointCloud:
    """Every pixel's point, but those of sky, of the ego vehicle and without a valid depth.

    Args:
        depth_HW: 0 or not finite = no value.
        instance_ids_HW: Cityscapes' ids.
        K_33: intrinsics in pixels of these maps.
    """
    depth_11HW = torch.from_numpy(np.asarray(depth_HW, np.float64))[None, None]
    K_133 = torch.from_numpy(np.asarray(K_33, np.float64))[None]
    points_HW3 = back_project(depth_11HW, K_133)[0].permute(1, 2, 0).numpy()
    class_HW = class_of_instance_id(labels)[instance_ids_HW]
    kept_HW = np.isfinite(depth_HW) & (np.asarray(depth_HW) > 0)
    kept_HW &= ~np.isin(class_HW, without_surface(labels))
    ids_N = instance_ids_HW[kept_HW]
    return PointCloud(
        points_N3=points_HW3[kept_HW].astype(np.float32),
        colors_N3=image_HW3[kept_HW],
        class_N=np.where(ids_N < DIVISOR, ids_N, ids_N // DIVISOR).astype(np.uint8),
        instance_N=np.where(ids_N < DIVISOR, 0, ids_N).astype(np.uint16),
        unit=unit,
    )


def write_ply(path: Path, cloud: PointCloud, labels: LabelSet) -> None:
    """A binary little-endian PLY file, whole or not at all.

    Vertex properties: float x y z, uchar red green blue, uchar class, ushort instance.
    """
    vertices = np.empty(len(cloud), _VERTEX)
    for column, name in enumerate(_POSITION):
        vertices[name] = cloud.points_N3[:, column]
    for column, name in enumerate(_COLOR):
        vertices[name] = cloud.colors_N3[:, column]
    vertices["class"], vertices["instance"] = cloud.class_N, cloud.instance_N
    names = [f"{label.label_id} {label.name}" for label in labels.labels]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment camera axes, the camera at the origin: x right, y down, z forward",
        f"comment unit of x y z: {cloud.unit}",
        "comment class: Cityscapes label id, 0 = none: " + ", ".join(names),
        "comment instance: Cityscapes instance id (label id * 1000 + number), 0 = none",
        f"element vertex {len(cloud)}",
    ]
    for name in _VERTEX.names or ():
        lines.append(f"property {_PLY_TYPES[_VERTEX[name].str]} {name}")
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    _write_whole(path, header + vertices.tobytes())


def write_npz(path: Path, cloud: PointCloud) -> None:
    """The same as compressed arrays: points, colors, classes, instances, and the unit."""
    data = io.BytesIO()
    np.savez_compressed(
        data,
        points=cloud.points_N3,
        colors=cloud.colors_N3,
        classes=cloud.class_N,
        instances=cloud.instance_N,
        unit=np.array(cloud.unit),
    )
    _write_whole(path, data.getvalue())


def _write_whole(path: Path, data: bytes) -> None:
    """By a temporary sibling, of which a full disk leaves nothing."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
