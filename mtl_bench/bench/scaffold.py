"""`mtl-bench new`: a file to start from, which runs and passes `mtl-bench check` as it is."""

from pathlib import Path

from mtl_bench.core.plugins import NAME, NAMED, files

METHOD = '''"""{title}: one line that `mtl-bench list` shows.

Source: authors, title, venue and year (as in ICLR 2021), arXiv number, equation or algorithm. Then
what departs from it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import LossMethod, Step
from mtl_bench.core.terms import Term


# A method that needs the gradient of every loss derives from GradientMethod (of the same module)
# and writes weights(G_KK, step) in place of total. With needs = "representation" the gradients are
# those of what the decoders read; with needs = "jacobian" it writes direction(J_KP, step).
class {title}(LossMethod):
    """sum_i exp(-s_i) w_i L_i + s_i / 2, with w the fixed weights and s learned

    Args:
        init: every s_i at the start. Arguments like this one are set with --set method.init=0.5.
    """

    # What the trials of a tuned grid draw: these, or "log" or "uniform": [LOW, HIGH] in braces.
    space = {{"init": [0.0, -0.5]}}

    def __init__(self, terms: Sequence[Term], seed: int = 0, init: float = 0.0):
        super().__init__(terms, seed)  # gives self.fixed_T, and self.generator to draw from
        # State that training changes is a parameter (learned) or a buffer: both are checkpointed.
        self.s_T = nn.Parameter(torch.full((len(terms),), init))

    def total(self, step: Step) -> Tensor:
        """Unweighted losses, in the order of self.terms -> the scalar to minimise."""
        here = step.present  # which K of the T losses: a batch may lack a task's labels
        s_K, fixed_K = self.s_T[here], self.fixed_T[here]
        return (torch.exp(-s_K) * fixed_K * step.loss_K + 0.5 * s_K).sum()
'''

BACKBONE = '''"""{title}: one line that `mtl-bench list` shows; parameters, licence of the weights.

Source: authors, title, venue, year, arXiv number. Then what departs from it.
"""

from torch import Tensor, nn

from mtl_bench.core.backbone import Backbone


# A timm model needs only this: derive from mtl_bench.core.backbone.TimmBackbone and set
# timm_name = "...", the name of any timm model that has features_only.
class {title}(Backbone):
    """A plain pyramid: one convolution halves the size at every level.

    Args:
        strides: the levels that will be read; deeper ones need not be built.
        pretrained: initial weights, None for random ones.
        width: channels. Arguments like this one are set with --set backbone.width=32.
    """

    # mean, std = ..., ...  # per channel of RGB in [0, 1], if not ImageNet's

    def __init__(
        self, strides: tuple[int, ...] = (8, 16, 32), pretrained: str | None = None, width: int = 16
    ):
        super().__init__()
        if pretrained is not None:
            raise ValueError(f"{title} has no pre-trained weights (asked for '{{pretrained}}')")
        depth = max(strides).bit_length() - 1  # stride 2 is level 1, 4 is 2, 8 is 3, ...
        self.levels = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width if level else 3, width, 3, stride=2, padding=1),
                nn.GroupNorm(4, width),
                nn.ReLU(),
            )
            for level in range(depth)
        )
        self.channels = {{stride: width for stride in strides}}

    def forward(self, image_B3HW: Tensor) -> dict[int, Tensor]:
        """Normalised image -> {{stride: features [B, channels[stride], H/stride, W/stride]}}."""
        found, x = {{}}, image_B3HW
        for level, convolution in enumerate(self.levels, start=1):
            x = convolution(x)
            found[2**level] = x
        return {{stride: found[stride] for stride in self.channels}}
'''

ENGINE = '''"""{title}: one line that `mtl-bench list` shows.

Source: the package that it runs. Then what has to be known about it.
"""

from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.graph import GraphEngine, strided


# For an engine that reads ONNX files, mtl_bench.deploy.export.strided_file writes one.
class {title}(GraphEngine):
    """The graph, run by torch."""

    precisions = {{"cpu": ("fp32",), "cuda": ("fp32",)}}  # by kind of device; also bf16, fp16, int8
    # packages = ("mine",)  # that `build` imports, where it is more than torch
    # extra = ("mine>=1.0",)  # what to pip install where they are missing

    def build(self, net: nn.Module, setting: Setting) -> None:
        """Prepare everything for images of this size, in this precision, on this device."""
        self.graph = strided(net, (setting.batch, *setting.size), setting.dtype)

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        """Image uint8 [B,H,W,3] -> the graph's maps at its finest stride, float32, by name."""
        return dict(zip(self.graph.names, self.graph(image), strict=True))
'''

TEMPLATES = {"methods": METHOD, "backbones": BACKBONE, "engines": ENGINE}


def write(kind: str, name: str, folder: Path | None = None) -> Path:
    """Write the scaffold of a plug-in, into `./methods` (`./backbones`, `./engines`) unless told.

    Raises:
        ValueError: an impossible or taken name.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"'{name}' {NAMED}")
    taken = files(kind).get(name)
    if taken is not None:
        raise ValueError(f"there is a {kind[:-1]} called '{name}': {taken}")
    path = (Path(kind) if folder is None else folder) / f"{name}.py"
    path.parent.mkdir(parents=True, exist_ok=True)
    title = "".join(word.capitalize() for word in name.split("_"))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(TEMPLATES[kind].format(title=title))
    except FileExistsError:
        raise ValueError(f"'{path}' exists; it is left as it is") from None
    return path
