"""`collect`: results of several machines in one runs folder, or in one file."""

from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.cli import options as o


def register(app: typer.Typer) -> None:
    app.command(
        rich_help_panel="A grid of cells",
        epilog="Example: mtl-bench collect /mnt/other/runs rows.xz",
    )(collect)


def collect(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DIR|FILE...",
            help="Runs folders, and files that --pack has written.",
            show_default=False,
        ),
    ] = None,
    weights: Annotated[
        bool, typer.Option("--weights", help="Of runs folders take checkpoints, too.")
    ] = False,
    failures: Annotated[
        bool,
        typer.Option(
            "--failures", help="Cells that failed, too; a tuned grid counts them as worst trials."
        ),
    ] = False,
    stale: Annotated[
        bool,
        typer.Option(
            "--stale", help="Rows that other code made, too; stale here as there, as reports say."
        ),
    ] = False,
    pack: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.xz",
            help="Write the rows in --runs, or --grid's, as one file in place of collecting.",
            show_default=False,
        ),
    ] = None,
    curves: Annotated[
        bool,
        typer.Option("--curves", help="Pack training curves, too; a hundred times the size."),
    ] = False,
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid",
            metavar="NAME|FILE",
            help="Pack its jobs, and those that they need, only.",
            show_default=False,
        ),
    ] = None,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    runs: o.RunsOption = Path("runs"),
    plugins: o.PluginsOption = None,
) -> None:
    """Put results of several machines together: rows, curves and timings by the code of today.

    What is here already and good stays as it is; what was left out is told, by reason. Without
    their weights rows are good for reports, but not for evaluation, prediction or export.
    """
    from mtl_bench.bench import collect as collecting
    from mtl_bench.cli.grid import Choice

    of_a_grid = {"--recipe": recipe, "--seeds": seeds, "--smoke": smoke, "--set": settings}
    for option, value in {**of_a_grid, "--pretrained": pretrained}.items():
        if value and not grid:
            raise ValueError(f"{option} goes with --pack FILE.xz --grid NAME: it says which jobs")
    if pack is None:
        if not sources:
            raise ValueError("nothing to collect: name runs folders or packs, or --pack FILE.xz")
        for option, value in (("--grid", grid), ("--curves", curves)):
            if value:
                raise ValueError(f"{option} goes with --pack FILE.xz")
        missing = next((source for source in sources if not source.exists()), None)
        if missing is not None:
            raise ValueError(f"no runs folder or pack '{missing}'")
        taken, left = collecting.collect(sources, runs, weights, failures, stale)
        typer.echo(f"collected {taken} into {runs}")
    else:
        if sources or weights:
            word = "--weights" if weights else f"'{(sources or [])[0]}'"
            raise ValueError(f"{word} does not go with --pack, which packs what is in --runs")
        choice = Choice(grid, recipe, seeds, smoke, settings, pretrained) if grid else None
        jobs = None if choice is None else choice.needed(runs)
        packed, left = collecting.pack(pack, runs, jobs, curves, failures, stale)
        typer.echo(f"packed {packed} of {runs} in {pack}, {pack.stat().st_size / 1024:.0f} KiB")
    for line in collecting.told(left):
        typer.echo(line)
