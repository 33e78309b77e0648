"""A model as ONNX files, for whoever runs it without this package.

Inputs: `image` uint8 [1,H,W,3], RGB, and with post-processing what tasks read of the camera.
Outputs with post-processing `inside` are the tasks' results, without it (`none`) their maps at the
image's size, of classes the index; `apart` makes two files, NAME.post.onnx from the first one's
maps. NAME.json beside them says of every input and output its type, axes, unit, and what stands
where there is no value, and which class has which index. Metadata of each file: classes, things,
size, layout, cell id.
"""

import contextlib
import json
import logging
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench import __version__
from mtl_bench.core.engine import Setting
from mtl_bench.core.files import write_bytes, write_json
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.task import Task
from mtl_bench.deploy import maps
from mtl_bench.deploy.graph import Strided, free, strided
from mtl_bench.model.network import resize

POST = ("inside", "apart", "none")
OPSET = 20


class FullSize(nn.Module):
    """The strided graph, and its maps at the image's size; of classes only their index."""

    def __init__(self, strided: Strided, size: tuple[int, int] | None):
        super().__init__()
        self.strided, self.size = strided, size  # `graph` is a name that torch.fx uses

    def forward(self, image_1HW3: Tensor) -> tuple[Tensor, ...]:
        size = self.size or image_1HW3.shape[1:3]
        found = [resize(x, size) for x in self.strided(image_1HW3)]
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
    multiple: int | None = None,
) -> list[Path]:
    """Write the file or, with `apart`, both, and the JSON file that describes them; their paths.

    Args:
        net: a model's `net` in evaluation mode.
        size: H, W.
        metadata: joins what the files say of themselves.
        multiple: height and width are free, in multiples of this; without post-processing, whose
            lengths and areas are made for one size.

    Raises:
        ValueError: no such `post`, the package onnx is missing, a size cannot be free, or two
            inputs or outputs of a file have one name.
    """
    if post not in POST:
        raise ValueError(f"--post '{post}' is none of {', '.join(POST)}")
    if path.suffix == ".json":
        raise ValueError(f"--out '{path}' is the name of the file that describes it: name an .onnx")
    if multiple is not None and post != "none":
        raise ValueError(
            "--dynamic goes with --post none: the post-processing is made for one size, in pixels"
        )
    if multiple is not None and any(n.backbone.vector for n in maps.networks_of(net)):
        raise ValueError(
            f"--dynamic: the backbone gives one vector, and is made for {size[0]}x{size[1]} alone: "
            "leave it out"
        )
    tasks = maps.tasks_of(net)
    names, results = maps.maps_of(tasks), maps.results_of(tasks)
    _check_names(post, names, results)
    graph = strided(net, (1, *size), multiple=multiple)
    full = FullSize(graph, size if multiple is None else None)
    camera, finish = maps.camera_of(tasks, size), Post(tasks)
    image = {"image": torch.randint(0, 256, (1, *size, 3), dtype=torch.uint8)}
    about = _about(tasks[0].labels, size, post) | (metadata or {})
    if multiple is not None:
        about |= dict.fromkeys(("height", "width"), f"multiples of {multiple}")
    path.parent.mkdir(parents=True, exist_ok=True)
    paths, second = [path], path.with_suffix(".post.onnx")
    if post == "inside":
        write(Whole(full, finish), image | camera, results, path, about)
    else:
        write(full, image, names, path, about, multiple)
    if post == "apart":
        with torch.no_grad():
            found = dict(zip(names, full(image["image"]), strict=True))
        write(finish, found | camera, results, second, about)
        paths.append(second)
    write_json(path.with_suffix(".json"), _described(paths, tasks, about))
    return paths


def ports(path: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Type and axes of a file's inputs and outputs, by name."""
    import onnx

    def of(values: Iterable[Any]) -> dict[str, dict[str, Any]]:
        types = {value.name: value.type.tensor_type for value in values}
        return {
            name: {
                "type": onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type).name,
                "axes": [axis.dim_param or axis.dim_value for axis in kind.shape.dim],
            }
            for name, kind in types.items()
        }

    graph = onnx.load(str(path)).graph
    return {"inputs": of(graph.input), "outputs": of(graph.output)}


def _check_names(post: str, names: Sequence[str], results: Sequence[str]) -> None:
    """Each input and output of a file has a name of its own: the maps, or the tasks' results."""
    files = {"inside": [results], "none": [names], "apart": [names, results]}[post]
    for name, count in (pair for outputs in files for pair in Counter(outputs).items()):
        if count > 1:
            raise ValueError(
                f"two outputs of the file are called '{name}': leave out one of the tasks that "
                "give it, --tasks NAME,NAME"
            )
    both = [name for name in names if name in results]
    if post == "apart" and both:
        raise ValueError(
            f"--post apart: '{both[0]}' would be an input and an output of the second file: "
            "choose --post inside or none"
        )


def _described(
    paths: Iterable[Path], tasks: Sequence[Task], about: Mapping[str, str]
) -> dict[str, Any]:
    """What `NAME.json` holds."""
    meaning = maps.meanings(tasks)
    files = {path.name: ports(path) for path in paths}
    for file in files.values():
        for name, port in (*file["inputs"].items(), *file["outputs"].items()):
            port["what"] = meaning.get(name, "")
    labels = tasks[0].labels.labels
    classes = [
        {"index": index, "name": label.name, "label_id": label.label_id, "thing": label.is_thing}
        for index, label in enumerate(labels)
    ]
    facts = {key: value for key, value in about.items() if key not in ("classes", "things")}
    return {**facts, "files": files, "classes": classes}


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
    multiple: int | None = None,
) -> None:
    """Write a module as an ONNX file, which has its name once it is whole and sound.

    Args:
        inputs: names and examples, in the order of the module's arguments.
        outputs: names, in the order of its results.
        metadata: goes into the file's metadata_props.
        multiple: second and third axis of the one input are free, in multiples of this.

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
            dynamic_shapes=None if multiple is None else (free(multiple, 1, 2),),
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
