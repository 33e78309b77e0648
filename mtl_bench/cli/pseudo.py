"""`pseudo-label`: labels for frames that no human labelled, from a trained cell."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import PseudoLabels


def register(app: typer.Typer) -> None:
    app.command(
        "pseudo-label",
        rich_help_panel="One cell",
        epilog="Example: mtl-bench pseudo-label --checkpoint runs/NAME --data DIR --out labels",
    )(pseudo_label)


def pseudo_label(
    checkpoint: Annotated[
        Path, typer.Option(metavar="RUN|CHECKPOINT", help="A folder in runs/, or its last.pt.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Where the labels go, in Cityscapes' format; a run that was stopped goes on. "
            "KITTI's go beside its images without this.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(metavar="NAME", help="Whose frames; of KITTI also: all.")
    ] = "train",
    scales: Annotated[
        str | None,
        typer.Option(
            metavar="X,X,...",
            help="Sizes of the input to average over, 1 = the recipe's, or of KITTI the frame's "
            "own; in place of the recipe's.",
            show_default=False,
        ),
    ] = None,
    flip: Annotated[
        bool | None,
        typer.Option(
            "--flip/--no-flip",
            help="Average over mirror images, too; in place of the recipe's.",
            show_default=False,
        ),
    ] = None,
    min_confidence: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Leave pixels unlabeled whose class is less probable; in place of the recipe's.",
            show_default=False,
        ),
    ] = None,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Label the frames of Cityscapes' sequences that no human labelled, or KITTI's, with a network
    that was trained on Cityscapes. No label is overwritten."""
    from mtl_bench.bench import results

    if not checkpoint.exists():
        raise ValueError(f"no run or checkpoint '{checkpoint}'")
    weights = checkpoint / "last.pt" if checkpoint.is_dir() else checkpoint
    cell = results.load_cell(weights.parent / "cell.json")
    chosen = _options(cell.recipe.pseudo, scales, flip, min_confidence)
    cell = replace(cell, recipe=replace(cell.recipe, pseudo=chosen))
    root = o.any_root(cell, data, quiet)

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    from mtl_bench.bench.stored import load_model
    from mtl_bench.core.device import Engine, choose_device
    from mtl_bench.evaluate import pseudo_labels

    engine = Engine(choose_device(device.value), cell.recipe.optim.precision)
    model = load_model(cell, weights, engine)
    counts: list[int] = []  # frames that have labels: at the start, and after each
    columns = ("labelling frames", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as bar:
        task = bar.add_task("")

        def show(done: int, total: int) -> None:
            counts.append(done)
            bar.update(task, completed=done, total=total)

        folder = pseudo_labels.ensure(model, cell, root, out, engine.device, show, split)
    if not quiet:
        written = counts[-1] - counts[0]
        typer.echo(f"{written} frames written, {counts[0]} there already: {folder}")


def _options(
    recipe: PseudoLabels, scales: str | None, flip: bool | None, min_confidence: float | None
) -> PseudoLabels:
    """The recipe's options with those that were given.

    Raises:
        ValueError: scales that are no numbers.
    """
    try:
        factors = recipe.scales if scales is None else tuple(map(float, scales.split(",")))
    except ValueError:
        raise ValueError(f"--scales '{scales}' is not numbers, such as 0.5,1,2") from None
    return PseudoLabels(
        scales=factors,
        flip=recipe.flip if flip is None else flip,
        min_confidence=recipe.min_confidence if min_confidence is None else min_confidence,
    )
