"""`data synthetic` and `data check`; `data cache` has a file of its own."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.cli.cache import cache
from mtl_bench.cli.help import App
from mtl_bench.core import config


class Layout(StrEnum):
    cityscapes = "cityscapes"
    kitti = "kitti"
    nyuv2 = "nyuv2"
    cityscapes_mtan = "cityscapes-mtan"


def register(app: typer.Typer) -> None:
    group = App()
    group.command(epilog="Example: mtl-bench data synthetic --out scenes --size 128x256")(synthetic)
    group.command(epilog="Example: mtl-bench data check scenes --deep")(check)
    group.command(epilog="Example: mtl-bench data cache --recipe cityscapes --data DIR")(cache)
    app.add_typer(
        group,
        name="data",
        help="Render the built-in scenes; check a data set.",
        rich_help_panel="Around",
        epilog="Example: mtl-bench data check scenes",
    )


def synthetic(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the data set goes.")],
    size: Annotated[str, typer.Option(metavar="HxW", help="Pixels.")] = "64x128",
    scenes: Annotated[int, typer.Option(metavar="N", help="In the training split.")] = 800,
    val_scenes: Annotated[int, typer.Option(metavar="N", help="In the validation split.")] = 100,
    test_scenes: Annotated[int, typer.Option(metavar="N", help="In the test split.")] = 8,
    seed: Annotated[int, typer.Option(help="Which world.")] = 0,
    frames: Annotated[int, typer.Option(help="Of each scene's video, odd; 30 as Cityscapes.")] = 3,
    layout: Annotated[Layout, typer.Option(help="How the files lie.")] = Layout.cityscapes,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Render seeded street scenes in the layout of a data set."""
    height, width = o.size(size)
    from mtl_bench.data import scenes as scene_writer
    from mtl_bench.data.scenes.settings import CITYSCAPES, CITYSCAPES_ARRAYS, KITTI, NYUV2

    layouts = {
        Layout.cityscapes: CITYSCAPES,
        Layout.kitti: KITTI,
        Layout.nyuv2: NYUV2,
        Layout.cityscapes_mtan: CITYSCAPES_ARRAYS,
    }
    scene_writer.write(
        out,
        height,
        width,
        scenes,
        val_scenes,
        test_scenes,
        seed,
        frames=frames,
        progress=not quiet,
        layout=layouts[layout],
    )
    typer.echo(str(out))


def check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Root of the data set.")],
    deep: Annotated[bool, typer.Option("--deep", help="Decode every file, too.")] = False,
    plugins: o.PluginsOption = None,
) -> None:
    """Report what a data set holds against what was published, everything that is wrong with it,
    and which recipes it can run; exit code 1 if anything is wrong."""
    from mtl_bench.core.dataset import dataset_in, dataset_of
    from mtl_bench.core.task import tasks_of

    kind = dataset_in(folder)
    if kind is None:
        raise ValueError(o.no_data_set_in(folder))
    report = kind.check(folder, deep)
    lines = report.summary()
    for recipe in map(config.load_recipe, config.recipe_names()):
        if recipe.data.dataset == report.dataset:
            tasks = tasks_of(recipe, recipe.tasks, dataset_of(recipe).labels)
            lines += report.recipe_lines(recipe, tasks)
    for line in lines:
        typer.echo(line)
    if report.problems:
        raise typer.Exit(1)
