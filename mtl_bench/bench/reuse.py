"""Training that is done already, by a cell that differs only in what comes after it.

Two such cells have each their row and their id; what they share is a training, whose identity is
`core.config.training_json`. The second takes the first one's checkpoint as its own.
"""

import shutil
from pathlib import Path
from typing import Any

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.jobs import load_cell
from mtl_bench.core.config import Cell, training_json
from mtl_bench.core.files import read_json, replacing

CHECKPOINT = "last.pt"
BESIDE = ("curve.csv", "taken.json", "pseudo_labels")  # what a row is made of, too


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
            state = _finished(cell, path, data)
        except ValueError:
            continue  # a damaged cell is told where it is asked for, and hurts no other
        if state is None:
            continue
        for name in BESIDE:
            if (path.parent / name).is_dir():
                shutil.copytree(path.parent / name, directory / name, dirs_exist_ok=True)
            elif (path.parent / name).exists():
                shutil.copy(path.parent / name, directory / name)
        import torch

        from mtl_bench.train.checkpoint import owner

        state["cell"] = owner(cell)
        with replacing(directory / CHECKPOINT) as file:  # last: what is there is whole
            torch.save(state, file)
        return f"trained already, in {path.parent}: only what comes after it is run"
    return ""


def _finished(cell: Cell, path: Path, data: Data | None) -> dict[str, Any] | None:
    """The state of a checkpoint at the last step of this cell's training, by the code of today and
    on the same data."""
    code = read_json(path.with_name("code.json"))
    if code is None or training_json(load_cell(path.with_name("cell.json"))) != training_json(cell):
        return None
    if "train" in store.changed(code, cell, data):
        return None
    from mtl_bench.train import checkpoint  # takes seconds, for torch

    state = checkpoint.read(path)
    return state if state["step"] >= cell.recipe.optim.steps else None
