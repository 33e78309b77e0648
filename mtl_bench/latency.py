"""The timing protocol: how long one image takes from host memory to panoptic map and metric depth.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 4.2: the mean of 500 passes with
upload and post-processing included. Added here: distinct images, warm-up, percentiles, stages.
One pass, batch 1: the 8-bit image goes from (on CUDA: pinned) host memory to the device and becomes
float (transfer); the network runs without auxiliary depth heads and without the pose network
(network); grouping, and depth with its scale from the camera height (postprocess). The results stay
on the device; decoding and resizing are not timed. Eager torch.
"""

import gc
import itertools
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from mtl_bench.core import config, geometry
from mtl_bench.core.device import Engine
from mtl_bench.core.provenance import cpu_model
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.evaluate.walk import evaluating
from mtl_bench.tasks.finish import Finish

STAGES = ("transfer", "network", "postprocess")
MIB = 2**20
Stage = Callable[[Any], Any]


def measure(
    model: nn.Module,
    images: Iterable[Batch | Tensor],
    K_33: Tensor,
    camera_height_m: float,
    things: tuple[int, ...],
    evaluate: config.Evaluate,
    latency: config.Latency,
    device: torch.device | str,
    precision: str = "fp32",
    road: int = CITYSCAPES20.index("road"),
) -> dict[str, float | int | str]:
    """Time `latency.passes` single images through `model.net` and what follows it.

    Args:
        model: on `device`; its `net` is timed in evaluation mode and left in the mode it was in.
        images: batches, or images [3,H,W] or [B,3,H,W], uint8 or float in [0, 1]. Each pass takes
            the next one; fewer images than passes are used in turn.
        K_33: intrinsics in pixels of the images; with them and `camera_height_m` depth gets metres.
        things: class indices whose pixels are grouped into instances.
        latency: passes, warm-up, and the input size where it is not the images' own (bilinear
            resize before the clock starts, intrinsics scaled with it).
        road: class index that the depth's scale is taken from.

    Returns:
        Values under `latency.`: mean_ms, std_ms, p50_ms, p95_ms, p99_ms, fps (1000 / mean), the
        means of the three stages (they add up to mean_ms), drift (last quarter of the passes
        against the first, 0.1 = 10 % slower), params_m (parameters that a pass uses, millions),
        gmacs (multiply-adds of the network's convolutions and matrix products, 1e9), peak_mib and
        peak_kind (see `_peak`), and what was measured: passes, warmup, images (distinct), height,
        width, device, precision, threads, clock.

    Raises:
        ValueError: no images or no passes.
    """
    engine = Engine(torch.device(device), precision)
    hosts, K_133 = prepare(images, K_33, latency, pin=engine.device.type == "cuda")
    if latency.passes < 1:
        raise ValueError(f"latency.passes must be at least 1, not {latency.passes}")
    stages = _stages(model, engine, K_133, camera_height_m, things, evaluate, road)
    with evaluating(model):
        cost = _cost(stages, hosts[0], engine.device)
        with torch.inference_mode():
            rounds = itertools.cycle(hosts)
            for _ in range(latency.warmup):
                time_pass(stages, next(rounds), engine.device)
            gc.collect()
            passes = itertools.islice(rounds, latency.passes)
            ms = np.array([time_pass(stages, host, engine.device) for host in passes])
    values = {
        **statistics(ms),
        **cost,
        "passes": latency.passes,
        "warmup": latency.warmup,
        "images": min(len(hosts), latency.passes),
        "height": hosts[0].shape[-2],
        "width": hosts[0].shape[-1],
        "threads": torch.get_num_threads(),
        "device": device_name(engine.device),
        "precision": precision,
        "clock": "CUDA events" if engine.device.type == "cuda" else "time.perf_counter",
    }
    return {f"latency.{key}": value for key, value in values.items()}


def prepare(
    images: Iterable[Batch | Tensor], K_33: Tensor, latency: config.Latency, pin: bool
) -> tuple[list[Tensor], Tensor]:
    """Host images, each uint8 [1,3,H,W] as a camera delivers them, and their intrinsics [1,3,3]."""
    hosts = []
    for image_1CHW in itertools.islice(_single_images(images), max(latency.passes, 1)):
        image_1CHW = image_1CHW.detach().cpu()
        size = (latency.height or image_1CHW.shape[2], latency.width or image_1CHW.shape[3])
        if image_1CHW.dtype == torch.uint8:
            image_1CHW = image_1CHW / 255
        scale = (size[1] / image_1CHW.shape[3], size[0] / image_1CHW.shape[2])
        if scale != (1, 1):
            image_1CHW = F.interpolate(image_1CHW, size, mode="bilinear", antialias=True)
        host = (image_1CHW.clamp(0, 1) * 255).round().to(torch.uint8).contiguous()
        hosts.append(host.pin_memory() if pin else host)
    if not hosts:
        raise ValueError("no images to time: the evaluation split is empty")
    return hosts, geometry.scale_intrinsics(K_33[None].float().cpu(), *scale)


def _single_images(images: Iterable[Batch | Tensor]) -> Iterator[Tensor]:
    for item in images:
        image = item.image_B3HW if isinstance(item, Batch) else item
        yield from (image if image.dim() == 4 else image[None]).split(1)


def _stages(
    model: nn.Module,
    engine: Engine,
    K_133: Tensor,
    camera_height_m: float,
    things: tuple[int, ...],
    evaluate: config.Evaluate,
    road: int,
) -> list[Stage]:
    """The three timed functions, each fed with the one before's result."""
    K_133 = K_133.to(engine.device)
    height_m_1 = torch.tensor([camera_height_m], device=engine.device)
    finish = Finish(things, road, evaluate)
    layout = torch.channels_last if engine.channels_last else torch.contiguous_format

    def transfer(host: Tensor) -> Tensor:
        image = host.to(engine.device, non_blocking=True)
        return image.to(torch.float32, memory_format=layout) / 255

    def network(image_13HW: Tensor) -> Any:
        with engine.autocast():
            return model.net(image_13HW)  # type: ignore[operator]

    def last(out: Any) -> dict[str, Tensor]:
        inverse = out.inverse_depth[0] if out.inverse_depth else None
        found: dict[str, Tensor] = finish(
            out.semantic_BCHW, out.center_B1HW, out.offset_B2HW, inverse, K_133, height_m_1
        )
        return found

    return [transfer, network, last]


def time_pass(stages: list[Stage], host: Tensor, device: torch.device) -> list[float]:
    """Milliseconds of each stage."""
    value: Any = host
    if device.type != "cuda":
        marks = [time.perf_counter()]
        for stage in stages:
            value = stage(value)
            marks.append(time.perf_counter())
        return [1000 * (b - a) for a, b in itertools.pairwise(marks)]
    torch.cuda.synchronize(device)  # an idle device: a pass is a latency, not a share of a queue
    events = [torch.cuda.Event(enable_timing=True) for _ in range(len(stages) + 1)]
    with torch.cuda.device(device):
        events[0].record()
        for event, stage in zip(events[1:], stages, strict=True):
            value = stage(value)
            event.record()
    torch.cuda.synchronize(device)
    return [a.elapsed_time(b) for a, b in itertools.pairwise(events)]


def statistics(ms: np.ndarray) -> dict[str, float]:
    """Of the times [passes, stages]."""
    total = ms.sum(1)
    quarter = max(1, len(total) // 4)
    p50, p95, p99 = (float(p) for p in np.percentile(total, (50, 95, 99)))
    return {
        "mean_ms": float(total.mean()),
        "std_ms": float(total.std(ddof=1)) if len(total) > 1 else 0.0,
        "p50_ms": p50,
        "p95_ms": p95,
        "p99_ms": p99,
        "fps": float(1000 / total.mean()),
        **{f"{s}_ms": float(mean) for s, mean in zip(STAGES, ms.mean(0), strict=True)},
        "drift": float(total[-quarter:].mean() / total[:quarter].mean() - 1),
    }


# --- what a pass costs besides time ---------------------------------------------------------------


def _cost(stages: list[Stage], host: Tensor, device: torch.device) -> dict[str, float | str]:
    """Parameters, multiply-adds and memory of one pass, in passes of their own."""
    transfer, network, _ = stages
    with torch.no_grad():  # the FLOP counter sees through no_grad, not through inference_mode
        with FlopCounterMode(display=False) as flops, _Tensors() as tensors:
            network(transfer(host))
        used = tensors.parameters
        peak_bytes, kind = _peak(stages, host, device)
    return {
        "params_m": sum(p.numel() for p in used) / 1e6,
        "gmacs": flops.get_total_flops() / 2e9,
        "peak_mib": (sum(p.numel() * p.element_size() for p in used) + peak_bytes) / MIB,
        "peak_kind": kind,
    }


def _peak(stages: list[Stage], host: Tensor, device: torch.device) -> tuple[int, str]:
    """Most bytes that a pass over one image holds beyond the weights, and how that was found.

    On CUDA by the caching allocator, operator workspaces included. On the CPU by the sizes of the
    tensors alive at once, which leaves out the workspaces inside operators: a resident set size
    would hold the training run and the data set that share the process.
    """
    value: Any = host
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        for stage in stages:
            value = stage(value)
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before, "weights + CUDA allocator's peak"
    with _Tensors() as tensors:
        for stage in stages:
            value = stage(value)
    return tensors.peak_bytes, "weights + tensors alive at once"


class _Tensors(TorchDispatchMode):
    """Sees every operator: which parameters it reads, and the bytes of its results that still live.

    Reading is the test of what belongs to inference: auxiliary heads are in the network, not in
    the pass.
    """

    def __init__(self) -> None:
        super().__init__()
        self.live_bytes = self.peak_bytes = 0
        self._parameters: dict[int, nn.Parameter] = {}
        self._storages: set[int] = set()

    @property
    def parameters(self) -> list[nn.Parameter]:
        return list(self._parameters.values())

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        for value in _tensors_in((args, kwargs or {})):
            if isinstance(value, nn.Parameter):
                self._parameters[id(value)] = value
            self._storages.add(value.untyped_storage().data_ptr())  # inputs and views are no news
        result = func(*args, **(kwargs or {}))
        for value in _tensors_in(result):
            self._follow(value.untyped_storage())
        return result

    def _follow(self, storage: torch.UntypedStorage) -> None:
        address, size = storage.data_ptr(), storage.nbytes()
        if address in self._storages or not size:
            return
        self._storages.add(address)
        self.live_bytes += size
        self.peak_bytes = max(self.peak_bytes, self.live_bytes)
        weakref.finalize(storage, self._release, address, size)

    def _release(self, address: int, size: int) -> None:
        self._storages.discard(address)
        self.live_bytes -= size


def _tensors_in(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        yield from _tensors_in(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _tensors_in(item)


def device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_model()
