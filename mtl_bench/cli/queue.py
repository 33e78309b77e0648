"""`ablate --on slurm`: a grid's cells in a queue."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import Cell

if TYPE_CHECKING:
    from mtl_bench.bench.data_state import Data
    from mtl_bench.bench.jobs import Job


def queue(
    todo: "Sequence[Job]",
    runs: Path,
    data: Path | None,
    given: "Data",
    options: list[str],
    sbatch: Mapping[str, str],
    cap: int | None,
    rerun: str | None,
    dry_run: bool,
    quiet: bool,
) -> None:
    """Hand what nobody runs or has queued to Slurm. What they train on is rendered before, once."""
    from mtl_bench.bench import jobs as kinds
    from mtl_bench.bench import launch, store
    from mtl_bench.bench.executors import Task
    from mtl_bench.bench.slurm import FOLDER, Slurm, arrays

    slurm = Slurm(runs, sbatch, cap)
    states = {} if dry_run else slurm.states()
    busy = {cell.id for cell in todo if store.status(cell, runs) == "running"}
    busy |= {cell.id for cell in todo if cell.id in states and states[cell.id].word != "ended"}
    cells = [cell for cell in todo if isinstance(cell, Cell) and cell.id not in busy]
    if dry_run:
        shape = [Task(cell.id, (), runs, tuple(each.id for each in cell.parents)) for cell in cells]
        for number, array in enumerate(arrays(shape)):
            typer.echo(slurm.script(runs.resolve() / FOLDER / f"TOKEN{number}", len(array)))
        typer.echo("nothing was queued (--dry-run)")
        return
    if cells:
        slurm.check()  # before anything is made ready
    roots = {cell.recipe.data: o.data_root(cell, data, quiet) for cell in cells}

    def command(cell: Cell) -> list[str]:
        return kinds.cell_command(cell, runs, roots[cell.recipe.data], options)

    slurm.submit(launch.queued_tasks(cells, runs, command, rerun, given))
    numbers = " ".join(map(str, slurm.submitted))
    if busy:
        typer.echo(f"{len(busy)} cells run or are queued already")
    if cells:
        typer.echo(
            f"queued {len(cells)} cells as Slurm's jobs {numbers}; `status` shows them, "
            f"`scancel {numbers}` ends them, and once they are done `report` writes the report"
        )
    else:
        typer.echo("nothing to queue")
