"""`report --table`: measured rows among the published ones of the paper's comparisons."""

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from mtl_bench.cli.choice import Choice

GridOption = Annotated[
    str | None,
    typer.Option(
        "--grid",
        metavar="NAME|FILE",
        help="A grid's name, or a .toml of your own.",
        show_default=False,
    ),
]
TableOption = Annotated[
    str | None,
    typer.Option(
        "--table",
        metavar="NAME",
        help="cityscapes or kitti: the paper's comparison with the rows of --grid, or of all cells "
        "in --runs, among the published ones; in place of a grid's report.",
        show_default=False,
    ),
]


def write(name: str | None, choice: Choice | None, runs: Path, reports: Path, smoke: bool) -> None:
    """Write the table's files and say where, and what it lacks.

    Args:
        choice: whose rows; None: those of all cells in `runs`.
        smoke: smoke rows alone, in a folder of their own.

    Raises:
        ValueError: no such table, or a damaged row.
    """
    if name is None:
        raise ValueError("nothing to report: say --grid NAME or --table NAME")
    from mtl_bench.bench import results
    from mtl_bench.report import comparison, comparison_files, published

    literature = published.load(name)
    rows = _stored(runs) if choice is None else results.rows(choice.load().cells, runs)
    table = comparison.compare(literature, rows, smoke)
    folder = reports / f"tables-{name}{'-smoke' * smoke}"
    page = comparison_files.write(table, folder, _command(name, choice, smoke))
    if not table.measured:
        kind = "finished smoke cell" if smoke else "finished cell"
        typer.echo(f"no {kind} in '{runs}' belongs to table '{name}': published rows only")
    typer.echo(str(page))


def _command(name: str, choice: Choice | None, smoke: bool) -> str:
    """How to write it again."""
    if choice is None:
        return shlex.join(["mtl-bench", "report", "--table", name, *["--smoke"] * smoke])
    return choice.command.replace("ablate", f"report --table {name}", 1)


def _stored(runs: Path) -> list[dict[str, Any]]:
    """The rows of all finished cells, with the status of today."""
    from mtl_bench.bench import results

    found = []
    for path in sorted(runs.glob("*/row.json")):
        row = results.load_row(path.parent) or {}
        state = results.state_of(row, results.load_cell(path.with_name("cell.json")))
        found.append({**row, "status": state.word, "error": state.why})
    return found
