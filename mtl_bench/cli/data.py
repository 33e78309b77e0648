"""`data synthetic` and `data check`; `data cache` has a file of its own."""

import re
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli.cache import cache
from mtl_bench.core import config
from mtl_bench.data import layouts

if TYPE_CHECKING:
    from mtl_bench.data.check import Report
    from mtl_bench.data.check_kitti import KittiReport


class Layout(StrEnum):
    cityscapes = "cityscapes"
    kitti = "kitti"


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
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
    """Render seeded street scenes in Cityscapes' layout or KITTI's."""
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
        layout=layouts.KITTI if layout is Layout.kitti else layouts.CITYSCAPES,
    )
    typer.echo(str(out))


def check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Root of the data set.")],
    deep: Annotated[bool, typer.Option("--deep", help="Decode every file, too.")] = False,
) -> None:
    """Report what a data set holds, Cityscapes' or KITTI's, against what was published, everything
    that is wrong with it, and which recipes it can run; exit code 1 if anything is wrong."""
    from mtl_bench.data.check import check as check_cityscapes
    from mtl_bench.data.check_kitti import check_kitti

    if layouts.layout_of(folder) == layouts.KITTI:
        kitti = check_kitti(folder, deep)
        lines, problems = [*kitti.summary(), *_kitti_recipes(kitti)], len(kitti.problems)
    else:
        report = check_cityscapes(folder, deep=deep)
        lines, problems = [*report.summary(), *_cityscapes_recipes(report)], len(report.problems)
    for line in lines:
        typer.echo(line)
    if problems:
        raise typer.Exit(1)


def _recipes(datasets: tuple[str, ...]) -> Iterator[config.Recipe]:
    recipes = map(config.load_recipe, config.recipe_names())
    return (recipe for recipe in recipes if recipe.data.dataset in datasets)


def _kitti_recipes(report: "KittiReport") -> Iterator[str]:
    """What stands between a tree and the recipes for it, task by task."""
    from mtl_bench.tasks.depth import protocols

    for recipe in _recipes(("synthetic-kitti" if report.own_lists else "kitti",)):
        ev, data = recipe.evaluate, recipe.data
        truths = [protocols.named(name, data.dataset).truth for name in (ev.protocol, *ev.also)]
        for task in config.TASKS:
            why = report.obstacle(task, data.train_frames, truths)
            yield f"recipe {recipe.name}, {task}: {why or 'ready'}"


def _cityscapes_recipes(report: "Report") -> Iterator[str]:
    from mtl_bench.tasks.depth import protocols

    for recipe in _recipes(("cityscapes",)):
        ev, data = recipe.evaluate, recipe.data
        also = [protocols.named(name, data.dataset) for name in ev.also]
        if report.size < (data.height, data.width):
            own = "{}x{}".format(*report.size)
            yield f"recipe {recipe.name}: frames of {own} are smaller than its input"
            continue
        for task in config.TASKS:
            found = [report.obstacle(f"{task} {part}") for part in ("training", "evaluation")]
            if task == "depth":
                found += [
                    f"protocol {protocol.name}: no disparity/{protocol.split}"
                    for protocol in also
                    if not (report.root / "disparity" / protocol.split).is_dir()
                ]
            why = next(filter(None, found), "ready")
            yield f"recipe {recipe.name}, {task}: {why}"
        stage = f"{report.unlabelled} frames to label" if report.unlabelled else "no frame to label"
        yield f"recipe {recipe.name}, --video: {stage}"
