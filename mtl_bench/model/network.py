"""The multi-task network: one backbone, one context module, and what each task brings.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 3.1 and figure 2.
Shapes: B images, C channels, H x W input pixels, h x w cells of the finest stride.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mtl_bench.core import config, plugins
from mtl_bench.core.backbone import VECTOR, Backbone, check_size
from mtl_bench.core.batch import Batch
from mtl_bench.core.config import FROZEN
from mtl_bench.core.plain import did_you_mean
from mtl_bench.core.task import Maps, Task, TaskHead
from mtl_bench.model.layers import MGNET, Decoder, GlobalContext, Normalize, init_fan_in


@dataclass
class Outputs:
    """Every task's maps at the input's size, float32, and in training what the decoders read."""

    maps: dict[str, Maps] = field(default_factory=dict)  # by task
    representation: list[Tensor] = field(default_factory=list)


class Network(nn.Module):
    """What runs at inference. In training mode it also predicts what only losses read."""

    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {"train": ("freeze", "train")}

    def __init__(self, backbone: Backbone, sizes: config.Network, tasks: Sequence[Task]):
        super().__init__()
        self.normalize = Normalize(backbone.mean, backbone.std)
        self.backbone = backbone
        self.strides = sizes.strides
        inputs: tuple[int, ...] = ()
        self.context: GlobalContext | None = None  # of a vector, that; else nothing reads it
        if not backbone.vector:
            inputs = tuple(backbone.channels[stride] for stride in sizes.strides)
            if sizes.decoder == MGNET:
                self.context = GlobalContext(inputs[-1], sizes.channels)
                init_fan_in(self.context)
        self.tasks = tuple(tasks)
        # All decoders come before all heads, under names of their own: so checkpoints have them.
        self.decoders, self.heads = nn.ModuleDict(), nn.ModuleDict()
        self._parts: dict[str, TaskHead] = {}
        for task in tasks:
            part = task.head(inputs, sizes)
            if self.context is None and any(isinstance(m, Decoder) for m in part.modules()):
                raise ValueError(
                    f"network.decoder = '{sizes.decoder}', but task '{task.name}' has decoders of "
                    f"its own: set it to '{MGNET}'"
                )
            for own, ours in ((part.decoders, self.decoders), (part.heads, self.heads)):
                taken = own.keys() & ours.keys()
                if taken:
                    raise ValueError(
                        f"task '{task.name}' names a decoder or head '{taken.pop()}', as another "
                        f"task does: rename it"
                    )
                ours.update(dict(own.items()))
            self._parts[task.name] = part

    def freeze(self, what: str) -> None:
        """Let the backbone's stem, or all of the backbone, learn no more.

        Raises:
            ValueError: neither of them, or a backbone that names no stem.
        """
        known = {"stem": self.backbone.stem, "all": self.backbone.parameters}
        if what not in known:
            raise ValueError(f"backbone.{FROZEN} is not '{what}'{did_you_mean(what, known)}")
        for parameter in known[what]():
            parameter.requires_grad_(False)

    def train(self, mode: bool = True) -> Self:
        """Statistics of what is frozen stay as they are, too."""
        super().train(mode)
        for module in self.backbone.modules():
            own = list(module.parameters(recurse=False))
            if own and not any(parameter.requires_grad for parameter in own):
                module.eval()
        return self

    def keep(self, names: Collection[str]) -> None:
        """Drop the decoders and heads of other tasks."""
        for task in [task for task in self.tasks if task.name not in names]:
            part = self._parts.pop(task.name)
            for own, ours in ((part.decoders, self.decoders), (part.heads, self.heads)):
                for name in own:
                    del ours[name]
        self.tasks = tuple(task for task in self.tasks if task.name in names)

    def like_trained(self, image_B3HW: Tensor) -> None:
        """Give random weights what the time of post-processing depends on, by this image."""
        with torch.no_grad():
            maps = self(image_B3HW).maps
        for task in self.tasks:
            task.like_trained(self._parts[task.name], maps[task.name])

    def features(self, normalized_B3HW: Tensor) -> tuple[list[Tensor], Tensor]:
        """What decoders read of a normalised image: the pyramid, finest first, and the context,
        which is empty where none reads it."""
        features = self.backbone(normalized_B3HW)
        if VECTOR in features:
            return [], features[VECTOR][..., None, None]
        pyramid = [features[stride] for stride in self.strides]
        deepest = pyramid[-1]
        return pyramid, deepest.new_empty(0) if self.context is None else self.context(deepest)

    def raw(self, pyramid: Sequence[Tensor], context_BC11: Tensor) -> dict[str, Maps]:
        """Every task's raw maps [B,C,h,w]."""
        return {
            name: part.forward(pyramid, context_BC11, auxiliary=self.training)
            for name, part in self._parts.items()
        }

    def forward(self, image_B3HW: Tensor) -> Outputs:
        pyramid, context = self.features(self.normalize(image_B3HW))
        outputs = Outputs()
        if self.training:
            # Views: a gradient with respect to the last level then leaves out its way through the
            # context module, which has a gradient of its own.
            *pyramid, context = (x.view_as(x) for x in (*pyramid, context))
            outputs.representation = [*pyramid, *([context] if context.numel() else [])]
        raw = self.raw(pyramid, context)
        for task in self.tasks:
            maps = task.activate(raw[task.name])
            outputs.maps[task.name] = {
                name: resize(map_, image_B3HW.shape[2:]) for name, map_ in maps.items()
            }
        return outputs


class SideBySide(nn.Module):
    """Networks that were each trained alone on one task, on the same image one after another."""

    def __init__(self, networks: Iterable[nn.Module]):
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, image_B3HW: Tensor) -> Outputs:
        merged = Outputs()
        for network in self.networks:
            merged.maps |= network(image_B3HW).maps
        return merged


class Model(nn.Module):
    """The network and what only training needs; says which weights are whose."""

    def __init__(self, net: nn.Module, tasks: Sequence[Task]):
        super().__init__()
        self.net = net
        self.tasks = tuple(tasks)
        self._extra: dict[str, dict[str, nn.Module]] = {}
        self._extra_names: list[str] = []

    def keep(self, names: Collection[str]) -> None:
        """Leave only these tasks."""
        if isinstance(self.net, SideBySide):
            nets: list[Any] = list(self.net.networks)
            for net in nets:
                net.keep(names)
            self.net.networks = nn.ModuleList(net for net in nets if net.tasks)
        elif isinstance(self.net, Network):
            self.net.keep(names)
        self.tasks = tuple(task for task in self.tasks if task.name in names)

    def add_extra(self, task: Task, modules: dict[str, nn.Module]) -> None:
        """Networks that a task trains with; they are the model's under their own names."""
        for name, module in modules.items():
            self.add_module(name, module)
            self._extra_names.append(name)
        self._extra[task.name] = modules

    def forward(self, batch: Batch) -> Outputs:
        """The network on a batch, and beside it what else tasks predict of it in training."""
        outputs: Outputs = self.net(batch.image_B3HW)
        for task in self.tasks:
            extra = self._extra.get(task.name)
            if extra:
                outputs.maps[task.name] |= task.training_maps(extra, batch)
        return outputs

    def losses(self, outputs: Outputs, batch: Batch) -> dict[str, Tensor]:
        """The terms of all tasks that have labels, in at least float32 whatever autocast does."""
        values: dict[str, Tensor] = {}
        with torch.autocast(batch.device.type, enabled=False):
            for task in self.tasks:
                values |= task.losses(outputs.maps[task.name], batch)
        return values

    def shared_parameters(self) -> Iterator[nn.Parameter]:
        """Encoder and context module: what all tasks train."""
        assert isinstance(self.net, Network)
        yield from self.net.backbone.parameters()
        if self.net.context is not None:
            yield from self.net.context.parameters()

    def task_parameters(self) -> Iterator[nn.Parameter]:
        """Decoders, heads and further networks: each trained by one task only."""
        yield from self.head_parameters()
        for module in self.extra_modules():
            yield from module.parameters()

    def extra_modules(self) -> Iterator[nn.Module]:
        yield from (getattr(self, name) for name in self._extra_names)

    def head_parameters(self) -> Iterator[nn.Parameter]:
        """Decoders and heads: what the head learning-rate factor applies to."""
        assert isinstance(self.net, Network)
        yield from self.net.decoders.parameters()
        yield from self.net.heads.parameters()


def build_model(cell: config.Cell, tasks: Sequence[Task]) -> Model:
    """The cell's model with fresh (or, where the cell says so, pre-trained) weights.

    Raises:
        ValueError: an unknown backbone, an input that the pyramid does not divide, or a part to
            freeze that is none.
    """
    sizes, data, timed = cell.recipe.network, cell.recipe.data, cell.recipe.latency
    kind = plugins.load("backbones", cell.backbone)
    given: dict[str, Any] = {"pretrained": cell.pretrained, **cell.backbone_args}
    frozen = given.pop(FROZEN, None)
    if kind.vector:
        for task in tasks:
            if task.reads_pyramid:
                raise ValueError(
                    f"task '{task.name}' reads maps, and backbone '{cell.backbone}' gives one "
                    f"vector: choose another backbone"
                )
        given |= {"size": (data.height, data.width), "outputs": sizes.channels}
    else:
        lacking = sorted(set(sizes.strides) - set(kind.offered))
        if lacking:
            raise ValueError(
                f"backbone '{cell.backbone}' has no features at stride {lacking[0]}: set "
                f"network.strides to some of {', '.join(map(str, kind.offered))}"
            )
        given["strides"] = sizes.strides
    timed_size = timed.height or data.height, timed.width or data.width
    for section, size in (("data", (data.height, data.width)), ("latency", timed_size)):
        remedy = f": change {section}.height, {section}.width or network.strides"
        check_size(cell, size, "input", remedy)
    network = Network(kind(**given), sizes, tasks)
    if frozen is not None:
        network.freeze(str(frozen))
    model = Model(network, tasks)
    for task in tasks:
        model.add_extra(task, task.extra(sizes, cell.pretrained == "timm"))
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = sizes.batch_norm_momentum
    return model


def side_by_side(models: Iterable[Model]) -> Model:
    """One model to evaluate and to time; it shares nothing and is not trained."""
    models = list(models)
    net = SideBySide(model.net for model in models)
    return Model(net, [task for model in models for task in model.tasks])


def resize(x_BCHW: Tensor, size: Sequence[int]) -> Tensor:
    """To the input's size, in float32, with the paper's alignment of corners; a vector stays."""
    if x_BCHW.dim() == 2:
        return x_BCHW.float()
    return F.interpolate(x_BCHW.float(), size, mode="bilinear", align_corners=True)
