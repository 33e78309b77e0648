"""Options that several commands have, and what they mean."""

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.core.config import Cell
from mtl_bench.data.layouts import BUILT_IN, IMAGES, LAYOUTS, layout_of

RUNNING, GRID = "Where and how to run", "Which cells"


class Device(StrEnum):
    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Wandb(StrEnum):
    off = "off"
    offline = "offline"
    online = "online"


def _add_plugins(folders: list[Path] | None) -> list[Path] | None:
    from mtl_bench.core import plugins

    for folder in folders or []:
        plugins.add_folder(folder)
    return folders


PluginsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugins",
        metavar="DIR",
        help="More methods and backbones: a folder with methods/ and backbones/ or with the files "
        "themselves, or one file. Repeatable.",
        callback=_add_plugins,
        is_eager=True,
        show_default=False,
    ),
]
DataOption = Annotated[
    Path | None,
    typer.Option(
        "--data",
        metavar="DIR",
        help="Root of the data set, in Cityscapes' layout or KITTI raw's. Without it the built-in "
        "scenes are rendered into the user's cache on first use.",
        rich_help_panel=RUNNING,
        show_default=False,
    ),
]
RunsOption = Annotated[
    Path, typer.Option("--runs", metavar="DIR", help="Where cells run and their rows are kept.")
]
ReportsOption = Annotated[
    Path, typer.Option("--reports", metavar="DIR", help="Where a grid's tables and page go.")
]
DeviceOption = Annotated[
    Device,
    typer.Option("--device", help="auto: CUDA where there is one.", rich_help_panel=RUNNING),
]
WandbOption = Annotated[
    Wandb, typer.Option("--wandb", help="Weights & Biases tracking.", rich_help_panel=RUNNING)
]
QuietOption = Annotated[
    bool, typer.Option("--quiet", "-q", help="Say only what failed.", rich_help_panel=RUNNING)
]
PretrainedOption = Annotated[
    str | None,
    typer.Option(
        "--pretrained",
        metavar="timm|FILE",
        help="The backbone's initial weights: timm's (from the hub or its cache), or a .pth or "
        ".safetensors file. Without it they are random.",
        show_default=False,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value: recipe.optim.lr=3e-4, method.init=0.5. Repeatable.",
        show_default=False,
    ),
]
GridOption = Annotated[
    str, typer.Option("--grid", metavar="NAME|FILE", help="A grid's name, or a .toml of your own.")
]
RecipeOption = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        metavar="NAME|FILE",
        help="In place of the grid's recipe.",
        rich_help_panel=GRID,
        show_default=False,
    ),
]
SeedsOption = Annotated[
    int | None,
    typer.Option(
        "--seeds",
        metavar="N",
        help="Seeds 0 to N-1 in place of the grid's.",
        rich_help_panel=GRID,
        show_default=False,
    ),
]
SmokeOption = Annotated[
    bool,
    typer.Option(
        "--smoke",
        help="Seconds a cell, on tiny data: shows that all runs. Its rows are marked and reported "
        "apart.",
        rich_help_panel=GRID,
    ),
]


def echo(quiet: bool) -> Callable[[str], None]:
    """Prints a line, or does not."""
    return (lambda line: None) if quiet else typer.echo


def weights(pretrained: str | None) -> str | None:
    """`--pretrained` as a cell holds it: a file by its full path, as cells run from anywhere.

    Raises:
        ValueError: neither `timm` nor a file.
    """
    if pretrained in (None, "timm"):
        return pretrained
    path = Path(str(pretrained)).expanduser().resolve()
    if not path.is_file():
        raise ValueError(f"no weights file '{pretrained}'; --pretrained takes 'timm' or a file")
    return str(path)


def locate(cell: Cell, data: Path | None) -> Path | None:
    """Where a cell's images are; None for the built-in ones. Renders nothing.

    Raises:
        ValueError: no data set there, one in another layout than the recipe's, or a recipe for a
            data set that only `--data` can find.
    """
    name = cell.recipe.data.dataset
    if data is not None:
        layout, expected = _layout(data), LAYOUTS.get(name)
        if expected not in (None, layout):
            raise ValueError(
                f"'{data}' is in {layout}'s layout, but recipe '{cell.recipe.name}' trains on "
                f"{name}: choose another --data, --recipe or recipe.data.dataset"
            )
        return data.resolve()
    if name not in BUILT_IN:
        raise ValueError(
            f"recipe '{cell.recipe.name}' trains on {name}: say where it is, --data DIR"
        )
    return None


def any_root(cell: Cell, data: Path | None, quiet: bool = False) -> Path:
    """As `data_root`, in any layout: for what does not train.

    Raises:
        ValueError: no data set there.
    """
    if data is None:
        return data_root(cell, None, quiet)
    _layout(data)
    return data.resolve()


def _layout(data: Path) -> str:
    if not data.is_dir():
        raise ValueError(f"no data folder '{data}'")
    layout = layout_of(data)
    if layout is None:
        raise ValueError(
            f"no data set in '{data}': it has neither {IMAGES}/ (Cityscapes) nor days such as "
            f"2011_09_26/ (KITTI raw)"
        )
    return layout


def data_root(cell: Cell, data: Path | None, quiet: bool = False) -> Path:
    """Where a cell's images are; the built-in ones are rendered when they are missing.

    Raises:
        ValueError: as `locate`.
    """
    root = locate(cell, data)
    if root is None:
        from mtl_bench.data import synthetic

        root = synthetic.ensure(cell.recipe.data, progress=not quiet)
    return root


def columns(lines: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Cells of text, aligned; the last column is as wide as it is."""
    width = max((len(line) for line in lines), default=0)
    full = [[*line, *[""] * (width - len(line))] for line in lines]
    sizes = [max(map(len, column)) for column in zip(*full, strict=True)][:-1]
    return [
        indent
        + "  ".join([*(w.ljust(n) for w, n in zip(line, sizes, strict=False)), line[-1]]).rstrip()
        for line in full
    ]
