"""`figure`: what a trained cell sees, for print or as a page, and how methods do on a toy."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.cli.help import App
from mtl_bench.cli.toy import toy

if TYPE_CHECKING:
    from mtl_bench.show.figures import Shown
    from mtl_bench.show.predict import Predictor

FRAMES = "Which frames"
FrameOption = Annotated[
    str | None,
    typer.Option(
        "--frame",
        metavar="NAME",
        help="A frame of the split. Without it one is drawn by seed.",
        rich_help_panel=FRAMES,
        show_default=False,
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", help="Draws frames from the split.", rich_help_panel=FRAMES)
]
SplitOption = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="train, val or test. [default: the one that the recipe evaluates on]",
        rich_help_panel=FRAMES,
        show_default=False,
    ),
]
OutOption = Annotated[
    list[Path],
    typer.Option("--out", metavar="FILE.png|FILE.pdf", help="Where it goes. Repeatable."),
]
DpiOption = Annotated[int, typer.Option("--dpi", help="Pixels an inch; the width is 7 inches.")]


def register(app: typer.Typer) -> None:
    group = App()
    group.command(epilog="Example: mtl-bench figure prediction --checkpoint runs/NAME --out a.pdf")(
        prediction
    )
    group.command(
        epilog="Example: mtl-bench figure qualitative --checkpoint runs/NAME --rows 4 --out a.png"
    )(qualitative)
    group.command(epilog="Example: mtl-bench figure cloud --checkpoint runs/NAME --out a.html")(
        cloud
    )
    group.command(epilog="Example: mtl-bench figure toy --methods fixed,mgda,nash --out toy.png")(
        toy
    )
    app.add_typer(
        group,
        name="figure",
        help="Draw predictions for print or as a 3D page, and methods on a toy.",
        rich_help_panel="One cell",
        epilog="Example: mtl-bench figure prediction --checkpoint runs/NAME --out a.pdf",
    )


def prediction(
    checkpoint: o.CheckpointOption,
    out: OutOption,
    frame: FrameOption = None,
    seed: SeedOption = 0,
    split: SplitOption = None,
    dpi: DpiOption = 300,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
) -> None:
    """One frame: input, panoptic map, depth with its scale, point cloud from a raised view."""
    from mtl_bench.show import figures

    _check(out, dpi)
    ((shown,),) = _shown([figures.load(checkpoint, device.value)], data, split, frame, seed)
    figure = figures.prediction(shown, dpi)
    for path in out:
        figures.write(figure, path)
        typer.echo(f"{path}: {shown.name}")


def qualitative(
    checkpoint: Annotated[
        list[Path],
        typer.Option(
            metavar="RUN|CHECKPOINT", help="A folder in runs/, or its last.pt. Repeatable."
        ),
    ],
    out: OutOption,
    frame: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A frame of the split. Repeatable. Without it they are drawn by seed.",
            rich_help_panel=FRAMES,
            show_default=False,
        ),
    ] = None,
    rows: Annotated[
        int, typer.Option(min=1, help="How many frames are drawn.", rich_help_panel=FRAMES)
    ] = 4,
    seed: SeedOption = 0,
    split: SplitOption = None,
    dpi: DpiOption = 300,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
) -> None:
    """Several frames in rows: input, panoptic map, depth and point cloud of one run or more."""
    from mtl_bench.show import figures

    _check(out, dpi)
    predictors = [figures.load(path, device.value) for path in checkpoint]
    found = _shown(predictors, data, split, frame or [], seed, rows)
    labels = figures.told_apart([predictor.cell for predictor in predictors])
    shown = [one for several in found for one in several]
    figure = figures.qualitative(shown, labels * len(found), dpi)
    for path in out:
        figures.write(figure, path)
        typer.echo(f"{path}: {', '.join(several[0].name for several in found)}")


def cloud(
    checkpoint: o.CheckpointOption,
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="Where the page goes.")],
    frame: FrameOption = None,
    seed: SeedOption = 0,
    split: SplitOption = None,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
) -> None:
    """One frame's point cloud as an HTML page to turn and walk through, which works offline."""
    from mtl_bench.show import figures

    if out.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out '{out}' must end in .html")
    predictor = figures.load(checkpoint, device.value)
    ((shown,),) = _shown([predictor], data, split, frame, seed)
    page = figures.cloud_page(shown, predictor.cell.slug)
    figures.write_whole(out, page.encode())
    typer.echo(f"{out}: {shown.name}, {out.stat().st_size / 1e6:.1f} MB")


def _shown(
    predictors: "list[Predictor]",
    data: Path | None,
    split: str | None,
    wanted: str | list[str] | None,
    seed: int,
    count: int = 1,
) -> "list[list[Shown]]":
    """The chosen frames, each by every run; the first run says where they are."""
    from mtl_bench.show import figures

    cell = predictors[0].cell
    files = figures.frames_in(o.any_root(cell, data), split or cell.recipe.evaluate.images)
    names = [wanted] if isinstance(wanted, str) else wanted or []
    chosen = figures.choose(list(files), names, seed, count)
    return [[figures.look(p, name, files[name]) for p in predictors] for name in chosen]


def _check(out: list[Path], dpi: int) -> None:
    """Before anything takes time.

    Raises:
        ValueError: a file of another kind, or a resolution that is none.
    """
    from mtl_bench.show.figures.printed import suffix_of

    for path in out:
        suffix_of(path)
    if not 50 <= dpi <= 1200:
        raise ValueError(f"--dpi {dpi} is not between 50 and 1200")
