"""What every engine has to hold, on a small network with normalisations as training leaves them."""

import functools
from collections.abc import Callable

import torch
from torch import Tensor, nn

from mtl_bench.core import provenance
from mtl_bench.core.backbone import Backbone
from mtl_bench.core.batch import Camera
from mtl_bench.core.config import load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import choose_device
from mtl_bench.core.engine import PRECISIONS, Engine, Setting
from mtl_bench.core.task import tasks_of
from mtl_bench.deploy import engines, timer
from mtl_bench.deploy.maps import CLASS, infos
from mtl_bench.deploy.subject import Subject
from mtl_bench.model.network import Network

RECIPE = "smoke"  # the network's sizes
SIZE = (64, 128)


class Pyramid(Backbone):
    """A convolution, a normalisation and an activation at every level."""

    def __init__(self, strides: tuple[int, ...], width: int = 8):
        super().__init__()
        self.levels = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width if level else 3, width, 3, stride=2, padding=1, bias=False),
                nn.BatchNorm2d(width),
                nn.ReLU(),
            )
            for level in range(max(strides).bit_length() - 1)
        )
        self.channels = dict.fromkeys(strides, width)

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        found, x_BCHW = {}, image_B3HW
        for number, level in enumerate(self.levels, 1):
            x_BCHW = level(x_BCHW)
            found[2**number] = x_BCHW
        return {stride: found[stride] for stride in self.channels}


@functools.cache
def subject(device: torch.device) -> Subject:
    """Images are smooth enough that neighbours look alike."""
    recipe = load_recipe(RECIPE)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        backbone = Pyramid(recipe.network.strides)
        tasks = tasks_of(recipe, recipe.tasks, dataset_of(recipe).labels)
        net = Network(backbone, recipe.network, tasks).eval()
        for module in net.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean.normal_(0, 0.3)  # type: ignore[union-attr]
                module.running_var.uniform_(0.5, 2)  # type: ignore[union-attr]
        coarse_B3hw = torch.rand(2, 3, 4, 8)
    fine_B3HW = nn.functional.interpolate(coarse_B3hw, SIZE, mode="bicubic").clamp(0, 1)
    images_BHW3 = (fine_B3HW * 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    K_133 = torch.tensor([[[115.0, 0, 63.5], [0, 115, 31.5], [0, 0, 1]]])
    images = list(images_BHW3.split(1))
    return Subject(
        net=net.to(device),
        backbone="",
        tasks=tasks,
        images=images,
        examples=images,
        camera=Camera(K_133, torch.tensor([1.4]), torch.zeros(1)),
        trained=None,
    )


@functools.cache
def _build(kind: type[Engine], precision: str, batch: int = 1) -> Engine:
    device = choose_device()
    setting = Setting(batch, *SIZE, precision, device, provenance.cores())
    return timer.build(kind, subject(device), setting)


def _run(engine: Engine, image_BHW3: Tensor) -> dict[str, Tensor]:
    """Maps that the next pass leaves alone."""
    with torch.inference_mode():
        found = engine.run(engine.transfer(image_BHW3))
        return {name: map_.clone() for name, map_ in found.items()}


def _here(check: Callable[[type[Engine], str], str | None]) -> Callable[[type[Engine]], str | None]:
    """Only where the engine can run: in its first precision on this device, which has to work."""

    def checked(kind: type[Engine]) -> str | None:
        lack, precisions = kind.lack(), kind.precisions.get(choose_device().type, ())
        if lack or not precisions:
            return f"not tried: {lack or f'nothing declared for {choose_device().type}'}"
        return check(kind, precisions[0])

    return checked


def _declared(kind: type[Engine]) -> None:
    for device, precisions in kind.precisions.items():
        unknown = set(precisions) - set(PRECISIONS)
        if device not in ("cpu", "cuda") or not precisions or unknown:
            known = ", ".join(PRECISIONS)
            raise ValueError(f"precisions of {device}: {precisions} (known: {known})")
    if not kind.precisions or not kind.packages:
        raise ValueError("an engine has precisions, and a package whose version stands in rows")


def _complete(kind: type[Engine], precision: str) -> None:
    """Every map is there, at the image's size or, where it is reduced, at the finest stride."""
    found = _run(_build(kind, precision), subject(choose_device()).images[0])
    about = infos(subject(choose_device()).tasks)
    wanted = {*about, *(f"{name}{CLASS}" for name in about if about[name].classes)}
    if set(found) != wanted:
        raise ValueError(f"maps {sorted(found)} are not {sorted(wanted)}")
    for name, map_ in found.items():
        full = tuple(map_.shape[-2:]) == SIZE
        if not full and not (name in about and about[name].classes):
            raise ValueError(f"{name}: {tuple(map_.shape)} is not of the size {SIZE}")
        if name in about and map_.dtype != torch.float32:
            raise ValueError(f"{name} is {map_.dtype}, not float32")


def _agrees(kind: type[Engine], first: str) -> str | None:
    """In every precision; a further one that this machine does not have is said, not failed."""
    device, said = choose_device(), []
    for precision in kind.precisions[device.type]:
        try:
            engine = _build(kind, precision)
        except ValueError as error:
            if precision == first:
                raise
            said.append(str(error))
            continue
        with torch.inference_mode():
            wrong = timer.compare(subject(device), engine).wrong(precision, trained=False)
        if wrong:
            raise ValueError(f"{precision} differs from {engines.REFERENCE}: {wrong}")
    return "; ".join(said) or None


def _repeats(kind: type[Engine], precision: str) -> None:
    engine, image_1HW3 = _build(kind, precision), subject(choose_device()).images[0]
    first, second = (_run(engine, image_1HW3) for _ in range(2))
    different = [name for name in first if not torch.equal(first[name], second[name])]
    if different:
        raise ValueError(f"a second run on the same image has other maps: {', '.join(different)}")


def _batch(kind: type[Engine], precision: str) -> None:
    """A batch of two is its two images."""
    images = subject(choose_device()).images
    one, two = (_build(kind, precision, batch) for batch in (1, 2))
    both = _run(two, torch.cat(images))
    for number, image_1HW3 in enumerate(images):
        for name, map_ in _run(one, image_1HW3).items():
            if name.endswith(CLASS):
                continue  # an index: a tie may go either way
            off = (both[name][number] - map_[0]).abs().max() / map_.abs().max()
            if not off <= 1e-3:
                raise ValueError(f"{name} of image {number} in a batch of 2 is {off:.2g} off")


ENGINE_CHECKS: dict[str, Callable[[type[Engine]], str | None]] = {
    "declared": _declared,
    "maps of the contract": _here(_complete),
    "agrees with plain": _here(_agrees),
    "same image, same maps": _here(_repeats),
    "a batch of 2": _here(_batch),
}
