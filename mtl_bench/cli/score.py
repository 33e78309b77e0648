"""`score`: the metrics of predictions that were made elsewhere."""

import json
from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.cli import options as o


def register(app: typer.Typer) -> None:
    app.command(
        rich_help_panel="One cell",
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
        epilog="Example: mtl-bench score --panoptic DIR --depth DIR --data DATA",
    )(score)


def score(
    context: typer.Context,
    split: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="In place of the recipe's.", show_default=False),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Whose data set and protocols; without it the one called as the data set.",
            show_default=False,
        ),
    ] = None,
    settings: o.SetOption = None,
    data: o.DataOption = None,
    plugins: o.PluginsOption = None,
) -> None:
    """Score predictions that were made elsewhere, and print the metrics as JSON.

    --TASK DIR, for each task that has some: a file a frame, named as the frame or its image, such
    as NAME_instanceIds.png (16 bits), NAME_depth.png (16 bits, 1/256 m) or NAME.npy.
    """
    from mtl_bench.core import dataset
    from mtl_bench.core.config import Cell, load_recipe, override
    from mtl_bench.evaluate.score import score as scored

    if recipe is None:
        found = dataset.dataset_in(data) if data is not None else None
        recipe = found.name if found is not None else "small"
    cell = override(Cell(load_recipe(recipe), backbone="", method=""), settings or [])
    folders = _folders(context.args)
    root = o.data_root(cell, data)
    evaluation = scored(cell.recipe, folders, root, split)
    typer.echo(json.dumps(evaluation.metrics, indent=1))


def _folders(words: list[str]) -> dict[str, Path]:
    """`--TASK DIR` or `--TASK=DIR`, any number of them, by task."""
    from mtl_bench.core.plugins import files

    parts = [
        part for word in words for part in (word.split("=", 1) if "--" in word[:2] else [word])
    ]
    names, folders = parts[::2], parts[1::2]
    for name in names:
        if name.removeprefix("--") not in files("tasks") or not name.startswith("--"):
            raise ValueError(
                f"'{name}' is no option and no task with -- before it: see score --help"
            )
    if not names or len(names) != len(folders):
        raise ValueError(
            "say where predictions are: --TASK DIR, with a task of mtl-bench list tasks"
        )
    return {name.removeprefix("--"): Path(f) for name, f in zip(names, folders, strict=True)}
