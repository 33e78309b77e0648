"""The timing protocol of engines: agreement first, then passes, and one row that says everything.

As training rows are timed (see `latency`): batch 1, distinct images, upload and post-processing
inside. Stages: transfer (8-bit image from host memory to where the network runs; the plain network
takes floats, which are made here), network (to class indices, center, offset and inverse depth at
the image's size), postprocess (instances, metric depth).
"""

import gc
import itertools
import os
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mtl_bench import engines, latency
from mtl_bench.core import provenance
from mtl_bench.engines import roofline
from mtl_bench.engines.agreement import Agreement
from mtl_bench.engines.base import InferenceEngine, Setting
from mtl_bench.engines.noise import DRIFT, SPREAD
from mtl_bench.engines.scene import Last, Subject

COMPARED = 4  # images that an engine is held against the plain network on
WINDOW = 5  # passes: warm-up ends where the median of so many is not below that of those before
STABLE = 0.98  # of the window before: a median above this is no longer falling
WARMUP = 50  # passes at most
WARMUP_SHARE = 1 / 3  # of --seconds at most
LEAST = 20  # passes, whatever the time limit is
BATCHES = 5  # timed for throughput


@dataclass(frozen=True)
class Plan:
    """How long to time; `seconds` ends the passes early, not before LEAST of them."""

    passes: int = 500
    seconds: float | None = None
    batch: int = 4  # for throughput; 1 = none of its own
    threads: int = 1
    compared: int = COMPARED


def row(
    subject: Subject, name: str, precision: str, device: torch.device, plan: Plan
) -> dict[str, Any]:
    """Time an engine; whatever becomes of it, there is a row with a `status` and `why`.

    Raises:
        ValueError: no such engine, or it does not have the precision on this device.
    """
    lack = engines.available(name)
    if not (lack and name == "tensorrt"):  # which has nothing on a CPU: say what it lacks instead
        engines.check(name, precision, device.type)
    result: dict[str, Any] = {
        "kind": "latency",
        "backbone": subject.backbone,
        "tasks": list(subject.tasks),
        "engine": name,
        "precision": precision,
        "height": subject.size[0],
        "width": subject.size[1],
        "status": "unavailable" if lack else "failed",
        "why": lack or "",
        "weights": "random" if subject.trained is None else "trained",
        "trained": subject.trained,
        "metric": {},
        "env": provenance.environment(device),
    }
    if lack:
        return result
    package = engines.load(name).package
    result["env"][package] = provenance.version(package)
    torch.set_num_threads(plan.threads)
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # fp32 means float32
    try:
        with torch.inference_mode():
            result["status"], result["why"], result["metric"] = _measured(
                subject, name, Setting(1, *subject.size, precision, device, plan.threads), plan
            )
    except Exception as error:
        if os.environ.get("MTL_BENCH_TRACEBACK"):
            traceback.print_exc()
        result["why"] = " ".join(f"{type(error).__name__}: {error}".split())[:500]
    return result


def _measured(
    subject: Subject, name: str, setting: Setting, plan: Plan
) -> tuple[str, str, dict[str, Any]]:
    """Status, why, and the metrics."""
    engine = make(subject, name, setting)
    agreement = compare(subject, engine, plan.compared)
    metric: dict[str, Any] = agreement.values()
    wrong = agreement.wrong(setting.precision, subject.trained is not None)
    if wrong:
        return "wrong", f"{name} {setting.precision} differs from plain: {wrong}", metric
    stages = [engine.transfer, engine.network, Last(subject, 1, setting.device)]
    rounds = itertools.cycle(subject.images)
    warmup = warm_up(stages, rounds, setting.device, plan.seconds)
    gc.collect()
    ms = time_passes(stages, rounds, setting.device, plan)
    work = roofline.work(subject.net, (1, *setting.size), setting.precision)
    timing = {**latency.statistics(ms), **spread(ms), **work}
    timing |= {
        "passes": len(ms),
        "warmup": warmup,
        "images": min(len(subject.images), len(ms)),
        "threads": plan.threads,
        "device": latency.device_name(setting.device),
        "precision": setting.precision,
    }
    del engine, stages  # its memory, before that of a larger batch
    timing |= throughput(subject, name, setting, plan, timing["fps"])
    gflops, gbs = roofline.peaks(setting.device, setting.precision)
    metric |= {f"latency.{key}": value for key, value in timing.items()}
    metric |= {"roofline.peak_gflops": gflops, "roofline.peak_gbs": gbs}
    metric["roofline.share"] = roofline.share(work, gflops, gbs, timing["network_ms"])
    return "done", "", metric


def make(subject: Subject, name: str, setting: Setting) -> InferenceEngine:
    with torch.inference_mode(False):  # an exporter keeps weights, which must be ordinary tensors
        return engines.load(name)(subject.net, setting)


def compare(subject: Subject, engine: InferenceEngine, images: int = COMPARED) -> Agreement:
    """Hold an engine against the plain network, with float32 arithmetic, on the first images."""
    setting = engine.setting
    exact = Setting(1, *setting.size, "fp32", setting.device, setting.threads)
    plain, last = make(subject, "plain", exact), Last(subject, 1, setting.device)
    agreement = Agreement()
    for image_1HW3 in subject.images[:images]:
        maps = [it.network(it.transfer(image_1HW3)) for it in (plain, engine)]
        a, b = ((found, last(found)) for found in maps)
        agreement.update(a, b)
    return agreement


def warm_up(
    stages: list[Any], rounds: Iterator[Tensor], device: torch.device, seconds: float | None
) -> int:
    """Passes until the median stops falling; how many that took."""
    start, times = time.perf_counter(), []
    for passes in range(1, WARMUP + 1):
        times.append(sum(latency.time_pass(stages, next(rounds), device)))
        if seconds is not None and time.perf_counter() - start > WARMUP_SHARE * seconds:
            break
        if passes >= 2 * WINDOW:
            before, now = np.median(times[-2 * WINDOW : -WINDOW]), np.median(times[-WINDOW:])
            if now >= STABLE * before:
                break
    return passes


def time_passes(
    stages: list[Any], rounds: Iterator[Tensor], device: torch.device, plan: Plan
) -> np.ndarray:
    """Milliseconds [passes, stages]."""
    start, ms = time.perf_counter(), []
    for passes in range(1, plan.passes + 1):
        ms.append(latency.time_pass(stages, next(rounds), device))
        late = plan.seconds is not None and time.perf_counter() - start > plan.seconds
        if late and passes >= LEAST:
            break
    return np.array(ms)


def spread(ms: np.ndarray) -> dict[str, Any]:
    """(p95 - p5) / p50 of the passes, and whether that or the drift says that others were busy."""
    total = ms.sum(1)
    p5, p50, p95 = np.percentile(total, (5, 50, 95))
    wide, drift = float((p95 - p5) / p50), latency.statistics(ms)["drift"]
    return {"spread": wide, "noisy": wide > SPREAD or abs(drift) > DRIFT}


def throughput(
    subject: Subject, name: str, setting: Setting, plan: Plan, fps: float
) -> dict[str, float]:
    """Images a second, `plan.batch` at a time; of batch 1 what the latency says."""
    if plan.batch == 1:
        return {"throughput_fps": fps, "throughput_batch": 1}
    device = setting.device
    larger = Setting(plan.batch, *setting.size, setting.precision, device, plan.threads)
    engine = make(subject, name, larger)
    stages: list[Any] = [engine.transfer, engine.network, Last(subject, plan.batch, device)]
    source = itertools.cycle(subject.images)
    hosts = [torch.cat(list(itertools.islice(source, plan.batch))) for _ in range(2)]
    latency.time_pass(stages, hosts[0], device)
    ms = [sum(latency.time_pass(stages, hosts[n % 2], device)) for n in range(BATCHES)]
    return {
        "throughput_fps": 1000 * plan.batch * BATCHES / sum(ms),
        "throughput_batch": plan.batch,
    }
