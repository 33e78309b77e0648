"""Rows, grids and run folders as the report gets them, made up."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd

from mtl_bench.bench.jobs import CELLS
from mtl_bench.core import config

GRID = SimpleNamespace(
    name="backbones",
    question="Which backbone & why?",
    recipe=config.Recipe(name="small"),
    report={"rows": "backbone"},
    cells=(),
    skips=(),
)
BASELINE = {"panoptic.pq": 12.0, "depth_median.rmse": 10.6}
PQ = {"resnet18": (36.0, 37.0, 38.0), "tiny_one": (30.0, 31.0, 32.0)}


def make_row(backbone="resnet18", seed=0, smoke=False, status="done", metric=None, **changes):
    recipe = config.Recipe(name="small", smoke=smoke)
    cell = config.Cell(recipe, backbone, changes.pop("method", "fixed"), seed=seed, **changes)
    values = {
        "panoptic.pq": 30.0,
        "panoptic.class.road.pq": 91.0,
        "panoptic.class.car.pq": 43.0,
        "depth_median.rmse": 9.0,
        "depth_dgc.rmse": 9.5,
        "dgc.failed": 1,
        "dgc.fallback": 2,
        "latency.fps": 50.0,
        "latency.params_m": 12.5 + sum(map(ord, backbone)) % 7,
        "latency.height": 64,
        "latency.width": 128,
        "latency.device": "A CPU",
        "latency.threads": 2,
    }
    return {
        **CELLS.identity(cell),
        "status": status,
        "metric": {**values, **(metric or {})},
        "protocol": {"split": "val", "depth_range_m": [0.001, 80.0]},
        "time": {"train_s": 120.0},
    }


def grid_rows(**changes):
    return [
        make_row(backbone, seed, metric={"panoptic.pq": pq}, **changes)
        for backbone, several in PQ.items()
        for seed, pq in enumerate(several)
    ]


def failed_row(error="Traceback\n  File\nValueError: loss 'center' is nan_at 50 % & more\n"):
    row = make_row("tiny_one", seed=9, status="failed")
    del row["metric"]
    return {**row, "error": error}


def curve(learned=True) -> dict:
    """Columns of a curve; a cosine every eighth step, a batch without labels now and then."""
    step = np.arange(1, 41)
    weight = np.exp(step / 40) if learned else np.ones(40)
    return {
        "step": step,
        "loss.semantic": np.where(step % 10 == 1, np.nan, 3 / step),
        "loss.center": 0.1 / step,
        "weight.semantic": weight,
        "weight.center": 200 * weight,
        "weight_sum": 201 * weight,
        "update_norm": 0.01 / step,
        "step_ms": 20 + step % 3,
        "cosine.semantic.center": np.where(step % 8 == 0, np.sin(step), np.nan),
    }


def write_runs(root: Path, rows, learned=True) -> Path:
    """Curves and samples as a run leaves them."""
    rng = np.random.default_rng(0)
    ids = np.full((2, 16, 32), 7, np.int32)
    ids[:, 4:9, 5:15], ids[:, 4:9, 16:25], ids[:, :3] = 26001, 26002, 23
    depth = np.linspace(2, 60, 16 * 32).reshape(16, 32)[None].repeat(2, 0).astype(np.float16)
    image = rng.integers(0, 255, (2, 4, 8, 3), dtype=np.uint8).repeat(4, 1).repeat(4, 2)
    for row in rows:
        folder = root / row["slug"]
        folder.mkdir(parents=True)
        pd.DataFrame(curve(learned)).to_csv(folder / "curve.csv", index=False)
        kept = {
            "names": np.array(["a", "b"]),
            "image": image,
            "instance_ids": np.roll(ids, 1, 2),
            "true_instance_ids": ids,
            "depth_m": depth,
            "true_depth_m": depth,
        }
        outermost = {f"extremes.{key}": value for key, value in kept.items()}
        path = folder / "samples.npz"
        np.savez_compressed(path, **kept, **outermost, **{"extremes.pq": [12.34, 87.65]})
    return root
