"""Rows of a grid of latencies as `latency_runs.rows` gives them, made up."""

from mtl_bench.bench.timing import Timing
from mtl_bench.core.config import TASKS
from mtl_bench.core.plain import to_dict

FACTOR = {"plain": 1.0, "eager": 0.8, "onnxruntime": 0.5, "openvino": 0.4}
BACKBONES = {"resnet18": 1.0, "tiny_one": 0.25}
ENV = {"torch": "2.8.0", "device": "A CPU", "threads": 2, "argv": "mtl-bench latency"}
INSTALL = "tensorrt is not installed: pip install mtl-bench[tensorrt]"


def metric(timing, mean_ms, work):
    """Consistent numbers: stages that add up, FPS, a roof."""
    values = {
        "mean_ms": mean_ms,
        "std_ms": 0.02 * mean_ms,
        "p50_ms": 0.99 * mean_ms,
        "p95_ms": 1.05 * mean_ms,
        "p99_ms": 1.2 * mean_ms,
        "fps": 1000 / mean_ms,
        "transfer_ms": 0.01 * mean_ms,
        "network_ms": 0.93 * mean_ms,
        "postprocess_ms": 0.06 * mean_ms,
        "passes": timing.passes,
        "warmup": 10,
        "images": 20,
        "threads": 2,
        "device": "A CPU",
        "precision": timing.precision,
        "spread": 0.02,
        "drift": 0.01,
        "noisy": False,
        "params_m": 12.5,
        "gmacs": 80.0 * work,
        "network_mb": 900.0 * pixels_of(timing),
        "throughput_fps": 1100 / mean_ms,
        "throughput_batch": 4,
    }
    peak = 900.0 if timing.precision == "bf16" else 300.0
    others = {
        "roofline.peak_gflops": peak,
        "roofline.peak_gbs": 20.0,
        "roofline.share": 160.0 * work / (0.93 * mean_ms / 1000) / peak,
        "agreement.logits_max": 2e-5,
        "agreement.panoptic_equal": 0.99975,
        "agreement.depth_median_rel": 3e-7,
        "agreement.depth_max_rel": 1e-5,
    }
    return {**{f"latency.{key}": value for key, value in values.items()}, **others}


def pixels_of(timing):
    """In units of 1024x2048."""
    return timing.height * timing.width / 2**21


def make_row(engine="plain", backbone="resnet18", status="done", mean_ms=None, **changes):
    """One row; `metric` among the changes replaces single values."""
    own = changes.pop("metric", {})
    more = {key: changes.pop(key) for key in ("why", "smoke", "weights") if key in changes}
    timing = Timing(backbone, engine, **changes)
    work = pixels_of(timing) * (1 if timing.tasks == TASKS else 0.7) * BACKBONES.get(backbone, 1.0)
    if mean_ms is None:
        mean_ms = 2000 * work * FACTOR.get(engine, 1) * (0.6 if timing.precision == "bf16" else 1)
    row = {
        "kind": "latency",
        "backbone": backbone,
        "tasks": list(timing.tasks),
        "engine": engine,
        "precision": timing.precision,
        "height": timing.height,
        "width": timing.width,
        "timing": to_dict(timing),
        "status": status,
        "why": "",
        "smoke": False,
        "weights": "random",
        **more,
    }
    if status in ("done", "stale"):
        row |= {"metric": {**metric(timing, mean_ms, work), **own}, "env": ENV}
    return row


def grid_rows():
    """Two sizes, two sets of tasks, two backbones; no TensorRT, one line of each trouble."""
    rows = []
    for size in ("384x1280", "1024x2048"):
        for tasks in (TASKS, ("panoptic",)):
            for backbone in BACKBONES:
                named = {"backbone": backbone, "size": size, "tasks": tasks}
                rows += [make_row(engine, **named) for engine in FACTOR]
                rows += [make_row("openvino", precision="bf16", **named)]
                rows += [make_row("tensorrt", status="unavailable", why=INSTALL, **named)]
    wrong = "equal panoptic pixels 0.91 < 0.999"
    rows.append(make_row("compile", size="384x1280", status="wrong", why=wrong))
    rows.append(make_row("compile", status="failed", why="killed by SIGKILL (out of memory?)"))
    rows.append(make_row("compile", backbone="tiny_one", metric={"latency.noisy": True}))
    rows.append(make_row("compile", precision="bf16", status="missing"))
    return rows
