"""Train a cell in this process, and read back what it left."""

import csv
from pathlib import Path

import torch

from mtl_bench.core.device import Compute
from mtl_bench.train.loop import train
from mtl_bench.train.progress import Progress
from mtl_bench.train.tracking import Tracker

CPU = torch.device("cpu")


def run(cell, root: Path, run_dir: Path, progress=None, **options):
    run_dir.mkdir(exist_ok=True)
    progress = progress or Progress(run_dir, lambda line: None)
    tracker = Tracker("off", cell, run_dir)
    return train(cell, root, run_dir, Compute(CPU), progress, tracker, **options)


def curve(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "curve.csv").open() as file:
        return list(csv.DictReader(file))
