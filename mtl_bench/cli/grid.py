"""`ablate`, `status` and `report`: a grid of cells."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mtl_bench.cli import latency_grid, tables, trivial
from mtl_bench.cli import options as o
from mtl_bench.cli.choice import Choice
from mtl_bench.core.config import Cell

if TYPE_CHECKING:
    from mtl_bench.bench.grid import Grid


class Rerun(StrEnum):
    stale = "stale"
    failed = "failed"
    all = "all"
    latency = "latency"


def register(app: typer.Typer) -> None:
    panel = "A grid of cells"
    app.command(
        rich_help_panel=panel,
        epilog="Example: mtl-bench ablate --grid backbones --seeds 3 --jobs 2",
    )(ablate)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench status --grid backbones")(status)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench report --grid backbones")(report)


def ablate(
    grid: o.GridOption,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run, and run nothing.")
    ] = False,
    jobs: Annotated[
        int,
        typer.Option("--jobs", metavar="N", min=1, help="Cells at a time; they share the cores."),
    ] = 1,
    rerun: Annotated[
        Rerun | None,
        typer.Option(
            "--rerun",
            help="stale: of cells whose code has changed, run again what it concerns: training, "
            "evaluation, latency. failed: begin failed ones at step "
            "0, not at their checkpoint. all: run every cell again. latency: only time them again.",
            show_default=False,
        ),
    ] = None,
    data: o.DataOption = None,
    runs: o.RunsOption = Path("runs"),
    reports: o.ReportsOption = Path("reports"),
    device: o.DeviceOption = o.Device.auto,
    wandb: o.WandbOption = o.Wandb.off,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Run what a grid still lacks, then write its report.

    Cells that are done are reused, interrupted and failed ones tried again; cells that others need
    run before them, be they in the grid or not. A grid of latencies takes them one at a time.
    """
    from mtl_bench.bench import launch
    from mtl_bench.core.plugins import check_cells

    choice = Choice(grid, recipe, seeds, smoke, settings, pretrained)
    if choice.is_latency:
        where = (data, runs, reports)
        latency_grid.ablate(choice, dry_run, jobs, rerun, *where, device, wandb, quiet)
        return
    chosen = choice.load()
    check_cells(chosen.cells)
    todo = launch.to_run(chosen.cells, runs, rerun)
    for cell in [] if dry_run else todo:
        o.locate(cell, data)  # a wrong folder is told at once
    if not quiet or dry_run:
        _announce(chosen, todo, runs)
    if dry_run:
        typer.echo("nothing was run (--dry-run)")
        return
    options = ["--device", device.value, "--wandb", wandb.value]
    if todo:
        _run(chosen, todo, runs, data, options, jobs, rerun, quiet)
    _baseline(chosen, data, runs, quiet, refresh=bool(todo))
    page = _write(chosen, runs, reports, choice.command)
    words = [row["status"] for row in _rows(chosen, runs)]
    bad = sum(word not in ("done", "stale") for word in words)
    if bad or not quiet:
        typer.echo(f"{len(words) - bad} of {len(words)} cells done; report: {page}")
    if bad:
        raise typer.Exit(1)


def status(
    grid: o.GridOption,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    runs: o.RunsOption = Path("runs"),
    plugins: o.PluginsOption = None,
) -> None:
    """List a grid's cells: done, stale, failed, interrupted, running or missing.

    Those that are in no row of the grid but needed by one are marked as such.
    """
    from mtl_bench.bench import launch, results
    from mtl_bench.bench.grid import with_parents
    from mtl_bench.cli.display import label

    choice = Choice(grid, recipe, seeds, smoke, settings, pretrained)
    if choice.is_latency:
        latency_grid.status(choice, runs)
        return
    chosen = choice.load()
    own, every = {cell.id for cell in chosen.cells}, with_parents(chosen.cells)
    lines = []
    for cell in every:
        state = results.inspect(cell, runs)
        about = "  ".join(filter(None, (state.why, state.headline)))
        name = chosen.names.get(cell.id, "") if cell.id in own else "(needed by another)"
        named = [name] if chosen.names or len(every) > len(own) else []
        place = str(results.run_dir(cell, runs))
        lines.append([state.word, *named, label(cell), place, about])
    for line in o.columns(lines):
        typer.echo(line)
    for skip in chosen.skips:
        typer.echo(f"  skipped: {label(skip.cell)}: {skip.why}")
    typer.echo(launch.summary(every, runs))


def report(
    grid: tables.GridOption = None,
    table: tables.TableOption = None,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    runs: o.RunsOption = Path("runs"),
    reports: o.ReportsOption = Path("reports"),
    readme: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Put the table between this file's <!-- results:GRID --> marks, too.",
            show_default=False,
        ),
    ] = None,
    plugins: o.PluginsOption = None,
) -> None:
    """Write a grid's tables, plots and page from the rows that there are."""
    if table is not None or grid is None:
        choices = (recipe, seeds, smoke, settings, pretrained)
        tables.write(table, Choice(grid, *choices) if grid else None, runs, reports, smoke)
        return
    choice = Choice(grid, recipe, seeds, smoke, settings, pretrained)
    if choice.is_latency:
        page = latency_grid.report(choice, runs, reports)
    else:
        chosen = choice.load()
        if not any("metric" in row for row in _rows(chosen, runs)):
            raise ValueError(
                f"no cell of grid '{chosen.name}' is done in '{runs}': "
                f"mtl-bench ablate --grid {grid}"
            )
        page = _write(chosen, runs, reports, choice.command)
    typer.echo(str(page))
    if readme is not None:
        from mtl_bench.report.readme import update

        update(readme, page.parent.name, page.parent)
        typer.echo(str(readme))


# --- steps ----------------------------------------------------------------------------------------


def _announce(grid: "Grid", todo: Sequence[Cell], runs: Path) -> None:
    from mtl_bench.bench import launch
    from mtl_bench.bench.grid import with_parents
    from mtl_bench.cli.display import label

    size, cells = grid.recipe.data, with_parents(grid.cells)
    counts = {axis: len(values) for axis, values in grid.axes.items()}
    counts |= {"row": len(set(grid.names.values()))} if grid.names else {}
    product = " x ".join(f"{n} {axis}{'s' * (n > 1)}" for axis, n in counts.items())
    needed = len(cells) - len(grid.cells)
    more = f" and {needed} that they need" if needed else ""
    typer.echo(f"{grid.name}: {grid.question}")
    typer.echo(
        f"{len(grid.cells)} cells{more} = {product}, less {len(grid.skips)} skipped; recipe "
        f"{grid.recipe.name} ({size.dataset}, {size.height}x{size.width}, "
        f"{grid.recipe.optim.steps} steps)"
    )
    hours = launch.hours_to_run(todo, cells, runs)
    about = "" if hours is None or not todo else f"   about {hours:.1f} hours one after another"
    typer.echo(f"  {launch.summary(cells, runs)}   to run {len(todo)}{about}")
    for skip in grid.skips:
        typer.echo(f"  skipped: {label(skip.cell)}: {skip.why}")


def _run(
    grid: "Grid",
    todo: Sequence[Cell],
    runs: Path,
    data: Path | None,
    options: list[str],
    jobs: int,
    rerun: str | None,
    quiet: bool,
) -> None:
    """Render what is missing first, once, so that cells side by side find it; then run them."""
    from mtl_bench.bench import launch
    from mtl_bench.cli import display

    roots = {cell.recipe.data: o.data_root(cell, data, quiet) for cell in todo}
    passed_on = [*options, *(["--quiet"] if quiet else [])]

    def command(cell: Cell) -> list[str]:
        return launch.cell_command(cell, runs, roots[cell.recipe.data], passed_on)

    with display.choose(len(todo), quiet) as shown:
        launch.Launcher(runs, command, shown, jobs, rerun, grid.names).run(todo)


def _rows(grid: "Grid", runs: Path) -> list[dict[str, Any]]:
    """One row a cell, with its deltas to the stored row of its baseline."""
    from mtl_bench.bench import results

    rows = results.rows(grid.cells, runs, grid.names)
    if not grid.baseline:
        return rows
    from mtl_bench.bench.grid import baseline_cell
    from mtl_bench.report.delta import with_delta

    cells = {cell.id: cell for cell in grid.cells}

    def baseline_of(row: Mapping[str, Any]) -> dict[str, Any] | None:
        cell = baseline_cell(cells[row["cell_id"]], grid.baseline)
        stored = results.rows([cell], runs)[0]
        return stored if "metric" in stored else None

    return with_delta(rows, baseline_of)


def _write(grid: "Grid", runs: Path, reports: Path, command: str) -> Path:
    from mtl_bench import report as reporting

    file = trivial.file_of(grid, runs)
    baseline = json.loads(file.read_text()) if file is not None and file.is_file() else None
    return reporting.build(
        grid,
        _rows(grid, runs),
        reports / grid.name,
        runs_root=runs,
        baseline=baseline,
        command=command,
    )


def _baseline(
    grid: "Grid", data: Path | None, runs: Path, quiet: bool, refresh: bool = False
) -> None:
    """Measure the trivial predictors on the grid's data set (`baselines` keeps what it did once).

    Not refreshed when no cell ran: then the numbers beside them are the old ones, too.
    """
    from mtl_bench.bench import results

    file = trivial.file_of(grid, runs)
    if file is None or (file.is_file() and not refresh):
        return
    from mtl_bench.evaluate.trivial import baselines

    file.parent.mkdir(parents=True, exist_ok=True)
    root = o.data_root(grid.cells[0], data, quiet)
    cell = replace(grid.cells[0], tasks=trivial.tasks_of(grid), video=False, single_task=False)
    results.write_json(file, baselines(cell, root, file.parent).metrics)
