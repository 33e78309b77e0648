"""Device, precision and seeds: the only module that knows about them."""

import contextlib
import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from mtl_bench.core.ranks import ALONE, Ranks

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def seed_for(seed: int, purpose: str) -> int:
    """A seed of its own for every purpose, so that one draw more in one never shifts another."""
    digest = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


@dataclass
class Compute:
    """Where and in which precision a cell runs.

    Raises:
        ValueError: CUDA asked for where there is none, or fp16 on the CPU.
    """

    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {
        "train": ("skips_overflow", "gradient_norm", "apply", "pinned")
    }

    device: torch.device
    precision: str = "fp32"
    scaler: torch.amp.GradScaler = field(init=False)

    def __post_init__(self) -> None:
        if self.precision not in DTYPES:
            raise ValueError(f"no precision '{self.precision}' (known: {', '.join(DTYPES)})")
        if self.precision == "fp16" and self.device.type == "cpu":
            raise ValueError("precision fp16 trains on CUDA only: use bf16 or fp32 on the CPU")
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=self.precision == "fp16")
        self.scaler.scale(torch.zeros(1, device=self.device))  # it begins with the first such call

    @property
    def pinned(self) -> bool:
        """Whether batches should wait in page-locked memory: CUDA then copies beside the CPU."""
        return self.device.type == "cuda"

    def place(self, model: nn.Module) -> nn.Module:
        """On the device, channels last: convolutions are faster so (on one core of a CPU a step of
        the recipe `small` is, 1.07 to 1.38 times)."""
        found: nn.Module = model.to(  # type: ignore[call-overload]
            self.device, memory_format=torch.channels_last
        )
        return found

    def autocast(self) -> AbstractContextManager[object]:
        if self.precision == "fp32":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, DTYPES[self.precision])

    @property
    def skips_overflow(self) -> bool:
        """Whether gradients that are not finite are the loss scale's fault, which then halves."""
        return self.scaler.is_enabled() and self.scaler.get_scale() > 1

    def gradient_norm(
        self, optimizer: torch.optim.Optimizer, parameters: list[Tensor], clip: float | None
    ) -> float:
        """Unscale, and clip to a total norm of `clip`. Returns the norm before clipping."""
        self.scaler.unscale_(optimizer)
        norm = torch.nn.utils.clip_grad_norm_(parameters, clip if clip is not None else torch.inf)
        return norm.item()

    def apply(self, optimizer: torch.optim.Optimizer) -> None:
        """Step, unless fp16 has overflowed."""
        self.scaler.step(optimizer)
        self.scaler.update()


def choose_device(name: str = "auto", ranks: Ranks = ALONE) -> torch.device:
    """`auto`: CUDA where there is one. Otherwise a device by name; of a rank its own GPU.

    Raises:
        ValueError: CUDA where there is none, fewer GPUs than ranks, or an unknown device.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.split(":")[0] not in ("cpu", "cuda"):
        raise ValueError(f"no device '{name}' (known: auto, cpu, cuda)")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError("--device cuda, but torch sees no CUDA device here: use --device cpu")
    if name == "cuda" and ranks.size > 1:
        count = torch.cuda.device_count()
        if 1 < count <= ranks.local:
            raise ValueError(f"rank {ranks.rank} finds {count} GPUs here, one for each rank")
        name = f"cuda:{ranks.local if count > 1 else 0}"  # a queue may show each its own alone
    return torch.device(name)


@contextlib.contextmanager
def drawing(seed: int | None, device: torch.device) -> Iterator[None]:
    """What is drawn inside comes from the seed, and the generators are as before after it; None:
    it comes from them."""
    if seed is None:
        yield
        return
    cuda = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if cuda else []):
        torch.default_generator.manual_seed(seed)
        if cuda:
            torch.cuda.manual_seed(seed)
        yield


@contextlib.contextmanager
def initial_weights(seed: int) -> Iterator[None]:
    """Everything drawn inside comes from the seed; the global generator is as before after it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(seed, "initial weights"))
        yield
