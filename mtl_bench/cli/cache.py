"""`data cache`: decode a data set's frames once instead of in every epoch."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import Cell, load_recipe

if TYPE_CHECKING:
    from mtl_bench.data.frame_cache import FrameCache, Source


def cache(
    recipe: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="Whose frames, and at which size.")
    ],
    data: o.DataOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Where the cache goes: frame_cache/ in the data set without this, where cells "
            "look for it. Elsewhere they find it by MTL_BENCH_FRAME_CACHE=DIR.",
            show_default=False,
        ),
    ] = None,
    tasks: Annotated[
        str | None,
        typer.Option(
            help="Whose files, separated by commas; some need no labels. Without it the recipe's.",
            show_default=False,
        ),
    ] = None,
    quiet: o.QuietOption = False,
) -> None:
    """Write down the decoded and shrunk frames of a recipe's training and evaluation splits, so
    that training need not wait for its images. Says first what that takes; goes on where it was
    stopped, and decodes again what has changed. Results are the same with and without."""
    cell = Cell(load_recipe(recipe), backbone="", method="", tasks=o.names(tasks))
    root = o.data_root(cell, data, quiet)
    frames, sources = _sources(cell, root, out)

    from mtl_bench.data import frame_cache

    missing = [source for source in sources if frames.lacks(source[0])]
    if not quiet:
        gigabytes = frame_cache.needed_bytes(frames, sources) / 1e9
        there = len(sources) - len(missing)
        typer.echo(f"{_counted(sources)} at {frames.folder.name}: {gigabytes:.2f} GB")
        typer.echo(f"in {frames.folder}, {there} there already")
    frame_cache.check_space(frames, missing)
    _build(frames, missing, quiet)
    if not quiet:
        if out is not None:
            typer.echo(f"set {frame_cache.PLACE}={out.resolve()} where cells run")
        typer.echo(f"{len(missing)} files written")


def _sources(cell: Cell, root: Path, out: Path | None) -> tuple["FrameCache", list["Source"]]:
    """The cache of the data set, and the files for it."""
    from mtl_bench.core.recipe import NOTHING
    from mtl_bench.core.task import tasks_of_cell
    from mtl_bench.data.samples import open_samples

    recipe, tasks = cell.recipe, tasks_of_cell(cell)
    split = recipe.evaluate.split
    training = open_samples(recipe, tasks, "train", root, training=True).dataset
    sources = training.sources()
    if split != NOTHING:
        sources += open_samples(recipe, tasks, split, root, training=False).dataset.sources()
    frames = training.on_disk if out is None else training.on_disk.at(out.resolve())
    return frames, list(dict.fromkeys(sources))


def _build(frames: "FrameCache", sources: list["Source"], quiet: bool) -> None:
    if not sources:
        return
    from mtl_bench.data import frame_cache

    with o.bar("decoding frames", quiet) as bar:
        task = bar.add_task("", total=len(sources))
        for done in frame_cache.build(frames, sources):
            bar.update(task, completed=done)


def _counted(sources: list["Source"]) -> str:
    counts = Counter(content.what for _, content in sources)
    return " and ".join(f"{count} {what}s" for what, count in counts.items())
