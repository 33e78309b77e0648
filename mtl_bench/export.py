"""A model as ONNX files of a fixed size, for whoever runs it without this package.

Inputs: `image` uint8 [1,H,W,3], RGB. With depth and the post-processing inside also `K` [1,3,3]
(intrinsics in pixels of that image), `camera_height_m` [1] and `pitch_rad` [1] (to the ground,
positive looks down).

Outputs, post-processing `inside`: see finish.Finish.
    panoptic   int32 [1,H,W]: class index * 1000 + instance; -1 = void
    depth_m    [1,1,H,W]
    points     [1,3,H,W], metres in the camera's frame: x right, y down, z forward
Outputs without it, as MGNet's exported graph has them (but for center, which is not thresholded):
    semantic   int32 [1,H,W], class index
    center     [1,1,H,W], in [0, 1]
    offset     [1,2,H,W]: (y, x) to the instance's center, pixels
    inverse_depth  [1,1,H,W], unscaled
`apart`: those, and a second file NAME.post.onnx from them (and K, ...) to the three above. What
belongs to a task that the model lacks is absent. Metadata: classes, things, size, layout, cell id.
"""

import json
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench import __version__
from mtl_bench.core import config
from mtl_bench.data.labels import LabelSet
from mtl_bench.engines import onnx_file
from mtl_bench.engines.graph import Strided, strided
from mtl_bench.tasks.finish import Finish

POST = ("inside", "apart", "none")
MAPS = {"logits": "semantic", "center": "center", "offset": "offset", "inverse": "inverse_depth"}
CAMERA = ("K", "camera_height_m", "pitch_rad")
RESULTS = {"panoptic": ("panoptic",), "depth": ("depth_m", "points")}
EGO_AND_SKY = ("ego vehicle", "sky")


class FullSize(nn.Module):
    """The strided graph, and its maps at the image's size."""

    def __init__(self, strided: Strided, size: tuple[int, int]):
        super().__init__()
        self.strided, self.size = strided, size  # `graph` is a name that torch.fx uses

    def forward(self, image_1HW3: Tensor) -> tuple[Tensor, ...]:
        maps = [
            F.interpolate(x, self.size, mode="bilinear", align_corners=True)
            for x in self.strided(image_1HW3)
        ]
        if "logits" in self.strided.names:
            maps[0] = maps[0].argmax(1).int()
        return tuple(maps)


class Post(nn.Module):
    """`Finish` with its inputs by position: maps in the order of MAPS, then the camera."""

    def __init__(self, finish: Finish, names: list[str]):
        super().__init__()
        self.finish, self.names = finish, names

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(self.names, values, strict=True))
        found = self.finish(
            given.get("semantic"),
            given.get("center"),
            given.get("offset"),
            given.get("inverse_depth"),
            given.get("K"),
            given.get("camera_height_m"),
            given.get("pitch_rad"),
        )
        return tuple(found[name] for names in RESULTS.values() for name in names if name in found)


class Whole(nn.Module):
    """From the image to what a car would use."""

    def __init__(self, maps: FullSize, post: Post):
        super().__init__()
        self.maps, self.post = maps, post

    def forward(self, image_1HW3: Tensor, *camera: Tensor) -> tuple[Tensor, ...]:
        result: tuple[Tensor, ...] = self.post(*self.maps(image_1HW3), *camera)
        return result


def export(
    net: nn.Module,
    size: tuple[int, int],
    path: Path,
    labels: LabelSet,
    evaluate: config.Evaluate,
    post: str = "inside",
    metadata: dict[str, str] | None = None,
) -> list[Path]:
    """Write the file or, with `apart`, both; their paths.

    Args:
        net: a model's `net` in evaluation mode.
        size: H, W.
        metadata: joins what the files say of themselves.

    Raises:
        ValueError: no such `post`, or the package onnx is missing.
    """
    if post not in POST:
        raise ValueError(f"--post '{post}' is none of {', '.join(POST)}")
    graph = strided(net, (1, *size))
    maps = FullSize(graph, size)
    names = [MAPS[name] for name in graph.names]
    camera = list(CAMERA) if "inverse_depth" in names else []
    finish = Post(_finish(labels, evaluate), names + camera)
    results = [*(RESULTS["panoptic"] if "semantic" in names else ())]
    results += RESULTS["depth"] if camera else ()
    image = {"image": torch.randint(0, 256, (1, *size, 3), dtype=torch.uint8)}
    about = _about(labels, size, post) | (metadata or {})
    path.parent.mkdir(parents=True, exist_ok=True)
    if post == "inside":
        onnx_file.write(Whole(maps, finish), image | _camera(camera, size), results, path, about)
        return [path]
    onnx_file.write(maps, image, names, path, about)
    if post == "none":
        return [path]
    with torch.no_grad():
        found = dict(zip(names, maps(image["image"]), strict=True))
    second = path.with_suffix(".post.onnx")
    onnx_file.write(finish, found | _camera(camera, size), results, second, about)
    return [path, second]


def _finish(labels: LabelSet, evaluate: config.Evaluate) -> Finish:
    known = [label.name for label in labels.labels]
    without = tuple(labels.index(name) for name in EGO_AND_SKY if name in known)
    return Finish(labels.things, labels.index("road"), evaluate, without).eval()


def _camera(names: list[str], size: tuple[int, int]) -> dict[str, Tensor]:
    """An example: a camera of 90 degrees, 1.4 m above the road."""
    height, width = size
    K_33 = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    values = {"K": K_33[None], "camera_height_m": torch.tensor([1.4]), "pitch_rad": torch.zeros(1)}
    return {name: values[name].float() for name in names}


def _about(labels: LabelSet, size: tuple[int, int], post: str) -> dict[str, str]:
    return {
        "producer": f"mtl-bench {__version__}",
        "classes": json.dumps([label.name for label in labels.labels]),
        "things": json.dumps(list(labels.things)),
        "height": str(size[0]),
        "width": str(size[1]),
        "input": "image: uint8 [1,H,W,3], RGB",
        "post": post,
    }
