"""`train` and `evaluate`: one cell."""

import contextlib
import json
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import GRANULARITIES, TASKS, Cell, load_recipe, override


def register(app: typer.Typer) -> None:
    panel = "One cell"
    app.command(
        rich_help_panel=panel,
        epilog="Example: mtl-bench train --backbone NAME --method NAME --set recipe.optim.lr=3e-4",
    )(train)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench evaluate runs/NAME --split val")(
        evaluate
    )


def train(
    cell_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[CELL.JSON]",
            help="A cell that was run before, to run exactly it again; the options below that name "
            "a cell do not apply then.",
            show_default=False,
        ),
    ] = None,
    recipe: Annotated[str, typer.Option(metavar="NAME|FILE", help="How to train.")] = "small",
    backbone: Annotated[
        str | None, typer.Option(metavar="NAME", help="See `list`.", show_default=False)
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="See `list`.", show_default=False)
    ] = None,
    tasks: Annotated[str, typer.Option(help="Separated by commas.")] = ",".join(TASKS),
    seed: Annotated[int, typer.Option(help="Of initial weights, data order and method.")] = 0,
    video: Annotated[
        bool,
        typer.Option(
            "--video",
            help="Then train on, with pseudo labels for the frames of the sequences, too.",
        ),
    ] = False,
    single_task: Annotated[
        bool,
        typer.Option("--single-task", help="A network for each task, evaluated side by side."),
    ] = False,
    granularity: Annotated[
        str,
        typer.Option(
            metavar="|".join(GRANULARITIES),
            help="What the method weighs: loss terms, or tasks as sums of them at fixed weights.",
        ),
    ] = GRANULARITIES[0],
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Forget its earlier result or checkpoint.")
    ] = False,
    latency: Annotated[
        bool,
        typer.Option("--latency", help="Of a cell that is done, only take the latency again."),
    ] = False,
    stale: Annotated[
        bool,
        typer.Option(
            "--stale", help="Of a cell that is done, run again only what changed code concerns."
        ),
    ] = False,
    data: o.DataOption = None,
    runs: o.RunsOption = Path("runs"),
    device: o.DeviceOption = o.Device.auto,
    wandb: o.WandbOption = o.Wandb.off,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Train one cell, evaluate it, time it, and write its row.

    What it needs is run before: of --video the cell without it, of --single-task one for each task.
    """
    if cell_file is not None:
        from mtl_bench.bench import results

        cell = results.load_cell(cell_file)
    else:
        if backbone is None or method is None:
            raise ValueError("say which cell: --backbone NAME and --method NAME, or a cell.json")
        names = tuple(word.strip() for word in tasks.split(",") if word.strip())
        weights = o.weights(pretrained)
        cell = Cell(
            load_recipe(recipe),
            backbone,
            method,
            names,
            seed,
            video=video,
            single_task=single_task,
            granularity=granularity,
            pretrained=weights,
        )
    cell = override(cell, settings or [])
    if latency:
        time_again(cell, data, runs, device.value, quiet)
    else:
        run(cell, data, runs, device.value, wandb.value, rerun, quiet, stale)


def time_again(cell: Cell, data: Path | None, runs: Path, device: str, quiet: bool) -> None:
    """Measure a finished cell's latency anew."""
    from mtl_bench.bench import claim, launch, results

    directory = results.run_dir(cell, runs)
    if results.stored(cell, runs).row is None:
        raise ValueError(f"no latency to take again: {directory} has no row.json yet")
    root = o.data_root(cell, data, quiet)
    try:
        with claim.claim(directory):
            from mtl_bench.bench import stored

            stored.time_again(cell, directory, root, device, o.echo(quiet))
    except claim.ClaimedError as error:
        typer.echo(f"mtl-bench: {error}", err=True)
        raise typer.Exit(launch.CLAIMED) from None


def run(
    cell: Cell,
    data: Path | None,
    runs: Path,
    device: str,
    wandb: str,
    rerun: bool,
    quiet: bool,
    stale: bool = False,
) -> None:
    """Run what is left of a cell, after the cells that it needs."""
    from mtl_bench.bench import results
    from mtl_bench.bench.grid import with_parents
    from mtl_bench.cli.display import label
    from mtl_bench.core import plugins

    plugins.check_cells([cell])
    if not rerun and _done_already(cell, runs, stale):
        return
    root = o.data_root(cell, data, quiet)
    echo = o.echo(quiet)

    for parent in with_parents(cell.parents):
        state = results.inspect(parent, runs)
        if state.word == "stale" and not state.trained:
            again = f"mtl-bench train {results.run_dir(parent, runs)}/cell.json --stale"
            raise ValueError(f"a cell that this one needs is stale, {state.why}: {again}")
        if not state.trained:
            echo(f"{label(cell)} needs {label(parent)} first")
            _run_claimed(parent, runs, root, device, wandb, echo)
    _run_claimed(cell, runs, root, device, wandb, echo, rerun, stale)


def _run_claimed(
    cell: Cell,
    runs: Path,
    root: Path,
    device: str,
    wandb: str,
    echo: Any,
    rerun: bool = False,
    stale: bool = False,
) -> None:
    """Claim a cell and run it; a failure is written down before it is raised."""
    from mtl_bench.bench import claim, launch, results

    directory = results.run_dir(cell, runs)
    try:
        with claim.claim(directory):
            if rerun:
                results.clear(directory)
            elif _done_already(cell, runs, stale):  # by another process, in the meantime
                return
            renewed = stale and results.can_renew(cell, runs)
            if not renewed:
                _begin(cell, runs, echo)
            with _recorded(directory):
                from mtl_bench.bench.run import renew, run_cell

                if renewed:
                    renew(cell, directory, root, device, echo)
                else:
                    run_cell(cell, directory, root, device, wandb, echo)
    except claim.ClaimedError as error:
        typer.echo(f"mtl-bench: {error}", err=True)
        raise typer.Exit(launch.CLAIMED) from None
    echo(f"{directory}/row.json")


def _begin(cell: Cell, runs: Path, echo: Any) -> None:
    from mtl_bench.bench import results

    state = results.stored(cell, runs)
    if state.word == "stale":
        echo(results.set_aside(results.run_dir(cell, runs), state.why))
    if line := results.begin(cell, runs)[1]:
        echo(line)


def _done_already(cell: Cell, runs: Path, renew: bool) -> bool:
    from mtl_bench.bench import results

    state = results.stored(cell, runs)
    if state.row is None or (renew and state.word == "stale"):
        return False
    stale = f", but stale: {state.why}" if state.word == "stale" else ""
    remedy = f"{'--stale' if stale else '--rerun'} runs it again"
    row = results.run_dir(cell, runs) / "row.json"
    typer.echo(f"done already{stale} ({remedy}): {row}")
    return True


@contextlib.contextmanager
def _recorded(directory: Path) -> Iterator[None]:
    """Whatever ends a run early other than an interruption is left in `failed.json`."""
    from mtl_bench.bench import results

    (directory / "failed.json").unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        line = " ".join(f"{type(error).__name__}: {error}".split())
        results.write_failure(directory, line, traceback.format_exc())
        raise


def evaluate(
    what: Annotated[
        Path, typer.Argument(metavar="RUN|CHECKPOINT", help="A folder in runs/, or its last.pt.")
    ],
    split: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="In place of the recipe's.", show_default=False),
    ] = None,
    export: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write the panoptic predictions there, too, as Cityscapes' evaluator "
            "(csEvalPanopticSemanticLabeling) reads them.",
            show_default=False,
        ),
    ] = None,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
) -> None:
    """Evaluate a trained cell again and print its metrics as JSON; its row stays as it is."""
    from mtl_bench.bench import results

    if not what.exists():
        raise ValueError(f"no run or checkpoint '{what}'")
    directory, checkpoint = (what, what / "last.pt") if what.is_dir() else (what.parent, what)
    cell = results.load_cell(directory / "cell.json")
    root = o.data_root(cell, data)
    from mtl_bench.bench.stored import reevaluate

    evaluation = reevaluate(cell, checkpoint, root, device.value, split, export)
    typer.echo(json.dumps(evaluation.metrics, indent=1))
