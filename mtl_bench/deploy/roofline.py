"""What a pass costs besides time, and how fast the machine could be.

Williams, Waterman, Patterson, Roofline, CACM 2009: the time is at least the multiply-adds over the
peak of arithmetic and at least the bytes over the peak of memory.
"""

import copy
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from mtl_bench.core.engine import PRECISIONS
from mtl_bench.deploy.graph import Body

TRIES = 5
MATMUL = {"cpu": (1024, 1536, 2048), "cuda": (8192,)}  # sides of the matrices
CONVOLVED = {"cpu": 1, "cuda": 64}  # images of 32 x 64 pixels and 512 channels
COPY = {"cpu": 2**26, "cuda": 2**28}  # floats: beyond any cache
MIB = 2**20
Stage = Callable[[Any], Any]


# --- of a network ---------------------------------------------------------------------------------


def work(net: nn.Module, shape: tuple[int, int, int], precision: str) -> dict[str, float]:
    """Of one pass at B, H, W: `params_m` (millions that it reads), `gmacs` (multiply-adds of
    convolutions, 1e9), `network_mb` (1e6 bytes: of every convolution the input, weights and output
    once; all that stands between them can be fused into them). Nothing is computed."""
    with torch.inference_mode(False), torch.no_grad():  # operators on inference tensors come whole
        body = Body(copy.deepcopy(net).to("meta"))
        image_B3HW = torch.empty(shape[0], 3, *shape[1:], device="meta")
        counted, seen = _count(lambda: body(image_B3HW))
    return counted | {"network_mb": seen.traffic * PRECISIONS[precision].itemsize / 1e6}


def cost(stages: Sequence[Stage], host: Tensor, device: torch.device) -> dict[str, float | str]:
    """Parameters, multiply-adds and memory of one pass (`peak`), in passes of their own.

    Args:
        stages: transfer, network, and what follows, which is no part of the multiply-adds.
    """
    transfer, network = stages[:2]
    with torch.no_grad():  # the FLOP counter sees through no_grad, not through inference_mode
        counted, seen = _count(lambda: network(transfer(host)))
        peak_bytes, kind = peak(stages, host, device)
    weights_bytes = sum(p.numel() * p.element_size() for p in seen.parameters)
    return {**counted, "peak_mib": (weights_bytes + peak_bytes) / MIB, "peak_kind": kind}


def _count(run: Callable[[], Any]) -> tuple[dict[str, float], "Observer"]:
    """Parameters that it reads (millions) and its multiply-adds (1e9)."""
    with FlopCounterMode(display=False) as flops, Observer() as seen:
        run()
    params_m = sum(p.numel() for p in seen.parameters) / 1e6
    return {"params_m": params_m, "gmacs": flops.get_total_flops() / 2e9}, seen


def peak(stages: Sequence[Stage], host: Tensor, device: torch.device) -> tuple[int, str]:
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
    with Observer() as seen:
        for stage in stages:
            value = stage(value)
    return seen.peak_bytes, "weights + tensors alive at once"


class Observer(TorchDispatchMode):
    """Sees every operator: parameters that it reads, bytes alive, what convolutions move.

    Reading is the test of what belongs to inference: auxiliary heads are in the network, not in
    the pass.

    Attributes:
        traffic: numbers that convolutions read and write.
        peak_bytes: of results of operators, most that lived at once.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.traffic = self.live_bytes = self.peak_bytes = 0
        self._parameters: dict[int, nn.Parameter] = {}
        self._storages: set[int] = set()

    @property
    def parameters(self) -> list[nn.Parameter]:
        return list(self._parameters.values())

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        given = list(_tensors_in((args, kwargs or {})))
        for value in given:
            if isinstance(value, nn.Parameter):
                self._parameters[id(value)] = value
            self._storages.add(value.untyped_storage().data_ptr())  # inputs and views are no news
        result = func(*args, **(kwargs or {}))
        if func is torch.ops.aten.convolution.default:
            self.traffic += sum(tensor.numel() for tensor in [*given, result])
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


# --- of the machine -------------------------------------------------------------------------------


def peaks(device: torch.device, precision: str) -> tuple[float, float]:
    """Measured: GFLOP/s in the precision of large matrix products or a 3 x 3 convolution, whichever
    is fastest, and GB/s of a large copy. On a CPU different libraries compute the two: MKL's
    product reaches half of what oneDNN's convolution does on an AMD processor. torch has a product
    in int8, which depends on the size (with AMX 2,300 to 4,600 GFLOP/s), and no convolution."""
    dtype = PRECISIONS[precision]
    images, floats = CONVOLVED[device.type], COPY[device.type]
    product = torch._int_mm if dtype is torch.int8 else torch.mm
    flops = 0.0
    for side in MATMUL[device.type]:
        a, b = (torch.rand(side, side, device=device).to(dtype) for _ in range(2))
        seconds = _fastest(partial(product, a, b), device)
        flops = max(flops, 2 * side**3 / seconds)
    if dtype.is_floating_point:
        x = torch.rand(images, 512, 32, 64, device=device).to(dtype)
        weight = torch.rand(512, 512, 3, 3, device=device).to(dtype)
        x, weight = (one.contiguous(memory_format=torch.channels_last) for one in (x, weight))
        convolved = 2 * 9 * x.numel() * len(weight)
        flops = max(flops, convolved / _fastest(lambda: F.conv2d(x, weight, padding=1), device))
    source = torch.rand(floats, device=device)
    target = torch.empty_like(source)
    moved = 2 * 4 * floats / _fastest(lambda: target.copy_(source), device)
    return flops / 1e9, moved / 1e9


def share(work: dict[str, float], peak_gflops: float, peak_gbs: float, network_ms: float) -> float:
    """Of the time that the stage took, the part that the machine's peaks would need."""
    least_ms = max(2e3 * work["gmacs"] / peak_gflops, work["network_mb"] / peak_gbs)
    return least_ms / network_ms


def _fastest(run: Callable[[], Any], device: torch.device) -> float:
    """Seconds."""
    best = float("inf")
    for _ in range(TRIES):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        start = time.perf_counter()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        best = min(best, time.perf_counter() - start)
    return best
