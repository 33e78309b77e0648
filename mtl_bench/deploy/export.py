"""A model as ONNX files of a fixed size, for whoever runs it without this package.

Inputs: `image` uint8 [1,H,W,3], RGB. With depth and the post-processing inside also `K` [1,3,3]
(intrinsics in pixels of that image), `camera_height_m` [1] and `pitch_rad` [1] (to the ground,
positive looks down).

Outputs, post-processing `inside`: see the tasks.
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

import contextlib
import json
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench import __version__
from mtl_bench.core.engine import Setting
from mtl_bench.core.files import write_bytes
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.task import Task
from mtl_bench.deploy import maps
from mtl_bench.deploy.graph import Strided, strided

POST = ("inside", "apart", "none")
OPSET = 20


class FullSize(nn.Module):
    """The strided graph, and its maps at the image's size; of classes only their index."""

    def __init__(self, strided: Strided, size: tuple[int, int]):
        super().__init__()
        self.strided, self.size = strided, size  # `graph` is a name that torch.fx uses

    def forward(self, image_1HW3: Tensor) -> tuple[Tensor, ...]:
        found = [
            F.interpolate(x, self.size, mode="bilinear", align_corners=True)
            for x in self.strided(image_1HW3)
        ]
        infos = maps.infos(self.strided.tasks).values()
        return tuple(
            map_.argmax(1).int() if about.classes else map_
            for about, map_ in zip(infos, found, strict=True)
        )


class Post(nn.Module):
    """Post-processing with its inputs by position: the maps, then the camera."""

    def __init__(self, tasks: Sequence[Task]):
        super().__init__()
        self.tasks, self.names = tuple(tasks), list(maps.infos(tasks))

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        count = len(self.names)
        given = dict(zip(self.names, values[:count], strict=True))
        return tuple(maps.delivered(self.tasks, given, values[count:]))


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
    full = FullSize(graph, size)
    tasks = graph.tasks
    names = [about.exported for about in maps.infos(tasks).values()]
    camera = maps.camera_of(tasks, size)
    finish, results = Post(tasks), maps.results_of(tasks)
    image = {"image": torch.randint(0, 256, (1, *size, 3), dtype=torch.uint8)}
    about = _about(tasks[0].labels, size, post) | (metadata or {})
    path.parent.mkdir(parents=True, exist_ok=True)
    if post == "inside":
        write(Whole(full, finish), image | camera, results, path, about)
        return [path]
    write(full, image, names, path, about)
    if post == "none":
        return [path]
    with torch.no_grad():
        found = dict(zip(names, full(image["image"]), strict=True))
    second = path.with_suffix(".post.onnx")
    write(finish, found | camera, results, second, about)
    return [path, second]


@contextlib.contextmanager
def strided_file(net: nn.Module, setting: Setting) -> Iterator[tuple[Path, list[str]]]:
    """For engines: the strided graph as a temporary ONNX file in float32; its path and outputs."""
    graph = strided(net, (setting.batch, *setting.size))
    image_BHW3 = torch.zeros(
        setting.batch, *setting.size, 3, dtype=torch.uint8, device=setting.device
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "strided.onnx"
        write(graph, {"image": image_BHW3}, graph.names, path)
        yield path, graph.names


def write(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    path: Path,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a module as an ONNX file, which has its name once it is whole and sound.

    Args:
        inputs: names and examples, in the order of the module's arguments.
        outputs: names, in the order of its results.
        metadata: goes into the file's metadata_props.

    Raises:
        ValueError: the package onnx is missing.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ValueError(
            f"ONNX files need the package {error.name}: pip install 'mtl-bench[onnx]'"
        ) from None
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of the exporter about itself
        program = torch.onnx.export(
            module,
            tuple(inputs.values()),
            dynamo=True,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model, full_check=True)
    write_bytes(path, model.SerializeToString())


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
