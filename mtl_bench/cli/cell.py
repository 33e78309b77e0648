"""`train` and `evaluate`: one cell."""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import (
    GRANULARITIES,
    Cell,
    check_cells,
    load_recipe,
    override,
    set_values,
)
from mtl_bench.core.ranks import Processes, check_share, joined

if TYPE_CHECKING:
    from mtl_bench.show.predict.cameras import Given


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
            metavar="CELL.JSON",
            help="A cell that was run before, to run exactly it again; the options below that name "
            "a cell do not apply then.",
            show_default=False,
        ),
    ] = None,
    recipe: Annotated[str, typer.Option(metavar="NAME|FILE", help="How to train.")] = "small",
    backbone: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="See `list`; without it the recipe's, where it has one.",
            show_default=False,
        ),
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="See `list`.", show_default=False)
    ] = None,
    tasks: Annotated[
        str | None,
        typer.Option(help="Separated by commas; without it the recipe's.", show_default=False),
    ] = None,
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
    continued: Annotated[
        Path | None,
        typer.Option(
            "--continue",
            metavar="RUN",
            help="Train that cell's checkpoint on, as a cell of its own: with its recipe, but for "
            "--set recipe.optim.steps=..., recipe.optim.lr=..., backbone.frozen=all|stem. "
            "Optimiser and learning rate begin anew.",
            show_default=False,
        ),
    ] = None,
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
    camera: o.CameraOption = None,
    calib: o.CalibOption = None,
    fx: o.PixelsOption = None,
    fy: o.PixelsOption = None,
    cx: o.PixelsOption = None,
    cy: o.PixelsOption = None,
    camera_height: o.HeightOption = None,
    runs: o.RunsOption = Path("runs"),
    device: o.DeviceOption = o.Device.auto,
    ranks: o.RanksOption = None,
    wandb: o.WandbOption = o.Wandb.off,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Train one cell, evaluate it, time it, and write its row.

    What it needs is run before: of --video the cell without it, of --single-task one for each task.
    Depth also trains on a plain video and its camera, --data VIDEO.mp4 --fx ...: nothing is
    measured then, as there is no truth. The processes of torchrun, or of an srun of several tasks,
    train the cell together, as with --ranks; see docs/clusters.md.
    """
    with joined(ranks) as joint:
        if isinstance(joint, Processes) and not joint.first:
            from mtl_bench.bench.run import follow

            follow(joint, device.value)
            return
        if continued is not None:
            named: dict[str, object] = {
                **{"CELL.JSON": cell_file, "--backbone": backbone, "--method": method},
                **{"--tasks": tasks, "--seed": seed, "--video": video, "--pretrained": pretrained},
                **{"--single-task": single_task, "--recipe": recipe != "small"},
                "--granularity": granularity != GRANULARITIES[0],
            }
            for option in (option for option, value in named.items() if value):
                raise ValueError(
                    f"{option} does not go with --continue, which takes RUN's: use --set"
                )
            cell = _continuing(continued, runs)
        elif cell_file is not None:
            from mtl_bench.bench.jobs import load_cell

            cell = load_cell(cell_file)
        else:
            chosen = load_recipe(recipe)
            backbone = backbone or chosen.backbone
            if not backbone or method is None:
                raise ValueError(
                    "say which cell: --backbone NAME and --method NAME, or a cell.json"
                )
            if tasks is not None and not o.names(tasks):
                raise ValueError("a cell needs a task: --tasks NAME,NAME")
            weights = o.weights(pretrained)
            cell = Cell(
                chosen,
                backbone,
                method,
                o.names(tasks),
                seed,
                video=video,
                single_task=single_task,
                granularity=granularity,
                pretrained=weights,
            )
        given = o.given_camera(camera, calib, (fx, fy, cx, cy), camera_height)
        if data is not None and data.is_file():
            cell, data = _filmed(cell, data, given, quiet)
        elif given != type(given)():
            raise ValueError(
                "--camera, --calib, --fx ... are for --data VIDEO: a data set has its own"
            )
        cell = override(cell, settings or [])
        if latency:
            _time_again(cell, data, runs, device.value, quiet)
            return
        from mtl_bench.bench import launch, store
        from mtl_bench.bench.data_state import Data

        check_cells([cell])
        check_share(cell.recipe.optim, joint.size)
        there = Data(o.locate(cell, data))
        if not rerun and (line := store.done_already(cell, runs, stale, there)):
            typer.echo(line)
            return
        root = o.data_root(cell, data, quiet)
        here = launch.Here(runs, root, device.value, wandb.value, o.echo(quiet), there, joint)
        here.run(cell, rerun, stale)


def _filmed(cell: Cell, video: Path, given: "Given", quiet: bool) -> tuple[Cell, Path]:
    """A cell that trains on a video, and the folder that its frames are in."""
    from mtl_bench.data import filmed
    from mtl_bench.data.video import Reader
    from mtl_bench.show.predict.cameras import camera_of

    camera = camera_of(video, Reader(video).size, given)
    if camera.guessed:
        raise ValueError(
            f"{video}: training on a video takes its camera's intrinsics: give --fx --fy --cx "
            f"--cy, --calib or --camera"
        )
    with o.bar("decoding frames", quiet) as bar:

        def show(done: int, of: int) -> None:
            task = bar.task_ids[0] if bar.task_ids else bar.add_task("")
            bar.update(task, completed=done, total=of or None)

        root = filmed.tree_of(video, camera, progress=show)
    return set_values(cell, filmed.SETTINGS), root


def _continuing(run: Path, runs: Path) -> Cell:
    """A cell that goes on from a run's, so far with the same recipe."""
    from mtl_bench.bench import store
    from mtl_bench.bench.jobs import load_run

    start, checkpoint = load_run(run)
    expected = store.run_dir(start, runs)
    if checkpoint.parent.resolve() != expected.resolve():
        raise ValueError(f"--continue {run} is not '{expected}': say where it is with --runs")
    return replace(start, continues=start, video=False)


def _time_again(cell: Cell, data: Path | None, runs: Path, device: str, quiet: bool) -> None:
    """Measure a finished cell's latency anew."""
    from mtl_bench.bench import store
    from mtl_bench.core.locks import claim

    directory = store.run_dir(cell, runs)
    if store.stored(cell, runs).row is None:
        raise ValueError(f"no latency to take again: {directory} has no row.json yet")
    root = o.data_root(cell, data, quiet)
    with claim(directory):
        from mtl_bench.bench import stored

        stored.time_again(cell, directory, root, device, o.echo(quiet))


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
    from mtl_bench.bench.jobs import load_run

    cell, checkpoint = load_run(what)
    root = o.data_root(cell, data)
    from mtl_bench.bench.stored import reevaluate

    evaluation = reevaluate(cell, checkpoint, root, device.value, split, export)
    typer.echo(json.dumps(evaluation.metrics, indent=1))
