"""What stands beside a grid's rows: trivial predictors, the rows that deltas are against, and the
quality that belongs to a speed."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mtl_bench.bench import store
from mtl_bench.bench.grid import Grid, baseline_cell, load_grid
from mtl_bench.core.config import Cell, to_dict
from mtl_bench.core.files import read_json, write_json

SEEDS = 10  # of the quality beside the speed: those below this that are done are averaged


def trivial(grid: Grid, runs: Path) -> dict[str, Any] | None:
    """Metrics of the trivial predictors on the grid's data set, where they were measured."""
    file = _trivial_file(grid, runs)
    return None if file is None else read_json(file)


def measure_trivial(
    grid: Grid, runs: Path, root: Callable[[], Path], refresh: bool = False
) -> None:
    """Measure them (`baselines` keeps what it did once).

    Args:
        root: gives the data set, which may take rendering.
        refresh: although they were measured. Not where no cell ran: then the numbers beside them
            are the old ones, too.
    """
    file = _trivial_file(grid, runs)
    if file is None or (file.is_file() and not refresh):
        return
    from mtl_bench.evaluate.trivial import baselines as measure

    file.parent.mkdir(parents=True, exist_ok=True)
    cell = replace(grid.cells[0], tasks=_tasks(grid), video=False, single_task=False)
    write_json(file, measure(cell, root(), file.parent).metrics)


def _trivial_file(grid: Grid, runs: Path) -> Path | None:
    """Where they are kept; None for a grid over several data sets or protocols."""
    tasks = _tasks(grid)
    settings = {
        json.dumps([to_dict(cell.recipe.data), to_dict(cell.recipe.evaluate), tasks])
        for cell in grid.cells
    }
    if len(settings) != 1:
        return None
    key = hashlib.sha256(settings.pop().encode()).hexdigest()[:12]
    return runs / "baselines" / f"trivial-{key}.json"


def _tasks(grid: Grid) -> tuple[str, ...]:
    """Those that some cell has, as the cells name them."""
    return tuple(dict.fromkeys(task for cell in grid.cells for task in cell.tasks))


def baselines(grid: Grid) -> tuple[Cell, ...]:
    """The cells that deltas are against, whether they are in a row or not, each once."""
    if not grid.baseline:
        return ()
    skipped = {skip.job.id for skip in grid.skips}
    alike = {
        (c.recipe, c.backbone, str(c.backbone_args), c.pretrained, c.seed): c for c in grid.cells
    }
    found = {c.id: c for c in (baseline_cell(cell, grid.baseline) for cell in alike.values())}
    return tuple(cell for cell in found.values() if cell.id not in skipped)


def baseline_row(grid: Grid, row: Mapping[str, Any], runs: Path) -> dict[str, Any] | None:
    """The stored row that a row's delta is against; None where there is none."""
    cell = next(cell for cell in grid.cells if cell.id == row["cell_id"])
    (stored,) = store.rows([baseline_cell(cell, grid.baseline)], runs)
    return stored if "metric" in stored else None


def baseline_rows(grid: Grid, runs: Path) -> list[dict[str, Any]]:
    """The rows of those cells that are not the grid's own."""
    own = {cell.id for cell in grid.cells}
    return store.rows([cell for cell in baselines(grid) if cell.id not in own], runs)


def quality(grid: Grid, runs: Path) -> list[dict[str, Any]]:
    """Done rows of the grid whose quality stands beside the speed, every seed that there is."""
    named = grid.quality
    if "grid" not in named:
        return []
    cells = load_grid(named["grid"], recipe=named.get("recipe"), seeds=SEEDS).cells
    return [row for row in store.rows(cells, runs) if row["status"] == "done"]
