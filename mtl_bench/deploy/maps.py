"""The maps of an inference graph under flat names, and what follows them, as tasks declare it.

A map's flat name is `TASK.MAP`; the index of its largest channel, where that is all that
post-processing reads, is `TASK.MAP.class`. Shapes: B images, C classes, H x W input pixels, h x w
cells of the finest stride.
"""

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.batch import Camera
from mtl_bench.core.task import MapInfo, Results, Task, finish
from mtl_bench.model import Outputs
from mtl_bench.model.network import Network

Maps = dict[str, Tensor]  # by flat names
CLASS = ".class"


def networks_of(net: nn.Module) -> list[Network]:
    """A network, or those of single tasks that stand side by side."""
    return list(getattr(net, "networks", [net]))


def tasks_of(net: nn.Module) -> tuple[Task, ...]:
    """Whose maps a model's `net` predicts."""
    return tuple(task for network in networks_of(net) for task in network.tasks)


def infos(tasks: Iterable[Task]) -> dict[str, MapInfo]:
    """Every map's facts."""
    return {f"{task.name}.{name}": about for task in tasks for name, about in task.maps.items()}


def flat(maps: Mapping[str, Mapping[str, Tensor]], tasks: Iterable[Task]) -> Maps:
    """Maps by task as flat ones, in the order in which tasks declare them."""
    return {f"{task.name}.{name}": maps[task.name][name] for task in tasks for name in task.maps}


def by_task(maps: Mapping[str, Tensor], tasks: Iterable[Task]) -> dict[str, dict[str, Tensor]]:
    """Flat maps by task; of a categorical one the index, where it is there."""

    def of(name: str) -> Tensor:
        return maps[f"{name}{CLASS}"] if f"{name}{CLASS}" in maps else maps[name]

    return {task.name: {name: of(f"{task.name}.{name}") for name in task.maps} for task in tasks}


def of_outputs(out: Outputs, tasks: Sequence[Task]) -> Maps:
    """The maps that the network itself returns, at the image's size, and their classes."""
    found = flat(out.maps, tasks)
    about = infos(tasks)
    return found | {
        f"{name}{CLASS}": found[name].argmax(1) for name in found if about[name].classes
    }


class Last:
    """The last stage of a pass: what a car needs of the maps, seen by this camera."""

    def __init__(self, tasks: Sequence[Task], camera: Camera) -> None:
        self.tasks, self.camera = tuple(tasks), camera

    def __call__(self, maps: Maps) -> dict[str, Results]:
        return finish(self.tasks, by_task(maps, self.tasks), self.camera)


# --- in exported files ----------------------------------------------------------------------------

CAMERA = {  # names of a camera's parts: what they are
    "K": "intrinsics in pixels of the image; the center of its first pixel is (0, 0)",
    "camera_height_m": "above the ground; metres make the results metres",
    "pitch_rad": "of the camera to the ground, positive looks down",
}
IMAGE = {"image": "8-bit RGB, top row first"}


def camera_of(tasks: Iterable[Task], size: tuple[int, int]) -> Maps:
    """What post-processing reads of the camera; here one of 90 degrees, 1.4 m up."""
    height, width = size
    K_33 = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    values = (K_33[None], torch.tensor([1.4]), torch.zeros(1))
    reads = any(task.reads_camera for task in tasks)
    return dict(zip(CAMERA, values, strict=True)) if reads else {}


def delivered(tasks: Sequence[Task], maps: Maps, camera: Sequence[Tensor]) -> list[Tensor]:
    """Every exported result, in the tasks' order; of a task that has points, these are the last."""
    level = torch.zeros(1)
    given = Camera(*camera) if camera else Camera(torch.eye(3)[None], level + 1, level)
    results = finish(tasks, by_task(maps, tasks), given)
    found = []
    for task in tasks:
        found += [results[task.name][name] for name in task.exported]
        points = task.points(results, given)
        found += [] if points is None else [points]
    return found


def meanings(tasks: Iterable[Task]) -> dict[str, str]:
    """Of the inputs and outputs of exported files by name, as far as tasks say it."""
    own = {_of(task, name): about for task in tasks for name, about in task.meaning.items()}
    return IMAGE | CAMERA | own


def maps_of(tasks: Iterable[Task]) -> list[str]:
    """Names of exported maps."""
    return [_of(task, about.exported) for task in tasks for about in task.maps.values()]


def results_of(tasks: Iterable[Task]) -> list[str]:
    """Names of what `delivered` gives."""
    return [
        _of(task, name)
        for task in tasks
        for name in (*task.exported, *(["points"] if task.has_points else []))
    ]


def _of(task: Task, name: str) -> str:
    """A name that no other task's file has: one task may stand there for several fields."""
    return f"{name}:{task.field}" if task.field else name
