"""What a backbone is: an image in, a feature pyramid out, keyed by stride; or one vector."""

import functools
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, ClassVar

import timm
import torch
from torch import Tensor, nn

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell

VECTOR = 0  # stands for a stride where a backbone gives one vector


class Backbone(nn.Module):
    """Base of every file in `backbones/`.

    A subclass sets `channels` and implements `forward`. Its constructor takes `strides`, the
    pyramid levels that will be read (deeper ones need not be built), and `pretrained`.

    One that gives a vector says `vector = True`. Its constructor takes `size`, the input's height
    and width, and `outputs`, how many numbers the vector has, in place of `strides`; VECTOR is the
    only key of `channels` and of what `forward` gives, [B, outputs].
    """

    vector: ClassVar[bool] = False

    mean: tuple[float, float, float] = (
        0.485,
        0.456,
        0.406,
    )  # RGB in [0, 1], what it was trained with
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    channels: dict[int, int]  # stride -> channels
    offered: ClassVar[tuple[int, ...]] = (2, 4, 8, 16, 32)  # strides of what it can give
    divisor: ClassVar[int] = 1  # of height and width, where that is more than the deepest stride
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {"train": ("stem",)}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        """Normalised image -> {stride: features [B, channels[stride], H/stride, W/stride]}."""
        raise NotImplementedError

    def stem(self) -> Iterable[nn.Parameter]:
        """The parameters before the first stage, for `backbone.frozen=stem`."""
        raise ValueError(f"{type(self).__name__} names no stem; set backbone.frozen=all")


class TimmBackbone(Backbone):
    """Any timm model with `features_only`: a subclass needs `timm_name` and a docstring.

    Args:
        strides: pyramid levels to return; stages deeper than the last are not built.
        pretrained: None for random weights, "timm" for timm's own (hub or local cache), or the
            path of a .pth or .safetensors file with timm's parameter names.

    Raises:
        ValueError: the model has no features at these strides, or the weights are not its own.
    """

    timm_name: str
    output_stride: ClassVar[int] = 32  # 8 or 16: the stages behind it are dilated in place of that

    def __init__(self, strides: tuple[int, ...] = (8, 16, 32), pretrained: str | None = None):
        super().__init__()
        name = self.timm_name
        level_of, options = _levels(name, self.output_stride)
        lacking = [stride for stride in strides if stride not in level_of]
        if lacking:
            raise ValueError(
                f"timm's {name} has features at the strides {_listed(level_of)}, none at "
                f"{_listed(lacking)}: set network.strides, or take another model"
            )
        if pretrained == "timm" and not timm.is_model_pretrained(name):
            raise ValueError(f"timm has no weights for {name}: leave out --pretrained")
        deepest = max(level_of[stride] for stride in strides)
        self.pyramid = timm.create_model(
            name,
            pretrained=pretrained == "timm",
            features_only=True,
            out_indices=tuple(sorted(i for i in level_of.values() if i <= deepest)),
            **options,
        )
        if pretrained not in (None, "timm"):
            load_weights(self.pyramid, Path(str(pretrained)), _whole(name, self.output_stride))
        info = self.pyramid.feature_info
        reductions = dict(zip(info.reduction(), info.channels(), strict=True))
        self.channels = {stride: reductions[stride] for stride in strides}
        self._stride_of_level = info.reduction()
        self._channels_last = getattr(self.pyramid, "output_fmt", None) == "NHWC"
        config = self.pyramid.default_cfg if pretrained else {}
        self.mean = config.get("mean", Backbone.mean)
        self.std = config.get("std", Backbone.std)

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        features = self.pyramid(image_B3HW)
        if self._channels_last:
            features = [x_BHWC.permute(0, 3, 1, 2) for x_BHWC in features]
        found = dict(zip(self._stride_of_level, features, strict=True))
        return {stride: found[stride] for stride in self.channels}

    def stem(self) -> Iterable[nn.Parameter]:
        """All that the finest level is made of."""
        training = self.training
        self.eval()
        finest = self.pyramid(torch.zeros(1, 3, *2 * [4 * max(self._stride_of_level)]))[0]
        self.train(training)
        own = list(self.parameters())
        found = torch.autograd.grad(finest.sum(), own, allow_unused=True)
        return [p for p, gradient in zip(own, found, strict=True) if gradient is not None]


def check_size(cell: Cell, size: tuple[int, int], what: str, remedy: str = "") -> None:
    """Refuse images that a cell's network cannot take.

    Args:
        size: height and width.
        what: whose size it is, and `remedy` what else may be changed, in the message.

    Raises:
        ValueError: not a multiple of the deepest stride; of a vector, not the size it is made for.
    """
    data, divisor = cell.recipe.data, divisor_of(cell)
    named = f"{what} {size[0]}x{size[1]}"
    if plugins.load("backbones", cell.backbone).vector:
        if size != (data.height, data.width):
            raise ValueError(
                f"{named}: backbone '{cell.backbone}' gives one vector, and is made for "
                f"{data.height}x{data.width} alone"
            )
    elif size[0] % divisor or size[1] % divisor:
        raise ValueError(f"{named} is not divisible by the deepest stride {divisor}{remedy}")


def divisor_of(cell: Cell) -> int:
    """What the height and width of a cell's images are multiples of."""
    backbone = plugins.load("backbones", cell.backbone)
    return 1 if backbone.vector else int(max(cell.recipe.network.strides[-1], backbone.divisor))


@functools.cache
def _levels(name: str, output_stride: int) -> tuple[dict[int, int], dict[str, Any]]:
    """Which of a timm model's levels has each stride, the deepest of those that have it, and what
    its constructor must be told.

    A model tells when it is built; nothing that is drawn here shifts what is drawn after it.
    """
    options: dict[str, Any] = {} if output_stride == 32 else {"output_stride": output_stride}
    any_size = {"strict_img_size": False}  # transformers ask for one size of image unless told
    with torch.random.fork_rng(devices=[]):
        try:
            try:
                model = timm.create_model(name, features_only=True, **options, **any_size)
                options |= any_size
            except TypeError:  # it has no such argument
                model = timm.create_model(name, features_only=True, **options)
        except RuntimeError as error:  # no such model, or none with features
            raise ValueError(f"timm's '{name}': {str(error).splitlines()[0]}") from None
    info = model.feature_info
    return dict(zip(info.reduction(), info.out_indices, strict=True)), options


@functools.cache
def _whole(name: str, output_stride: int) -> tuple[str, ...]:
    """Names of all weights of a timm model, stages included that a pyramid does not build."""
    with torch.random.fork_rng(devices=[]):
        return tuple(timm.create_model(name, **_levels(name, output_stride)[1]).state_dict())


def _listed(numbers: Collection[int]) -> str:
    return ", ".join(str(number) for number in sorted(set(numbers)))


# --- weights from a file --------------------------------------------------------------------------


def load_weights(module: nn.Module, path: Path, whole: Collection[str] = ()) -> None:
    """Put a file's weights into a module that is a model or the first stages of one.

    What stands before every name, such as `backbone.` or `module.`, counts for nothing, nor do
    weights of what else the file's network had.

    Args:
        whole: names of the whole model's weights: others beside them are of a deeper model.

    Raises:
        ValueError: no such file, one that holds no weights, or weights of another model.
    """
    given = read_weights(path)
    own = {_flat(name): value for name, value in module.state_dict().items()}
    needed = [name for name in own if not name.endswith("num_batches_tracked")]
    before = {name[: -len(end)] for name in given for end in needed if _flat(name).endswith(end)}
    have = {  # the file's names by ours, for all that may stand before them
        prefix: {_flat(name[len(prefix) :]): name for name in given if name.startswith(prefix)}
        for prefix in sorted({"", *before})
    }
    lacking = {prefix: [x for x in needed if x not in names] for prefix, names in have.items()}
    prefix, *others = sorted(have, key=lambda prefix: len(lacking[prefix]))
    if lacking[prefix]:
        raise ValueError(
            f"{path} lacks {len(lacking[prefix])} of the {len(needed)} weights of this model, "
            f"'{lacking[prefix][0]}' for one: it holds another model's"
        )
    if others and not lacking[others[0]]:
        raise ValueError(f"{path} holds two models, '{prefix}' and '{others[0]}': leave one")
    known = {_flat(name): name.partition(".")[0] for name in whole}
    parts = {known[name] for name in needed if name in known}
    for flat, name in have[prefix].items():
        part = name[len(prefix) :].partition(".")[0]
        if flat not in known and part in parts and name.endswith(".weight"):
            raise ValueError(f"{path} has '{name}', which this model has not: another model's")
    for flat in needed:
        name = have[prefix][flat]
        shape, wanted = tuple(given[name].shape), tuple(own[flat].shape)
        if shape != wanted:
            raise ValueError(f"{path}: '{name}' has shape {shape}, not {wanted}: another model's")
    module.load_state_dict(
        {
            name: given[have[prefix][_flat(name)]] if _flat(name) in have[prefix] else value
            for name, value in module.state_dict().items()
        }
    )


def read_weights(path: Path) -> dict[str, Tensor]:
    """Tensors by name of a .safetensors file, or of a .pth file of tensors and plain values.

    Raises:
        ValueError: no such file, or one that holds no weights.
    """
    if not path.is_file():
        raise ValueError(f"no weights file '{path}'; --pretrained takes 'timm' or a file")
    try:
        state = timm.models.load_state_dict(str(path), weights_only=True)
    except Exception:  # a foreign file fails in any way
        raise ValueError(
            f"{path} cannot be read as weights: give a .safetensors file, or a .pth file that "
            f"holds tensors and plain values alone"
        ) from None
    found = {str(name): value for name, value in state.items() if torch.is_tensor(value)}
    if not found:
        raise ValueError(f"{path} holds no weights")
    return found


def _flat(name: str) -> str:
    """A weight's name, whether its module stands in a pyramid (stages_0) or not (stages.0)."""
    return name.replace(".", "_")
