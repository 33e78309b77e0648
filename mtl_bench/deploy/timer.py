"""The timing protocol: how long one image takes from host memory to what a car needs of it.

Source: MGNet (Schoen, Buchholz, Dietmayer, ICCV 2021), section 4.2: the mean of 500 passes with
upload and post-processing included. Added here: distinct images, warm-up, percentiles, stages, and
for engines agreement with the plain network before any time.

One pass, batch 1, has three stages. transfer: the 8-bit image from (on CUDA: pinned) host memory to
where the network runs; a network that takes floats gets them made here. network: to its maps of the
image's size, without what only training needs. postprocess: what
tasks finish, such as instances. The results stay on the device; decoding and
resizing are not timed.

`measure` times a model as it was trained: eager torch, in the cell's precision. `row` times an
engine.
"""

import gc
import itertools
import os
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mtl_bench.core import config, provenance
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.device import Compute
from mtl_bench.core.engine import Engine, Setting
from mtl_bench.deploy import engines, maps, roofline
from mtl_bench.deploy.agreement import Agreement
from mtl_bench.deploy.maps import Last
from mtl_bench.deploy.roofline import Stage
from mtl_bench.deploy.subject import Subject, prepare
from mtl_bench.evaluate.walk import evaluating
from mtl_bench.model import Model

STAGES = ("transfer", "network", "postprocess")
COMPARED = 4  # images that an engine is held against the plain network on
WINDOW = 5  # passes: warm-up ends where the median of so many is not below that of those before
STABLE = 0.98  # of the window before: a median above this is no longer falling
WARMUP = 50  # passes at most
WARMUP_SHARE = 1 / 3  # of --seconds at most
LEAST = 20  # passes, whatever the time limit is
BATCHES = 5  # timed for throughput
SPREAD = 0.25  # of (p95 - p5) / p50 of the passes: beyond it a row says that its machine was noisy
DRIFT = 0.05  # of the last quarter of the passes against the first, either way: likewise


@dataclass(frozen=True)
class Plan:
    """How long to time; `seconds` ends the passes early, not before LEAST of them."""

    passes: int = 500
    seconds: float | None = None
    batch: int = 4  # for throughput; 1 = none of its own
    threads: int = 1
    compared: int = COMPARED
    warmup: int | None = None  # passes; None: until they stop getting faster


# --- passes ---------------------------------------------------------------------------------------


def take(
    stages: Sequence[Stage],
    hosts: Sequence[Tensor],
    device: torch.device,
    precision: str,
    plan: Plan,
) -> tuple[dict[str, Any], np.ndarray]:
    """Warm up and time the passes, each with the next image.

    Returns:
        `statistics` and what was measured; the passes' times [passes, stages], milliseconds.
    """
    rounds, warmup = itertools.cycle(hosts), plan.warmup
    if warmup is None:
        warmup = warm_up(stages, rounds, device, plan.seconds)
    else:
        for host in itertools.islice(rounds, warmup):
            time_pass(stages, host, device)
    gc.collect()
    ms = time_passes(stages, rounds, device, plan)
    return {
        **statistics(ms),
        "passes": len(ms),
        "warmup": warmup,
        "images": min(len(hosts), len(ms)),
        "threads": torch.get_num_threads(),
        "device": device_name(device),
        "precision": precision,
    }, ms


def warm_up(
    stages: Sequence[Stage], rounds: Iterator[Tensor], device: torch.device, seconds: float | None
) -> int:
    """Passes until the median stops falling; how many that took."""
    start, times = time.perf_counter(), []
    for passes in range(1, WARMUP + 1):
        times.append(sum(time_pass(stages, next(rounds), device)))
        if seconds is not None and time.perf_counter() - start > WARMUP_SHARE * seconds:
            break
        if passes >= 2 * WINDOW:
            before, now = np.median(times[-2 * WINDOW : -WINDOW]), np.median(times[-WINDOW:])
            if now >= STABLE * before:
                break
    return passes


def time_passes(
    stages: Sequence[Stage], rounds: Iterator[Tensor], device: torch.device, plan: Plan
) -> np.ndarray:
    """Milliseconds [passes, stages]."""
    start, ms = time.perf_counter(), []
    for passes in range(1, plan.passes + 1):
        ms.append(time_pass(stages, next(rounds), device))
        late = plan.seconds is not None and time.perf_counter() - start > plan.seconds
        if late and passes >= LEAST:
            break
    return np.array(ms)


def time_pass(stages: Sequence[Stage], host: Tensor, device: torch.device) -> list[float]:
    """Milliseconds of each stage, each fed with the one before's result."""
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


def spread(ms: np.ndarray) -> dict[str, Any]:
    """(p95 - p5) / p50 of the passes, and whether that or the drift says that others were busy."""
    total = ms.sum(1)
    p5, p50, p95 = np.percentile(total, (5, 50, 95))
    wide, drift = float((p95 - p5) / p50), statistics(ms)["drift"]
    return {"spread": wide, "noisy": wide > SPREAD or abs(drift) > DRIFT}


def device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else provenance.cpu_model()


# --- a model as it was trained --------------------------------------------------------------------


def measure(
    model: Model,
    images: Iterable[Batch | Tensor],
    camera: Camera,
    latency: config.Latency,
    device: torch.device | str,
    precision: str = "fp32",
) -> dict[str, float | int | str]:
    """Time `latency.passes` single images through `model.net` and what follows it.

    Args:
        model: on `device`; its `net` is timed in evaluation mode and left in the mode it was in.
        images: batches, or images [3,H,W] or [B,3,H,W], uint8 or float in [0, 1]. Each pass takes
            the next one; fewer images than passes are used in turn.
        camera: of the images, as a batch of one.
        latency: passes, warm-up, and the input size where it is not the images' own (bilinear
            resize before the clock starts, intrinsics scaled with it).

    Returns:
        Values under `latency.`: mean_ms, std_ms, p50_ms, p95_ms, p99_ms, fps (1000 / mean), the
        means of the three stages (they add up to mean_ms), drift (last quarter of the passes
        against the first, 0.1 = 10 % slower), params_m (parameters that a pass uses, millions),
        gmacs (multiply-adds of the network's convolutions and matrix products, 1e9), peak_mib and
        peak_kind (see `roofline.peak`), and what was measured: passes, warmup, images (distinct),
        height, width, device, precision, threads, clock.

    Raises:
        ValueError: no images.
    """
    place = Compute(torch.device(device), precision)
    hosts, K_133 = prepare(images, camera.K_B33[0], latency, pin=place.pinned)
    seen = replace(camera, K_B33=K_133).map(lambda value: value.to(place.device))

    def transfer(host: Tensor) -> Tensor:
        image = host.to(place.device, non_blocking=True)
        return image.to(torch.float32, memory_format=torch.channels_last) / 255

    def network(image_13HW: Tensor) -> maps.Maps:
        with place.autocast():
            return maps.flat(model.net(image_13HW).maps, model.tasks)

    stages: list[Stage] = [transfer, network, Last(model.tasks, seen)]
    plan = Plan(latency.passes, warmup=latency.warmup)
    with evaluating(model):
        cost = roofline.cost(stages, hosts[0], place.device)
        with torch.inference_mode():
            timing, _ = take(stages, hosts, place.device, precision, plan)
    values = {
        **timing,
        **cost,
        "height": hosts[0].shape[-2],
        "width": hosts[0].shape[-1],
        "clock": "CUDA events" if place.device.type == "cuda" else "time.perf_counter",
    }
    return {f"latency.{key}": value for key, value in values.items()}


# --- an engine ------------------------------------------------------------------------------------


def row(
    subject: Subject, name: str, precision: str, device: torch.device, plan: Plan
) -> dict[str, Any]:
    """Time an engine; whatever becomes of it, there is a row with a `status` and `why`.

    Raises:
        ValueError: no such engine, or it does not have the precision on this device.
    """
    lack = engines.available(name)
    if not lack or device.type in engines.facts(name).precisions:  # else it says what it lacks
        engines.check(name, precision, device.type)
    result: dict[str, Any] = {
        "kind": "latency",
        "backbone": subject.backbone,
        "tasks": [task.name for task in subject.tasks],
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
    package = engines.facts(name).packages[0]
    result["env"][package] = provenance.version(package)
    torch.set_num_threads(plan.threads)
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
    device, precision = setting.device, setting.precision
    engine = make(subject, name, setting)
    agreement = compare(subject, engine, plan.compared)
    metric: dict[str, Any] = agreement.values()
    wrong = agreement.wrong(precision, subject.trained is not None)
    if wrong:
        return "wrong", f"{name} {precision} differs from plain: {wrong}", metric
    stages: list[Stage] = [engine.transfer, engine.run, subject.last(1, device)]
    timing, ms = take(stages, subject.images, device, precision, plan)
    work = roofline.work(subject.net, (1, *setting.size), precision)
    del engine, stages  # its memory, before that of a larger batch
    timing |= {**spread(ms), **work}
    timing |= throughput(subject, name, setting, plan, timing["fps"])
    gflops, gbs = roofline.peaks(device, precision)
    metric |= {f"latency.{key}": value for key, value in timing.items()}
    metric |= {"roofline.peak_gflops": gflops, "roofline.peak_gbs": gbs}
    metric["roofline.share"] = roofline.share(work, gflops, gbs, timing["network_ms"])
    return "done", "", metric


def make(subject: Subject, name: str, setting: Setting) -> Engine:
    return build(engines.load(name), subject, setting)


def build(kind: type[Engine], subject: Subject, setting: Setting) -> Engine:
    if setting.device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # fp32 means float32
    with torch.inference_mode(False):  # an exporter keeps weights, which must be ordinary tensors
        return kind(subject.net, replace(setting, examples=tuple(subject.examples)))


def compare(subject: Subject, engine: Engine, images: int = COMPARED) -> Agreement:
    """Hold an engine against the plain network, with float32 arithmetic, on the first images."""
    setting = engine.setting
    exact = Setting(1, *setting.size, "fp32", setting.device, setting.threads)
    plain, last = make(subject, engines.REFERENCE, exact), subject.last(1, setting.device)
    agreement = Agreement(maps.infos(subject.tasks))
    for image_1HW3 in subject.images[:images]:
        runs = [it.run(it.transfer(image_1HW3)) for it in (plain, engine)]
        a, b = ((found, last(found)) for found in runs)
        agreement.update(a, b)
    return agreement


def throughput(
    subject: Subject, name: str, setting: Setting, plan: Plan, fps: float
) -> dict[str, float]:
    """Images a second, `plan.batch` at a time; of batch 1 what the latency says."""
    if plan.batch == 1:
        return {"throughput_fps": fps, "throughput_batch": 1}
    device = setting.device
    larger = Setting(plan.batch, *setting.size, setting.precision, device, plan.threads)
    engine = make(subject, name, larger)
    stages: list[Stage] = [engine.transfer, engine.run, subject.last(plan.batch, device)]
    source = itertools.cycle(subject.images)
    hosts = [torch.cat(list(itertools.islice(source, plan.batch))) for _ in range(2)]
    timing, _ = take(stages, hosts, device, setting.precision, Plan(BATCHES, warmup=1))
    return {"throughput_fps": plan.batch * timing["fps"], "throughput_batch": plan.batch}
