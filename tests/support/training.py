"""Train a cell in this process, and read back what it left."""

import csv
from pathlib import Path

import torch

from mtl_bench.core.config import Cell, load_recipe, override
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import Compute
from mtl_bench.train.loop import train
from mtl_bench.train.progress import Progress
from mtl_bench.train.tracking import Tracker

CPU = torch.device("cpu")
SCALES = [  # the smallest cells that there are
    *("recipe.data.train_scenes=64", "recipe.data.val_scenes=16", "recipe.data.test_scenes=16"),
    *("recipe.data.heads=3", 'tasks=["regress:y0", "regress:y1", "regress:y2"]'),
    *("recipe.optim.steps=5", "recipe.optim.batch=8", "recipe.optim.warmup_steps=0"),
    *("recipe.latency.passes=2", "recipe.data.workers=0"),
]


def scales_cell(method: str, **values) -> Cell:
    return override(Cell(load_recipe("scales"), "mlp", method, **values), SCALES)


def scales_root() -> Path:
    recipe = scales_cell("fixed").recipe
    return dataset_of(recipe).render(recipe.data)


def run(cell, root: Path, run_dir: Path, progress=None, **options):
    run_dir.mkdir(exist_ok=True)
    progress = progress or Progress(run_dir, lambda line: None)
    tracker = Tracker("off", cell, run_dir)
    return train(cell, root, run_dir, Compute(CPU), progress, tracker, **options)


def curve(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "curve.csv").open() as file:
        return list(csv.DictReader(file))
