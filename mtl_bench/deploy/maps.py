"""The maps of an inference graph by name: whose they are, what is made of them, what follows them.

All that this room knows about tasks stands here. The rest of it walks over `MAPS` and asks what an
entry says. Shapes: B images, C classes, H x W input pixels, h x w cells of the finest stride.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.data.labels import LabelSet
from mtl_bench.model import Model, Outputs
from mtl_bench.tasks.finish import Finish

Maps = dict[str, Tensor]  # by the names of MAPS, and of what they are reduced to


@dataclass(frozen=True)
class Map:
    """What a head predicts.

    Attributes:
        decoder, head: names of the network's parts that it comes from.
        exported: its name in an exported file.
        results: what `Finish` makes of it, together with the task's other maps.
        reduced: name of the index of its largest channel, which is all that post-processing reads
            of it; empty: every value is read. Engines have to agree on the ids that are the result.
        quantity: what this map is the inverse of; engines have to agree on it by ratio.
    """

    task: str
    decoder: str
    head: str
    exported: str
    results: tuple[str, ...] = ()
    reduced: str = ""
    quantity: str = ""


MAPS = {
    "logits": Map("panoptic", "semantic", "semantic", "semantic", ("panoptic",), reduced="class"),
    "center": Map("panoptic", "instance", "center", "center"),
    "offset": Map("panoptic", "instance", "offset", "offset"),
    "inverse": Map(
        "depth", "depth", "depth", "inverse_depth", ("depth_m", "points"), quantity="depth"
    ),
}
THINGS_SHARE = 0.1  # of the pixels of a street scene; Cityscapes' is a bit less
EGO_AND_SKY = ("ego vehicle", "sky")


# --- from the network -----------------------------------------------------------------------------


def networks_of(net: nn.Module) -> list[Any]:
    """A network, or those of single tasks that stand side by side."""
    return list(getattr(net, "networks", [net]))


def names_of(net: nn.Module) -> list[str]:
    """The maps that a model's `net` predicts, in MAPS' order."""
    decoders = {name for network in networks_of(net) for name in network.decoders}
    return [name for name, about in MAPS.items() if about.decoder in decoders]


def tasks_of(names: Iterable[str]) -> tuple[str, ...]:
    """Whose maps these are."""
    return tuple(dict.fromkeys(MAPS[name].task for name in names))


def raw(network: Any, x_B3HW: Tensor) -> Maps:
    """Normalised image -> what the last convolutions of one network say, at the finest stride."""
    features = network.backbone(x_B3HW)
    pyramid = [features[stride] for stride in network.strides]
    context = network.context(pyramid[2])
    decoded = {key: d(pyramid, context)[0] for key, d in network.decoders.items()}
    found = {}
    for name, about in MAPS.items():
        if about.decoder in decoded:
            head = network.heads[about.head]
            finest = head[0] if isinstance(head, nn.ModuleList) else head
            found[name] = finest(decoded[about.decoder])
    return found


def activations(network: Any) -> dict[str, Callable[[Tensor], Tensor]]:
    """What makes a raw map, float32, the one that post-processing reads; others stay as they are.

    `center` in [0, 1]; `offset` (y, x) in pixels; `inverse` depth.
    """
    stride, min_depth = network.strides[0], network.min_depth
    return {
        "center": torch.sigmoid,
        "offset": lambda raw_B2hw: raw_B2hw * stride,
        "inverse": lambda raw_B1hw: raw_B1hw.sigmoid() / min_depth,
    }


def of_outputs(out: Outputs) -> Maps:
    """The maps that the network itself returns, at the image's size."""
    found = {
        "logits": out.semantic_BCHW,
        "center": out.center_B1HW,
        "offset": out.offset_B2HW,
        "inverse": out.inverse_depth[0] if out.inverse_depth else None,
    }
    return {name: map_ for name, map_ in found.items() if map_ is not None}


def keep(model: Model, tasks: Iterable[str]) -> Model:
    """The model without the decoders and heads of other tasks."""
    gone = [about for about in MAPS.values() if about.task not in tasks]
    networks = networks_of(model.net)
    for network in networks:
        for about in gone:
            for parts, name in ((network.decoders, about.decoder), (network.heads, about.head)):
                if name in parts:
                    del parts[name]
    kept = [network for network in networks if len(network.decoders)]
    if len(kept) < len(networks):
        model.net.networks = nn.ModuleList(kept)
    return model


def name_classes(model: Model, image_1HW3: Tensor, things: tuple[int, ...]) -> None:
    """Give random weights' classes new numbers: things then cover no more of an image than in a
    street, which is what the time of grouping depends on. Weights drawn in another order are as
    random. A model without classes stays as it is."""
    if "logits" not in names_of(model.net):
        return
    (network,) = networks_of(model.net)
    with torch.no_grad():
        logits_1CHW = network.eval()(image_1HW3.permute(0, 3, 1, 2) / 255).semantic_BCHW
        classes = logits_1CHW.shape[1]
        share_C = torch.bincount(logits_1CHW.argmax(1).flatten(), minlength=classes) / 1.0
    share_C /= share_C.sum()
    chosen: list[int] = []
    for number in share_C.argsort(descending=True).tolist():
        fits = share_C[[*chosen, number]].sum() <= THINGS_SHARE
        chosen += [number] if fits and len(chosen) < len(things) else []
    chosen += [n for n in share_C.argsort().tolist() if n not in chosen][
        : len(things) - len(chosen)
    ]
    others = iter([number for number in range(classes) if number not in chosen])
    taken = iter(chosen)
    order = [next(taken if number in things else others) for number in range(classes)]
    last = network.heads["semantic"][1]
    last.weight.data = last.weight.data[order].clone()


# --- to what a car needs --------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """That took the images."""

    K_133: Tensor
    camera_height_m_1: Tensor
    pitch_rad_1: Tensor  # positive looks down

    def inputs(self, images: int = 1, device: torch.device | str = "cpu") -> Maps:
        """For so many images, by the names that exported files have for them."""
        given = (self.K_133, self.camera_height_m_1, self.pitch_rad_1)
        names = ("K", "camera_height_m", "pitch_rad")
        return {
            name: value.expand(images, *value.shape[1:]).to(device)
            for name, value in zip(names, given, strict=True)
        }


class Last:
    """The last stage of a pass: what a car needs of the maps, seen by a camera.

    Args:
        things: class indices that have instances.
        road: class index that the depth's scale is taken from.
        camera: `Camera.inputs`.
    """

    def __init__(self, things: tuple[int, ...], road: int, evaluate: config.Evaluate, camera: Maps):
        self.finish, self.camera = Finish(things, road, evaluate), camera

    def __call__(self, maps: Maps) -> Maps:
        return finished(self.finish, maps | self.camera)


def finished(finish: Finish, given: Maps) -> Maps:
    """`Finish`'s results from maps and the camera by name; classes from their index if it is there.

    Without it from the logits.
    """
    found: Maps = finish(
        given.get("class", given.get("logits")),
        given.get("center"),
        given.get("offset"),
        given.get("inverse"),
        given.get("K"),
        given.get("camera_height_m"),
        given.get("pitch_rad"),
    )
    return found


# --- in exported files ----------------------------------------------------------------------------


def finish_of(labels: LabelSet, evaluate: config.Evaluate) -> Finish:
    """Post-processing with points, none of them on the car itself or in the sky."""
    known = [label.name for label in labels.labels]
    without = tuple(labels.index(name) for name in EGO_AND_SKY if name in known)
    return Finish(labels.things, labels.index("road"), evaluate, without).eval()


def results_of(names: Iterable[str]) -> list[str]:
    """What `Finish` makes of these maps."""
    return [result for name in names for result in MAPS[name].results]


def camera_of(names: Iterable[str], size: tuple[int, int]) -> Maps:
    """What post-processing of these maps needs of the camera; here one of 90 degrees, 1.4 m up."""
    height, width = size
    K_33 = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    camera = Camera(K_33[None], torch.tensor([1.4]), torch.zeros(1))
    return camera.inputs() if "inverse" in names else {}
