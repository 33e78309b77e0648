"""What a training run is: frozen dataclasses, one canonical JSON, one id.

A `Recipe` is everything about training that is not the method, the backbone or the seed; a `Cell`
is a recipe with those three, the tasks and the video stage. Two cells with the same values have
the same id, whatever file or option the values came from.
"""

import hashlib
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mtl_bench.plain import did_you_mean, from_dict, to_dict

PROTOCOL = 2  # raised when numbers made before stop being comparable with numbers made after
RECIPES = Path(__file__).parent / "recipes"
TASKS = ("panoptic", "depth")
GRANULARITIES = ("terms", "tasks")


@dataclass(frozen=True)
class Data:
    """The images. "synthetic" is rendered on first use; any other data set is found by --data."""

    dataset: str = "synthetic"  # synthetic | cityscapes
    height: int = 64  # network input, pixels; synthetic scenes are rendered at this size
    width: int = 128
    train_scenes: int = 800  # synthetic only
    val_scenes: int = 100  # synthetic only
    frames: int = 3  # synthetic only: length of a snippet; the video stage needs 4 or more
    seed: int = 0  # synthetic only: which world
    cache: bool = True  # keep decoded frames in memory
    workers: int = 0  # data-loading processes; 0 = in the training process


@dataclass(frozen=True)
class Augment:
    """Random changes of a training sample, the same for its three frames."""

    flip: bool = True
    scales: tuple[float, ...] = (1.0,)  # resize factors, one drawn per sample
    crop: tuple[int, int] | None = None  # height, width after the resize; smaller images are padded
    brightness: float = 0.2
    contrast: float = 0.2
    saturation: float = 0.2
    hue: float = 0.05


@dataclass(frozen=True)
class Network:
    """Sizes of everything behind the backbone; the defaults are the paper's."""

    strides: tuple[int, int, int] = (8, 16, 32)  # pyramid levels that the decoders read
    channels: int = 128  # ARM, refinement and GCM
    fused: int = 256  # FFM output
    head: int = 256  # hidden width of a head
    pose: str = "resnet18"  # pose encoder: resnet18 (the paper's) | light
    pose_channels: int = 256
    pose_scale: tuple[float, float] = (0.01, 0.01)  # of translation, rotation
    min_depth: float = 0.5  # depth = 1 / (sigmoid / min_depth), arbitrary unit
    batch_norm_momentum: float = 0.01


@dataclass(frozen=True)
class Loss:
    """Switches of the loss terms; their fixed weights are in `mtl_bench/losses/terms.py`."""

    top_fraction: float = 0.2  # bootstrapped cross-entropy: share of valid pixels kept
    small_area: int = 4096  # pixels; smaller instances count `small_weight` times
    small_weight: float = 3.0
    center_sigma: float = 8.0  # pixels
    scales: tuple[int, ...] = (0, 1, 2)  # depth outputs in the photometric loss, 0 = finest
    automask: bool = True  # unwarped frames among the minimum's candidates
    ssim_weight: float = 0.85


@dataclass(frozen=True)
class Optim:
    """Optimiser, schedule and length."""

    steps: int = 60000
    batch: int = 12  # samples a step
    micro_batch: int | None = None  # samples in memory at once, added up to a batch; None: all
    lr: float = 1e-4  # backbone, GCM, pose network
    head_lr_factor: float = 10.0  # decoders and heads
    method_lr: float = 1e-4  # a method's own parameters
    weight_decay: float = 0.0
    warmup_steps: int = 1000
    warmup_factor: float = 0.1
    poly_power: float = 0.9
    clip: float | None = 0.01  # total gradient norm
    precision: str = "fp32"  # fp32 | bf16 | fp16
    checkpoint_every: int = 1000  # steps
    cosine_every: int = 0  # steps between logged cosines of the task gradients; 0 = never


@dataclass(frozen=True)
class PseudoLabels:
    """The video stage's labels for frames without human ones; predictions are averaged over all."""

    scales: tuple[float, ...] = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)  # of the input image
    flip: bool = True  # each scale mirrored, too
    min_confidence: float = 0.0  # a pixel whose class is less probable than this is left unlabeled


@dataclass(frozen=True)
class Evaluate:
    """Post-processing and protocol of the metrics."""

    split: str = "val"
    center_threshold: float = 0.3
    nms_kernel: int = 7  # pixels
    top_k: int = 200  # centers kept; the paper gives none
    stuff_area: int = 2048  # pixels; smaller stuff segments become void
    min_depth_m: float = 0.001
    max_depth_m: float = 80.0
    depth_crop: str = "none"  # none | garg


@dataclass(frozen=True)
class Latency:
    """How long to time; the paper uses 500 passes."""

    passes: int = 500
    warmup: int = 10
    height: int | None = None  # None: the recipe's input size
    width: int | None = None


@dataclass(frozen=True)
class Recipe:
    """Everything about training that is not the method, backbone or seed."""

    name: str = "paper"
    about: str = ""
    smoke: bool = False  # marks rows that must never be read as results
    data: Data = field(default_factory=Data)
    augment: Augment = field(default_factory=Augment)
    network: Network = field(default_factory=Network)
    loss: Loss = field(default_factory=Loss)
    optim: Optim = field(default_factory=Optim)
    pseudo: PseudoLabels = field(default_factory=PseudoLabels)
    evaluate: Evaluate = field(default_factory=Evaluate)
    latency: Latency = field(default_factory=Latency)


@dataclass(frozen=True)
class Cell:
    """One training run and its evaluation.

    Two kinds of cell need others (their `parents`) first: `video` trains its parent's checkpoint
    on, with pseudo labels from it; `single_task` trains nothing, and evaluates and times the
    networks of its parents together.

    Raises:
        ValueError: an unknown granularity, or options that exclude each other.
    """

    recipe: Recipe
    backbone: str
    method: str  # a name, or a loss-value method and a gradient method: a+b
    tasks: tuple[str, ...] = TASKS
    seed: int = 0
    video: bool = False  # the second training, on pseudo-labeled frames too
    single_task: bool = False  # one network a task, each trained alone
    granularity: str = "terms"  # what a method weighs: the loss terms, or tasks of fixed weights
    pretrained: str | None = None  # initial weights: None = random | "timm" | a file
    method_args: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    backbone_args: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        if self.granularity not in GRANULARITIES:
            known = did_you_mean(self.granularity, GRANULARITIES)
            raise ValueError(f"no granularity '{self.granularity}'{known}")
        if self.single_task and self.video:
            raise ValueError(
                "single_task and video exclude each other: the stage needs one network"
            )
        if self.single_task and len(self.tasks) < 2:
            raise ValueError(f"single_task needs two tasks or more, not {list(self.tasks)}")
        if self.video and "panoptic" not in self.tasks:
            raise ValueError("video needs the task panoptic: its labels are what the stage makes")

    @property
    def parents(self) -> tuple["Cell", ...]:
        """Cells whose checkpoints this one needs."""
        if self.single_task:
            return tuple(replace(self, single_task=False, tasks=(task,)) for task in self.tasks)
        return (replace(self, video=False),) if self.video else ()

    @property
    def id(self) -> str:
        """12 hexadecimal digits of the canonical JSON: recipe values, not the recipe's name."""
        return hashlib.sha256(canonical_json(self).encode()).hexdigest()[:12]

    @property
    def slug(self) -> str:
        """Name of the run's folder."""
        return f"{self.method}-{self.backbone}-s{self.seed}-{self.id}"


# --- identity -----------------------------------------------------------------------------------


def canonical_json(cell: Cell) -> str:
    """What makes a cell itself: without names, prose and how often a checkpoint is written."""
    values = to_dict(cell)
    for key in ("name", "about"):
        del values["recipe"][key]
    for key in ("checkpoint_every", "cosine_every"):
        del values["recipe"]["optim"][key]
    if not cell.video:
        del values["recipe"]["pseudo"]
    for key in ("cache", "workers"):
        del values["recipe"]["data"][key]
    if cell.pretrained not in (None, "timm"):
        values["pretrained"] = _content_hash(Path(str(cell.pretrained)))
    return json.dumps({"protocol": PROTOCOL, **values}, sort_keys=True, separators=(",", ":"))


@lru_cache
def _content_hash(weights: Path) -> str:
    """A weights file counts by what is in it, not by where it is."""
    if not weights.is_file():
        raise ValueError(f"no weights file '{weights}'; --pretrained takes 'timm' or a file")
    with weights.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- recipes and overrides ------------------------------------------------------------------------


def recipe_names() -> list[str]:
    return sorted(path.stem for path in RECIPES.glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """A shipped recipe by name, or a user's by the path of its TOML file.

    Raises:
        ValueError: no such recipe, or a key or value that a recipe cannot have.
    """
    path = Path(name) if name.endswith(".toml") else RECIPES / f"{name}.toml"
    if not path.is_file():
        raise ValueError(f"no recipe called '{name}'{did_you_mean(name, recipe_names())}")
    try:
        values = tomllib.loads(path.read_text())
        return from_dict(Recipe, {"name": path.stem, **values})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def override(cell: Cell, settings: Iterable[str]) -> Cell:
    """Apply `key=value` strings: `recipe.optim.lr=3e-4`, `method.alpha=1.5`, `seed=3`.

    Raises:
        ValueError: no `=`, an unknown key (with the nearest known one), or a value of another type.
    """
    values = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"'{setting}' is not key=value, such as recipe.optim.lr=3e-4")
        values[key.strip()] = _parse(text.strip())
    return set_values(cell, values)


def set_values(cell: Cell, settings: Mapping[str, Any]) -> Cell:
    """As `override`, with values as they are; below `method.` and `backbone.` sections are made."""
    values = to_dict(cell)
    for key, value in settings.items():
        *sections, last = key.split(".")
        plug_in = sections[:1] in (["method"], ["backbone"])  # checked when it is constructed
        if plug_in:
            sections[0] += "_args"
        target = values
        for section in sections:
            inner = target.setdefault(section, {}) if plug_in else target.get(section)
            if not isinstance(inner, dict):
                raise ValueError(f"unknown key '{key}'{did_you_mean(section, target)}")
            target = inner
        if last not in target and not plug_in:
            raise ValueError(f"unknown key '{key}'{did_you_mean(last, target)}")
        target[last] = to_dict(value)
    return from_dict(Cell, values)


def _parse(text: str) -> Any:
    """A TOML value, or the text itself where it is not one: `lr=1e-3`, `dataset=cityscapes`."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
