"""`data synthetic` and `data check`."""

import re
from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    group.command(epilog="Example: mtl-bench data synthetic --out scenes --size 128x256")(synthetic)
    group.command(epilog="Example: mtl-bench data check scenes --deep")(check)
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
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Render seeded street scenes in Cityscapes' layout."""
    match = re.fullmatch(r"(\d+)x(\d+)", size)
    if match is None:
        raise ValueError(f"--size '{size}' is not HxW, such as 128x256")
    height, width = map(int, match.groups())
    from mtl_bench.data import synthetic as scene_writer

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
    )
    typer.echo(str(out))


def check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Root of the data set.")],
    deep: Annotated[bool, typer.Option("--deep", help="Decode every file, too.")] = False,
) -> None:
    """Report everything that is missing or wrong in a data set; exit code 1 if anything is."""
    from mtl_bench.data.check import check as check_data

    report = check_data(folder, deep=deep)
    for line in report.summary():
        typer.echo(line)
    if report.problems:
        raise typer.Exit(1)
