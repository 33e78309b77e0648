"""How fast the machine could be: arithmetic and traffic of the network over the measured peaks.

Williams, Waterman, Patterson, Roofline, CACM 2009: the time is at least the multiply-adds over the
peak of arithmetic and at least the bytes over the peak of memory.
"""

import copy
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from mtl_bench.engines.base import DTYPES
from mtl_bench.engines.graph import Body

TRIES = 5
MATMUL = {"cpu": 2048, "cuda": 8192}  # side of the matrices
COPY = {"cpu": 2**26, "cuda": 2**28}  # floats: beyond any cache


def work(net: nn.Module, shape: tuple[int, int, int], precision: str) -> dict[str, float]:
    """Of one pass at B, H, W: `params_m` (millions that it reads), `gmacs` (multiply-adds of
    convolutions, 1e9), `network_mb` (1e6 bytes: of every convolution the input, weights and output
    once; all that stands between them can be fused into them). Nothing is computed."""
    with torch.inference_mode(False), torch.no_grad():  # operators on inference tensors come whole
        body = Body(copy.deepcopy(net).to("meta"))
        image_B3HW = torch.empty(shape[0], 3, *shape[1:], device="meta")
        with FlopCounterMode(display=False) as flops, _Traffic() as traffic:
            body(image_B3HW)
    size = DTYPES[precision].itemsize
    return {
        "params_m": sum(traffic.parameters.values()) / 1e6,
        "gmacs": flops.get_total_flops() / 2e9,
        "network_mb": traffic.values * size / 1e6,
    }


def peaks(device: torch.device, precision: str) -> tuple[float, float]:
    """Measured: GFLOP/s of a large matrix product in the precision, GB/s of a large copy."""
    side, floats = MATMUL[device.type], COPY[device.type]
    a, b = (torch.rand(side, side, device=device).to(DTYPES[precision]) for _ in range(2))
    source = torch.rand(floats, device=device)
    target = torch.empty_like(source)
    flops = 2 * side**3 / _fastest(lambda: a @ b, device)
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


class _Traffic(TorchDispatchMode):
    """Counts numbers that convolutions read and write, and which parameters are read at all."""

    def __init__(self) -> None:
        super().__init__()
        self.values = 0
        self.parameters: dict[int, int] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        tensors = [arg for arg in args if isinstance(arg, Tensor)]
        for tensor in tensors:
            if isinstance(tensor, nn.Parameter):
                self.parameters[id(tensor)] = tensor.numel()
        if func is torch.ops.aten.convolution.default:
            self.values += sum(tensor.numel() for tensor in [*tensors, result])
        return result
