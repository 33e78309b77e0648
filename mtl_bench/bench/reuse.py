"""Training that is done already, by a cell that differs only in what comes after it.

Two such cells have each their row and their id; what they share is a training, whose identity is
`core.config.training_json`. The second takes the first one's checkpoint as its own.
"""

import shutil
from pathlib import Path

import torch

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.jobs import load_cell
from mtl_bench.bench.run import TAKEN
from mtl_bench.core.config import Cell, training_json
from mtl_bench.core.files import read_json, replacing
from mtl_bench.train import checkpoint
from mtl_bench.train.loop import CHECKPOINT

BESIDE = ("curve.csv", TAKEN, "pseudo_labels")  # what a checkpoint's row is made of, too


def adopt(cell: Cell, runs: Path, data: Data | None = None) -> str:
    """Copy a finished training that is this cell's into its folder, where there is one in runs/.

    Args:
        data: what the cell is trained on; None: it is not asked.

    Returns:
        A line that says so; empty where none was found, or the cell has begun its own.
    """
    directory = store.run_dir(cell, runs)
    if cell.single_task or (directory / CHECKPOINT).exists():
        return ""
    alike = f"{cell.method}-{cell.backbone}-s{cell.seed}-*/{CHECKPOINT}"
    for path in sorted(runs.glob(alike)):
        try:
            state = {"step": 0}
            if _of_this_training(cell, path.parent, data):
                state = checkpoint.read(path)
        except ValueError:
            continue  # a damaged cell is told where it is asked for, and hurts no other
        if state["step"] < cell.recipe.optim.steps:
            continue
        for name in BESIDE:
            if (path.parent / name).is_dir():
                shutil.copytree(path.parent / name, directory / name, dirs_exist_ok=True)
            elif (path.parent / name).exists():
                shutil.copy(path.parent / name, directory / name)
        with replacing(directory / CHECKPOINT) as file:  # last: what is there is whole
            torch.save(state, file)
        return f"trained already, in {path.parent}: only what comes after it is run"
    return ""


def _of_this_training(cell: Cell, directory: Path, data: Data | None) -> bool:
    """Whether a run is of the same training, by the code of today and on the same data."""
    other, code = directory / "cell.json", read_json(directory / "code.json")
    if code is None or not other.is_file():
        return False
    same = training_json(load_cell(other)) == training_json(cell)
    return same and "train" not in store.changed(code, cell, data)
