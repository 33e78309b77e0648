"""Point clouds with colours, classes and instances: from depth maps, into PLY and NPZ files.

Axes are those of the camera, which is at the origin: x right, y down, z forward.
N points, H x W pixels.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.canvas import Image
from mtl_bench.core.files import write_bytes
from mtl_bench.core.geometry import back_project
from mtl_bench.core.labels import (
    DIVISOR,
    NO_SURFACE,
    NUMBERING,
    LabelSet,
    class_of_instance_id,
)
from mtl_bench.core.quality import declared
from mtl_bench.show.predict import Predicted

POINTS = "points"  # the kind of files that a cloud makes, which tasks with a surface declare
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
    class_N: NDArray[np.uint8]  # label id, the instance's; 0 = none
    instance_N: NDArray[np.uint16]  # instance id of a thing; 0 = none
    unit: str  # of a Surface

    def __len__(self) -> int:
        return len(self.points_N3)

    @property
    def ids_N(self) -> NDArray[np.int32]:
        """Instance ids, of stuff its label id."""
        return np.where(self.instance_N > 0, self.instance_N, self.class_N).astype(np.int32)


def from_prediction(predicted: Predicted, labels: LabelSet) -> PointCloud:
    """The cloud of an image's prediction; without segments all classes are 0.

    Raises:
        ValueError: a prediction without a surface.
    """
    surface, segments = predicted.surface, predicted.segments
    if surface is None:
        able = [task for task, kinds in declared("files").items() if POINTS in kinds]
        raise ValueError(
            f"no depth is predicted, so there is no point cloud: train the task {' or '.join(able)}"
        )
    depth_HW = surface.depth_HW
    ids_HW = np.zeros(depth_HW.shape, np.int32) if segments is None else segments.ids_HW
    return from_maps(predicted.image_HW3, depth_HW, ids_HW, predicted.K_33, labels, surface.unit)


def from_maps(
    image_HW3: Image,
    depth_HW: NDArray[np.floating[Any]],
    instance_ids_HW: NDArray[np.integer[Any]],
    K_33: NDArray[np.floating[Any]],
    labels: LabelSet,
    unit: str,
) -> PointCloud:
    """Every pixel's point, but those of classes without a surface and without a valid depth.

    Args:
        depth_HW: 0 or not finite = no value.
        K_33: intrinsics in pixels of these maps.
    """
    depth_11HW = torch.from_numpy(np.asarray(depth_HW, np.float64))[None, None]
    K_133 = torch.from_numpy(np.asarray(K_33, np.float64))[None]
    points_HW3 = back_project(depth_11HW, K_133)[0].permute(1, 2, 0).numpy()
    class_HW = class_of_instance_id(labels)[instance_ids_HW]
    kept_HW = np.isfinite(depth_HW) & (np.asarray(depth_HW) > 0)
    kept_HW &= ~np.isin(class_HW, labels.of_role(NO_SURFACE))
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
        f"comment class: {NUMBERING} label id, 0 = none: " + ", ".join(names),
        f"comment instance: {NUMBERING} instance id (label id * {DIVISOR} + number), 0 = none",
        f"element vertex {len(cloud)}",
    ]
    for name in _VERTEX.names or ():
        lines.append(f"property {_PLY_TYPES[_VERTEX[name].str]} {name}")
    header = "\n".join([*lines, "end_header\n"]).encode("ascii")
    write_bytes(path, header + vertices.tobytes())


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
    write_bytes(path, data.getvalue())
