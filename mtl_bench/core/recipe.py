"""A recipe: everything about training that is not the method, the backbone or the seed.

Frozen dataclasses with the paper's values as defaults; `recipes/*.toml` name what differs.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Data:
    """The images. "synthetic..." is rendered on first use; any other is found by --data."""

    dataset: str = "synthetic"  # synthetic | cityscapes | synthetic-kitti | kitti
    height: int = 64  # network input, pixels; synthetic scenes are rendered at this size
    width: int = 128
    train_scenes: int = 800  # synthetic only
    val_scenes: int = 100  # synthetic only
    test_scenes: int = 8  # synthetic only
    frames: int = 3  # synthetic only: length of a snippet; the video stage needs 4 or more
    seed: int = 0  # synthetic only: which world
    train_frames: str = "published"  # KITTI only: published (the split's) | all (with neighbours)
    heads: int = 10  # made regressions only: how many
    cosine: float = 0.0  # made regressions only: of any two of their functions
    norm_ratio: float = 10.0  # made regressions only: of the last one's scale to the first one's
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

    @property
    def nothing(self) -> bool:
        """Whether every sample is its frame, unchanged."""
        widths = (self.brightness, self.contrast, self.saturation, self.hue)
        return not (self.flip or self.crop or any(widths)) and self.scales == (1.0,)


@dataclass(frozen=True)
class Network:
    """Sizes of everything behind the backbone; the defaults are the paper's."""

    strides: tuple[int, ...] = (8, 16, 32)  # pyramid levels that the decoders read
    decoder: str = "mgnet"  # of three levels | aspp, of the deepest one | none: the finest as it is
    # ARM, refinement and GCM; ASPP's branches; the vector of a backbone that gives one
    channels: int = 128
    fused: int = 256  # FFM output
    head: int = 256  # hidden width of a head
    pose: str = "resnet18"  # pose encoder: resnet18 (the paper's) | light
    pose_channels: int = 256
    pose_scale: tuple[float, float] = (0.01, 0.01)  # of translation, rotation
    min_depth: float = 0.5  # depth = 1 / (sigmoid / min_depth), arbitrary unit
    batch_norm_momentum: float = 0.01


@dataclass(frozen=True)
class Loss:
    """Switches of the loss terms; their fixed weights are in `mtl_bench/core/terms.py`."""

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
    poly_power: float = 0.9  # 0: no decay
    milestones: tuple[int, ...] = ()  # steps from which on learning rates are ...
    milestone_factor: float = 0.5  # ... this much of what they were
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
    depth_crop: str = "none"  # none: the protocol's | garg | manydepth
    protocol: str = "full-frame"  # of the depth metrics; see `tasks/depth/protocols.py`
    also: tuple[str, ...] = ()  # further protocols; their metrics' keys begin with their names
    flip: bool = False  # inverse depth averaged with that of the mirrored image


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
    tasks: tuple[str, ...] = ("panoptic", "depth")  # of a cell that names none
    backbone: str = ""  # of a cell that names none, and of a grid that is run with --recipe
    data: Data = field(default_factory=Data)
    augment: Augment = field(default_factory=Augment)
    network: Network = field(default_factory=Network)
    loss: Loss = field(default_factory=Loss)
    optim: Optim = field(default_factory=Optim)
    pseudo: PseudoLabels = field(default_factory=PseudoLabels)
    evaluate: Evaluate = field(default_factory=Evaluate)
    latency: Latency = field(default_factory=Latency)
