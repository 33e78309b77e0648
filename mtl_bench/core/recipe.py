"""A recipe: everything about training that is not the method, the backbone or the seed.

Frozen dataclasses with the paper's values as defaults; `recipes/*.toml` name what differs. The
type of a field says what it may hold and what it means: see `core/plain.py`.
"""

from dataclasses import dataclass, field
from typing import Annotated

from mtl_bench.core.plain import (
    ASCENDING,
    DISTINCT,
    FINITE,
    ODD,
    SOME,
    Checked,
    above,
    least,
    most,
    one_of,
)

Count = Annotated[int, least(1)]
Whole = Annotated[int, least(0)]
Positive = Annotated[float, above(0), FINITE]
NotNegative = Annotated[float, least(0), FINITE]
Share = Annotated[float, least(0), most(1)]

NOTHING = "none"  # as the split of an evaluation


@dataclass(frozen=True)
class Data(Checked):
    """The images. "synthetic..." is rendered on first use; any other is found by --data."""

    dataset: Annotated[str, "which data set, see `list datasets`"] = "synthetic"
    height: Annotated[
        Count, "pixels of the network's input; synthetic scenes are rendered at this size"
    ] = 64
    width: Annotated[Count, "as height"] = 128
    train_scenes: Annotated[Count, "synthetic only: scenes of the split train"] = 800
    val_scenes: Annotated[Whole, "synthetic only: scenes of the split val"] = 100
    test_scenes: Annotated[Whole, "synthetic only: scenes of the split test"] = 8
    frames: Annotated[
        Count, "synthetic only: length of a snippet; the video stage needs 4 or more"
    ] = 3
    seed: Annotated[Whole, "synthetic only: which world"] = 0
    train_frames: Annotated[
        str,
        one_of("published", "all"),
        "KITTI only: the split's frames, or all that have both neighbours",
    ] = "published"
    stride: Annotated[Count, "frames from a training frame to its neighbours, on both sides"] = 1
    min_flow: Annotated[
        NotNegative, "pixels; training frames that move less against neighbours are left out"
    ] = 0.0
    heads: Annotated[Count, "made regressions only: how many"] = 10
    cosine: Annotated[
        float, least(-1), most(1), "made regressions only: of any two of their functions"
    ] = 0.0
    norm_ratio: Annotated[
        Positive, "made regressions only: of the last one's scale to the first one's"
    ] = 10.0
    cache: Annotated[bool, "keep decoded frames in memory"] = True
    workers: Annotated[Whole, "processes that load data; 0: the training process does"] = 0


@dataclass(frozen=True)
class Augment(Checked):
    """Random changes of a training sample, the same for its three frames."""

    flip: Annotated[bool, "mirror half of the samples"] = True
    scales: Annotated[tuple[Positive, ...], SOME, "resize factors, one drawn a sample"] = (1.0,)
    crop: Annotated[
        tuple[Count, Count] | None, "height, width after the resize; smaller images are padded"
    ] = None
    brightness: Annotated[Share, "factors are drawn from 1 +- this"] = 0.2
    contrast: Annotated[Share, "as brightness"] = 0.2
    saturation: Annotated[Share, "as brightness"] = 0.2
    hue: Annotated[float, least(0), most(0.5), "turns of the colour circle, from +- this"] = 0.05

    @property
    def nothing(self) -> bool:
        """Whether every sample is its frame, unchanged."""
        widths = (self.brightness, self.contrast, self.saturation, self.hue)
        return not (self.flip or self.crop or any(widths)) and self.scales == (1.0,)


@dataclass(frozen=True)
class Network(Checked):
    """Sizes of everything behind the backbone; the defaults are the paper's."""

    strides: Annotated[
        tuple[Count, ...], SOME, ASCENDING, "pyramid levels that the decoders read"
    ] = (8, 16, 32)
    decoder: Annotated[
        str,
        one_of("mgnet", "aspp", "none"),
        "mgnet, of three levels; aspp, of the deepest one; none: the finest as it is",
    ] = "mgnet"
    channels: Annotated[
        Count, "of ARM, refinement and GCM; of ASPP's branches; of a backbone's one vector"
    ] = 128
    fused: Annotated[Count, "channels behind the FFM"] = 256
    head: Annotated[Count, "hidden channels of a head"] = 256
    pose: Annotated[str, "pose encoder: resnet18 (the paper's) or light"] = "resnet18"
    pose_channels: Annotated[Count, "of the pose decoder"] = 256
    pose_scale: Annotated[tuple[Positive, Positive], "of translation, rotation"] = (0.01, 0.01)
    min_depth: Annotated[
        Positive, "depth = 1 / (sigmoid / min_depth), in the network's arbitrary unit"
    ] = 0.5
    depth_slope: Annotated[
        NotNegative,
        "the start's, from the image's top to its bottom, in logits of inverse depth; 0: a wall",
    ] = 0.0
    batch_norm_momentum: Annotated[float, above(0), most(1), "of all behind the backbone"] = 0.01


@dataclass(frozen=True)
class Loss(Checked):
    """Switches of the loss terms; their fixed weights are the tasks'."""

    top_fraction: Annotated[
        float, above(0), most(1), "bootstrapped cross-entropy: share of valid pixels kept"
    ] = 0.2
    small_area: Annotated[Whole, "pixels; smaller instances count `small_weight` times"] = 4096
    small_weight: Annotated[NotNegative, "of the pixels of small instances"] = 3.0
    center_sigma: Annotated[Positive, "pixels, of a center's Gaussian"] = 8.0
    scales: Annotated[
        tuple[Whole, ...], SOME, DISTINCT, "depth outputs in the photometric loss, 0 = finest"
    ] = (0, 1, 2)
    automask: Annotated[bool, "unwarped frames among the minimum's candidates"] = True
    ssim_weight: Annotated[Share, "of SSIM in the photometric loss; the rest is L1's"] = 0.85
    hints: Annotated[
        NotNegative, "in the photometric loss, of better depths that are tried; 0: none are"
    ] = 0.0


@dataclass(frozen=True)
class Optim(Checked):
    """Optimiser, schedule and length."""

    steps: Annotated[Count, "of the optimiser"] = 60000
    batch: Annotated[int, least(2), "samples a step; batch statistics of 1x1 maps need two"] = 12
    micro_batch: Annotated[
        Annotated[int, least(2)] | None,
        "samples in memory at once, added up to a batch, which it divides; none: all",
    ] = None
    one_batch: Annotated[
        bool,
        "several ranks share the samples of a whole batch, whose losses and batch norms stay those "
        "of one batch; without it they share the parts that micro_batch makes",
    ] = False
    lr: Annotated[NotNegative, "learning rate of backbone, GCM and pose network"] = 1e-4
    head_lr_factor: Annotated[NotNegative, "times lr: of decoders and heads"] = 10.0
    method_lr: Annotated[NotNegative, "of a method's own parameters"] = 1e-4
    weight_decay: Annotated[NotNegative, "of all but a method's own parameters"] = 0.0
    warmup_steps: Annotated[Whole, "over which the rate rises"] = 1000
    warmup_factor: Annotated[Share, "of the rate at the first step"] = 0.1
    poly_power: Annotated[NotNegative, "of the decay (1 - step / steps)^power; 0: none"] = 0.9
    milestones: Annotated[
        tuple[Count, ...],
        ASCENDING,
        "steps from which on rates are times milestone_factor",
    ] = ()
    milestone_factor: Annotated[Share, "see milestones"] = 0.5
    clip: Annotated[Positive | None, "total gradient norm"] = 0.01
    precision: Annotated[str, one_of("fp32", "bf16", "fp16"), "of training"] = "fp32"
    statistics_batches: Annotated[
        Whole, "after the last step, whose means batch norms keep; 0: running ones"
    ] = 0
    checkpoint_every: Annotated[Count, "steps; no part of a cell's id"] = 1000
    cosine_every: Annotated[
        Whole, "steps between logged cosines of the task gradients; 0: never; no part of the id"
    ] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.micro_batch is not None and self.batch % self.micro_batch:
            raise ValueError(
                f"recipe.optim.micro_batch = {self.micro_batch} does not divide a batch of "
                f"{self.batch}; set it to a divisor of recipe.optim.batch"
            )
        if self.one_batch and self.micro_batch is not None:
            raise ValueError(
                f"recipe.optim.one_batch = true keeps a batch in one part, and micro_batch = "
                f"{self.micro_batch} does not: set recipe.optim.micro_batch=none"
            )


@dataclass(frozen=True)
class PseudoLabels(Checked):
    """The video stage's labels for frames without human ones; predictions are averaged over all."""

    scales: Annotated[tuple[Positive, ...], SOME, "of the input image"] = (
        *(0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0),
    )
    flip: Annotated[bool, "each scale mirrored, too"] = True
    min_confidence: Annotated[
        Share, "a pixel whose class is less probable than this is left unlabeled"
    ] = 0.0


@dataclass(frozen=True)
class Evaluate(Checked):
    """Post-processing and protocol of the metrics."""

    split: Annotated[str, "which frames: train, val or test; none: nothing is measured"] = "val"
    center_threshold: Annotated[Share, "least height of an instance's center"] = 0.3
    nms_kernel: Annotated[Count, ODD, "pixels"] = 7
    top_k: Annotated[int, least(1), most(999), "centers kept; an id has three digits for them"] = (
        200
    )
    stuff_area: Annotated[Whole, "pixels; smaller stuff segments become void"] = 2048
    min_depth_m: Annotated[Positive, "true depths above it count"] = 0.001
    max_depth_m: Annotated[Positive, "true depths below it count"] = 80.0
    depth_crop: Annotated[str, "none (the protocol's), garg or manydepth"] = "none"
    protocol: Annotated[str, "of the depth metrics; see `tasks/depth/protocols.py`"] = "full-frame"
    also: Annotated[
        tuple[str, ...], "further protocols; their metrics' keys begin with their names"
    ] = ()
    flip: Annotated[bool, "inverse depth averaged with that of the mirrored image"] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(
                f"recipe.evaluate.min_depth_m = {self.min_depth_m} must be below max_depth_m = "
                f"{self.max_depth_m}"
            )

    @property
    def images(self) -> str:
        """The split whose images are timed: the training's where nothing is measured."""
        return "train" if self.split == NOTHING else self.split


@dataclass(frozen=True)
class Latency(Checked):
    """How long to time; the paper uses 500 passes."""

    passes: Annotated[Whole, "timed ones; 0: none, and no latency"] = 500
    warmup: Annotated[Whole, "passes before them"] = 10
    height: Annotated[Count | None, "pixels; none: the recipe's input"] = None
    width: Annotated[Count | None, "as height"] = None


@dataclass(frozen=True)
class Recipe(Checked):
    """Everything about training that is not the method, backbone or seed."""

    name: str = "paper"
    about: str = ""
    smoke: Annotated[bool, "marks rows that must never be read as results"] = False
    # Of a cell that names none
    tasks: Annotated[tuple[str, ...], SOME, DISTINCT] = ("panoptic", "depth")
    backbone: str = ""  # and of a grid that is run with --recipe
    data: Data = field(default_factory=Data)
    augment: Augment = field(default_factory=Augment)
    network: Network = field(default_factory=Network)
    loss: Loss = field(default_factory=Loss)
    optim: Optim = field(default_factory=Optim)
    pseudo: PseudoLabels = field(default_factory=PseudoLabels)
    evaluate: Evaluate = field(default_factory=Evaluate)
    latency: Latency = field(default_factory=Latency)
