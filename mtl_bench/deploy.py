"""Networks as they are deployed: of a checkpoint or with random weights, and images to look at."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mtl_bench import latency
from mtl_bench.bench import results
from mtl_bench.bench.stored import load_model
from mtl_bench.core import config
from mtl_bench.core.config import Cell, Recipe, load_recipe
from mtl_bench.core.device import Engine, initial_weights
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import labels_of
from mtl_bench.data.loader import open_dataset
from mtl_bench.engines.scene import Camera, Subject
from mtl_bench.model import Model, build_model

IMAGES = 50  # distinct ones
BUILT_IN = "small"  # recipe of the built-in frames that stand in where no data set is given
SEED = 0
THINGS_SHARE = 0.1  # of the pixels of a street scene; Cityscapes' is a bit less
PARTS = {  # decoders and heads of a task
    "panoptic": ("semantic", "instance", "center", "offset"),
    "depth": ("depth",),
}


def from_checkpoint(path: Path, tasks: tuple[str, ...] | None) -> tuple[Cell, Model]:
    """A trained cell and its model.

    Args:
        path: a run's folder, or its checkpoint.
        tasks: leave only these; None: all that it was trained for.

    Raises:
        ValueError: no checkpoint there, or it has not been trained for a task.
    """
    if not path.exists():
        raise ValueError(f"no run or checkpoint '{path}'")
    weights = path / "last.pt" if path.is_dir() else path
    cell = results.load_cell(weights.parent / "cell.json")
    model = load_model(cell, weights, Engine(torch.device("cpu")))
    lacking = [task for task in tasks or () if task not in cell.tasks]
    if lacking:
        raise ValueError(f"{path} is trained for {', '.join(cell.tasks)}, not for {lacking[0]}")
    return cell, _only(model, tasks or cell.tasks)


def untrained(
    backbone: str, recipe: str | None, tasks: tuple[str, ...], settings: Iterable[str] = ()
) -> tuple[Cell, Model]:
    """A cell that nobody trained, and its model with random weights, the same every time.

    Args:
        recipe: None: the paper's network, and the frames of the default recipe to look at.
        settings: key=value, as `config.override` takes them.
    """
    chosen = load_recipe(recipe) if recipe else replace(Recipe(), data=load_recipe(BUILT_IN).data)
    cell = config.override(Cell(chosen, backbone, method="", tasks=tasks), settings)
    with initial_weights(SEED):
        return cell, build_model(cell, labels_of(cell.recipe.data.dataset))


def subject(
    cell: Cell,
    model: Model,
    size: tuple[int, int],
    data: Path,
    device: torch.device,
    trained: bool,
    images: int = IMAGES,
) -> Subject:
    """A network and the evaluation split's first frames at a size.

    Raises:
        ValueError: a size that the network's deepest stride does not divide.
    """
    check_size(cell, size)
    labels = labels_of(cell.recipe.data.dataset)
    looks = replace(cell, tasks=(), single_task=False, video=False)  # at images, not at labels
    dataset = open_dataset(looks, cell.recipe.evaluate.split, data, training=False)
    samples = [dataset.sample(n, None) for n in range(min(images, len(dataset)))]
    hosts, K_133 = latency.prepare(
        (sample.image_B3HW for sample in samples),
        samples[0].K_B33,
        config.Latency(passes=images, height=size[0], width=size[1]),
        pin=False,
    )
    hosts = [host.permute(0, 2, 3, 1).contiguous() for host in hosts]
    if not trained and "panoptic" in model_tasks(model):
        name_classes(model, hosts[0], labels.things)
    if device.type == "cuda":
        hosts = [host.pin_memory() for host in hosts]
    origin = {"cell_id": cell.id, "slug": cell.slug, "recipe": cell.recipe.name}
    return Subject(
        net=model.net.eval().to(device),
        backbone=cell.backbone,
        tasks=tuple(model_tasks(model)),
        images=hosts,
        camera=_camera(samples[0], K_133),
        things=labels.things,
        road=labels.index("road"),
        evaluate=cell.recipe.evaluate,
        trained=origin if trained else None,
    )


def name_classes(model: Model, image_1HW3: Tensor, things: tuple[int, ...]) -> None:
    """Give random weights' classes new numbers: things then cover no more of an image than in a
    street, which is what the time of grouping depends on. Weights drawn in another order are as
    random."""
    (network,) = getattr(model.net, "networks", [model.net])
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


def model_tasks(model: Model) -> list[str]:
    """In config.TASKS' order."""
    networks = getattr(model.net, "networks", [model.net])
    names = {name for network in networks for name in network.decoders}
    return [task for task in config.TASKS if PARTS[task][0] in names]


def check_size(cell: Cell, size: tuple[int, int]) -> None:
    """Raises:
    ValueError: a size that the network's deepest stride does not divide.
    """
    deepest = cell.recipe.network.strides[2]
    if size[0] % deepest or size[1] % deepest:
        raise ValueError(f"--size {size[0]}x{size[1]}: the network needs multiples of {deepest}")


def _camera(sample: Batch, K_133: torch.Tensor) -> Camera:
    return Camera(
        K_133,
        torch.as_tensor(sample.camera_height_m_B).reshape(1).float(),
        torch.as_tensor(sample.camera_pitch_rad_B).reshape(1).float(),
    )


def _only(model: Model, tasks: tuple[str, ...]) -> Model:
    """Without the decoders of other tasks."""
    gone = [name for task, names in PARTS.items() if task not in tasks for name in names]
    networks = getattr(model.net, "networks", [model.net])
    for network in networks:
        for parts in (network.decoders, network.heads):
            for name in gone:
                if name in parts:
                    del parts[name]
    kept = [network for network in networks if len(network.decoders)]
    if len(kept) < len(networks):
        model.net.networks = torch.nn.ModuleList(kept)
    return model
