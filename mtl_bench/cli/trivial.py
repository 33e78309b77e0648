"""Where a grid's trivial predictors are kept, and of which tasks."""

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from mtl_bench.core.config import TASKS, to_dict

if TYPE_CHECKING:
    from mtl_bench.bench.grid import Grid


def file_of(grid: "Grid", runs: Path) -> Path | None:
    """Where they are kept; None for a grid over several data sets or protocols."""
    tasks = tasks_of(grid)
    settings = {
        json.dumps([to_dict(cell.recipe.data), to_dict(cell.recipe.evaluate), tasks])
        for cell in grid.cells
    }
    if len(settings) != 1:
        return None
    key = hashlib.sha256(settings.pop().encode()).hexdigest()[:12]
    return runs / "baselines" / f"trivial-{key}.json"


def tasks_of(grid: "Grid") -> tuple[str, ...]:
    """Those that some cell has."""
    return tuple(task for task in TASKS if any(task in cell.tasks for cell in grid.cells))
