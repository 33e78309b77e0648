"""`latency` and `export`: a network as it is deployed."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.config import TASKS

if TYPE_CHECKING:
    from mtl_bench.core.config import Cell
    from mtl_bench.model import Model

PANEL = "Deployment"
ALL = "all"

CheckpointOption = Annotated[
    Path | None,
    typer.Option(
        metavar="RUN|CHECKPOINT",
        help="A folder in runs/, or its last.pt; its weights run at any size.",
        show_default=False,
    ),
]
BackboneOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="In place of a checkpoint: random weights."),
]
NetworkOption = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        metavar="NAME|FILE",
        help="Of --backbone: network sizes and images. Without it the paper's network sizes.",
        show_default=False,
    ),
]
TasksOption = Annotated[
    str | None,
    typer.Option(help="Separated by commas; without it all that there are.", show_default=False),
]
SizeOption = Annotated[str, typer.Option(metavar="HxW", help="Of the image, pixels.")]


def register(app: typer.Typer) -> None:
    app.command(
        rich_help_panel=PANEL,
        epilog="Example: mtl-bench latency --backbone NAME --size 1024x2048 --engine all",
    )(latency)
    app.command(
        rich_help_panel=PANEL,
        epilog="Example: mtl-bench export --checkpoint runs/NAME --size 512x1024 --out net.onnx",
    )(export)


def latency(
    checkpoint: CheckpointOption = None,
    backbone: BackboneOption = None,
    recipe: NetworkOption = None,
    tasks: TasksOption = None,
    size: SizeOption = "1024x2048",
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME|all",
            help="plain, eager, compile, onnxruntime, openvino, tensorrt; all: one after another.",
        ),
    ] = "plain",
    precision: Annotated[
        str, typer.Option(metavar="NAME|all", help="fp32, bf16 or fp16; all: with --engine all.")
    ] = "fp32",
    passes: Annotated[int, typer.Option(min=1, help="Timed ones, over distinct images.")] = 500,
    seconds: Annotated[
        float | None,
        typer.Option(help="Stop after that long, not before 20 passes.", show_default=False),
    ] = None,
    batch: Annotated[
        int, typer.Option(min=1, help="Images at once for the throughput; 1: as the latency.")
    ] = 4,
    threads: Annotated[
        int | None, typer.Option(min=1, help="On the CPU; without it all.", show_default=False)
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", help="Write the row; of all, a list.", show_default=False
        ),
    ] = None,
    settings: o.SetOption = None,
    data: o.DataOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
) -> None:
    """Time one image from host memory to panoptic map and metric depth, on an engine.

    Its output is compared with the plain network's before. Without --data the built-in frames of
    the split val are looked at, resized to --size.
    """
    from mtl_bench.bench import claim, results
    from mtl_bench.engines import words

    claim.end_with_launcher()
    if ALL in (engine, precision):
        rows = _all(engine, precision, device)
        for line in o.columns(words.table(rows)):
            typer.echo(line)
        if file is not None:
            results.write_json(file, rows)
        _end([row["status"] for row in rows])
        return
    cell, model = _network(checkpoint, backbone, recipe, tasks, settings)
    root = o.data_root(cell, data)
    import torch

    from mtl_bench import deploy
    from mtl_bench.core import provenance
    from mtl_bench.core.device import choose_device
    from mtl_bench.engines import timed

    chosen = choose_device(device.value)
    torch.set_num_threads(threads or provenance.cores())
    subject = deploy.subject(
        cell, model, size=_size(size), data=root, device=chosen, trained=checkpoint is not None
    )
    plan = timed.Plan(passes, seconds, batch, threads or provenance.cores())
    row = timed.row(subject, engine, precision, chosen, plan)
    if file is not None:
        results.write_json(file, row)
    for line in words.lines(row):
        typer.echo(line)
    _end([row["status"]])


def export(
    out: Annotated[Path, typer.Option(metavar="FILE", help="The ONNX file to write.")],
    checkpoint: CheckpointOption = None,
    backbone: BackboneOption = None,
    recipe: NetworkOption = None,
    tasks: TasksOption = None,
    size: SizeOption = "1024x2048",
    post: Annotated[
        str,
        typer.Option(
            metavar="inside|apart|none",
            help="Post-processing in the same graph, in a second file NAME.post.onnx, or nowhere.",
        ),
    ] = "inside",
    settings: o.SetOption = None,
    plugins: o.PluginsOption = None,
) -> None:
    """Write a network as ONNX of a fixed size: 8-bit image in, panoptic ids, depth and points out.

    The inputs' and outputs' names are printed; classes, size and cell id are in the metadata.
    """
    cell, model = _network(checkpoint, backbone, recipe, tasks, settings)
    from mtl_bench import deploy
    from mtl_bench import export as exporter
    from mtl_bench.data.labels import labels_of

    deploy.check_size(cell, _size(size))
    origin = {} if checkpoint is None else {"cell_id": cell.id, "cell": cell.slug}
    labels = labels_of(cell.recipe.data.dataset)
    paths = exporter.export(
        model.net.eval(), _size(size), out, labels, cell.recipe.evaluate, post, origin
    )
    import onnx

    for path in paths:
        graph = onnx.load(str(path)).graph
        typer.echo(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
        typer.echo(f"  inputs   {', '.join(value.name for value in graph.input)}")
        typer.echo(f"  outputs  {', '.join(value.name for value in graph.output)}")


# --- steps ----------------------------------------------------------------------------------------


def _network(
    checkpoint: Path | None,
    backbone: str | None,
    recipe: str | None,
    tasks: str | None,
    settings: list[str] | None,
) -> "tuple[Cell, Model]":
    """What to run: a checkpoint's network, or one with random weights."""
    if (checkpoint is None) == (backbone is None):
        raise ValueError("say which network: either --checkpoint RUN or --backbone NAME")
    names = tuple(word.strip() for word in (tasks or "").split(",") if word.strip())
    unknown = [name for name in names if name not in TASKS]
    if unknown:
        raise ValueError(f"no task called '{unknown[0]}' (known: {', '.join(TASKS)})")
    from mtl_bench import deploy

    if checkpoint is not None:
        if recipe is not None or settings:
            raise ValueError("--recipe and --set go with --backbone: a checkpoint has its own")
        return deploy.from_checkpoint(checkpoint, names or None)
    assert backbone is not None
    return deploy.untrained(backbone, recipe, names or TASKS, settings or [])


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise ValueError(f"--size '{text}' is not HxW, such as 1024x2048")
    return int(height), int(width)


def _all(engine: str, precision: str, device: o.Device) -> list[dict[str, Any]]:
    """Rows of several engines and precisions, each from a process of its own."""
    from mtl_bench import engines
    from mtl_bench.core.device import choose_device

    kind = choose_device(device.value).type
    rows = []
    for name in engines.NAMES if engine == ALL else [engine]:
        has = engines.PRECISIONS[name].get(kind, ())
        for wanted in (has or ("fp32",)) if precision == ALL else (precision,):
            if wanted in has or (engines.available(name) and wanted == "fp32"):
                typer.echo(f"{name} {wanted} ...", err=True)
                rows.append(_apart(name, wanted))
    return rows


def _apart(name: str, precision: str) -> dict[str, Any]:
    """The row of this command with one engine, in a new process: its own threads and memory."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "row.json"
        own = [
            "--engine",
            name,
            "--precision",
            precision,
            "--json",
            str(file),
        ]  # the last one counts
        command = [sys.executable, "-m", "mtl_bench", *sys.argv[1:], *own]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if not file.is_file():
            last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            raise ValueError(last.removeprefix("mtl-bench: "))
        row: dict[str, Any] = json.loads(file.read_text())
    return row


def _end(statuses: list[str]) -> None:
    """A fast wrong engine is an error; one that is not installed is not."""
    if {"wrong", "failed"} & set(statuses):
        raise typer.Exit(1)
