"""Options that several commands have, and what they mean."""

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.core.config import Cell

if TYPE_CHECKING:
    from rich.progress import Progress

    from mtl_bench.core.dataset import Dataset
    from mtl_bench.show.predict.cameras import Given

RUNNING, GRID, CAMERA = "Where and how to run", "Which cells", "The camera"


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
        help="More plug-ins: a folder with methods/, backbones/, tasks/, datasets/ or engines/ in "
        "it or with the files themselves, or one file. Repeatable.",
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
CameraOption = Annotated[
    Path | None,
    typer.Option(
        metavar="CAMERA.JSON",
        help="Intrinsics, height and pitch in Cityscapes' format.",
        rich_help_panel=CAMERA,
        show_default=False,
    ),
]
CalibOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="OpenCV's calib.yaml; or KITTI's calib_cam_to_cam.txt: its camera 03 for images in a "
        "folder image_03, else 02. Lens distortion is not undone: undistort images first.",
        rich_help_panel=CAMERA,
        show_default=False,
    ),
]
PixelsOption = Annotated[
    float | None, typer.Option(help="Pixels.", rich_help_panel=CAMERA, show_default=False)
]
HeightOption = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        help="Above the road: depth is in metres then. Where no file knows it either, depth is in "
        "camera heights.",
        rich_help_panel=CAMERA,
        show_default=False,
    ),
]
CheckpointOption = Annotated[
    Path,
    typer.Option(
        "--checkpoint", metavar="RUN|CHECKPOINT", help="A folder in runs/, or its last.pt."
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
RanksOption = Annotated[
    int | None,
    typer.Option(
        "--ranks",
        "--gpus-per-cell",
        metavar="N",
        min=1,
        help="Processes that train a cell together, each some of the parts of a batch that "
        "recipe.optim.micro_batch makes, or with recipe.optim.one_batch some of its samples, and "
        "each on a GPU of its own where there are any. It changes no number but by rounding.",
        rich_help_panel=RUNNING,
        show_default=False,
    ),
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
        help="Change a value: recipe.optim.lr=3e-4, method.init=0.5; `list settings` has them all. "
        "Repeatable.",
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


def names(words: str | None) -> tuple[str, ...]:
    """`a,b` as names; none where nothing is said."""
    return tuple(word.strip() for word in (words or "").split(",") if word.strip())


def size(text: str) -> tuple[int, int]:
    """Height and width.

    Raises:
        ValueError: not HxW.
    """
    height, _, width = text.lower().partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise ValueError(f"--size '{text}' is not HxW, such as 128x256")
    return int(height), int(width)


def bar(title: str, quiet: bool, *more: str) -> "Progress":
    """A bar on stderr with the number done and the time left."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    middle: list[ProgressColumn] = [BarColumn(), MofNCompleteColumn(), *map(TextColumn, more)]
    columns: list[str | ProgressColumn] = [title, *middle, TimeRemainingColumn()]
    return Progress(*columns, console=Console(stderr=True), disable=quiet)


def echo(quiet: bool) -> Callable[[str], None]:
    """Prints a line, or does not."""
    return (lambda line: None) if quiet else typer.echo


def given_camera(
    camera: Path | None,
    calib: Path | None,
    intrinsics: Sequence[float | None],
    height_m: float | None,
) -> "Given":
    """What the options say of the camera.

    Args:
        intrinsics: fx, fy, cx, cy.

    Raises:
        ValueError: some of them and not all, or several sources of them.
    """
    from mtl_bench.show.predict.cameras import Given

    known = [value for value in intrinsics if value is not None]
    if len(known) not in (0, 4):
        raise ValueError("intrinsics are four numbers: give all of --fx --fy --cx --cy")
    fx, fy, cx, cy = known or (None,) * 4
    numbers = None if fx is None or fy is None or cx is None or cy is None else (fx, fy, cx, cy)
    return Given(camera, calib, numbers, height_m)


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
    from mtl_bench.core.dataset import dataset_of

    kind = dataset_of(cell.recipe)
    name = cell.recipe.data.dataset
    if data is not None:
        layout = _layout(data, kind)
        if layout != kind.layout:
            raise ValueError(
                f"'{data}' is in {layout}'s layout, but recipe '{cell.recipe.name}' trains on "
                f"{name}: choose another --data, --recipe or recipe.data.dataset"
            )
        return data.resolve()
    if not kind.built_in:
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


def _layout(data: Path, kind: "type[Dataset] | None" = None) -> str:
    """What a folder's files look like; a data set's own layout where it recognises them."""
    from mtl_bench.core.dataset import dataset_in

    if not data.is_dir():
        raise ValueError(f"no data folder '{data}'")
    if kind is not None and kind.recognises(data):
        return kind.layout
    found = dataset_in(data)
    if found is None:
        raise ValueError(no_data_set_in(data))
    return found.layout


def no_data_set_in(folder: Path) -> str:
    """What is wrong with it, in a sentence."""
    from mtl_bench.core.dataset import layouts

    return f"no data set in '{folder}': it has neither {' nor '.join(layouts())}"


def data_root(cell: Cell, data: Path | None, quiet: bool = False) -> Path:
    """Where a cell's images are; the built-in ones are rendered when they are missing.

    Raises:
        ValueError: as `locate`.
    """
    root = locate(cell, data)
    if root is None:
        from mtl_bench.core.dataset import dataset_of

        root = dataset_of(cell.recipe).render(cell.recipe.data, quiet)
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
