"""`latency` and `export`: a network as it is deployed."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mtl_bench.cli import options as o

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
            help="One of mtl-bench list engines; all: one after another.",
        ),
    ] = "plain",
    precision: Annotated[
        str,
        typer.Option(metavar="NAME|all", help="fp32, bf16, fp16, int8; all: with --engine all."),
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
        int | None,
        typer.Option(
            min=1,
            help="On the CPU; without it all. Small images may be quicker on one.",
            show_default=False,
        ),
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
    from mtl_bench.core import locks
    from mtl_bench.core.files import write_json

    locks.end_with_launcher()
    if ALL in (engine, precision):
        rows = _all(engine, precision, device)
        for line in o.columns(_table(rows)):
            typer.echo(line)
        if file is not None:
            write_json(file, rows)
        _end([row["status"] for row in rows])
        return
    cell, model = _network(checkpoint, backbone, recipe, tasks, settings)
    root = o.data_root(cell, data)
    import torch

    from mtl_bench.core import provenance
    from mtl_bench.core.device import choose_device
    from mtl_bench.deploy import timer
    from mtl_bench.deploy.subject import EXAMPLES, subject

    chosen = choose_device(device.value)
    torch.set_num_threads(threads or provenance.cores())
    what = subject(
        cell,
        model,
        size=o.size(size),
        data=root,
        device=chosen,
        trained=checkpoint is not None,
        examples=EXAMPLES if precision == "int8" else 0,
    )
    plan = timer.Plan(passes, seconds, batch, threads or provenance.cores())
    row = timer.row(what, engine, precision, chosen, plan)
    if file is not None:
        write_json(file, row)
    for line in _lines(row, f"limits {timer.SPREAD}, {timer.DRIFT}"):
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
    dynamic: Annotated[
        bool,
        typer.Option("--dynamic", help="Height and width are free; with --post none."),
    ] = False,
    settings: o.SetOption = None,
    plugins: o.PluginsOption = None,
) -> None:
    """Write a network as ONNX: 8-bit image in, panoptic ids, depth and points out.

    The inputs' and outputs' names are printed; NAME.json beside it says what each of them is.
    """
    cell, model = _network(checkpoint, backbone, recipe, tasks, settings)
    from mtl_bench.core.backbone import check_size, divisor_of
    from mtl_bench.deploy import export as exporter

    check_size(cell, o.size(size), "--size")
    origin = {} if checkpoint is None else {"cell_id": cell.id, "cell": cell.slug}
    multiple = divisor_of(cell) if dynamic else None
    paths = exporter.export(model.net.eval(), o.size(size), out, post, origin, multiple)
    for path in paths:
        typer.echo(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
        for side, found in exporter.ports(path).items():
            typer.echo(f"  {side:7}  {', '.join(found)}")
    typer.echo(f"{out.with_suffix('.json')}  what each of them is")


# --- steps ----------------------------------------------------------------------------------------


def _network(
    checkpoint: Path | None,
    backbone: str | None,
    recipe: str | None,
    tasks: str | None,
    settings: list[str] | None,
) -> "tuple[Cell, Model]":
    """What to run: a checkpoint's network, or one with random weights."""
    from mtl_bench.core.config import check_tasks

    if (checkpoint is None) == (backbone is None):
        raise ValueError("say which network: either --checkpoint RUN or --backbone NAME")
    names = o.names(tasks)
    check_tasks(names)
    if checkpoint is not None:
        if recipe is not None or settings:
            raise ValueError("--recipe and --set go with --backbone: a checkpoint has its own")
        from mtl_bench.bench.stored import deployed

        return deployed(checkpoint, names or None)
    assert backbone is not None
    from mtl_bench.deploy.subject import untrained

    return untrained(backbone, recipe, names, settings or [])


def _all(engine: str, precision: str, device: o.Device) -> list[dict[str, Any]]:
    """Rows of several engines and precisions, each from a process of its own."""
    from mtl_bench.core.device import choose_device
    from mtl_bench.deploy import engines

    kind = choose_device(device.value).type
    rows = []
    for name in engines.names() if engine == ALL else [engine]:
        has = engines.facts(name).precisions.get(kind, ())
        for wanted in (has or ("fp32",)) if precision == ALL else (precision,):
            if wanted in has or (engines.available(name) and wanted == "fp32"):
                typer.echo(f"{name} {wanted} ...", err=True)
                rows.append(_apart(name, wanted))
    return rows


def _apart(name: str, precision: str) -> dict[str, Any]:
    """The row of this command with one engine, in a new process: its own threads and memory."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "row.json"
        own = ["--engine", name, "--precision", precision, "--json", str(file)]
        command = [sys.executable, "-m", "mtl_bench", *sys.argv[1:], *own]  # the last one counts
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


# --- rows as text ---------------------------------------------------------------------------------


def _lines(row: dict[str, Any], limits: str) -> list[str]:
    """What a row says."""
    what = f"{row['backbone']} {','.join(row['tasks'])} {row['height']}x{row['width']}"
    head = f"{what} {row['engine']} {row['precision']}, {row['weights']} weights"
    if row["status"] != "done":
        return [head, f"  {row['status']}: {row['why']}"]
    m = {key.partition(".")[2]: value for key, value in row["metric"].items()}
    noise = f"  spread {m['spread']:.2f}, drift {m['drift']:+.2f}"
    noise += f": noisy ({limits}), take it again" if m["noisy"] else ""
    return [
        head,
        f"  {m['mean_ms']:.1f} ms (p50 {m['p50_ms']:.1f}, p95 {m['p95_ms']:.1f}, p99 "
        f"{m['p99_ms']:.1f}, std {m['std_ms']:.1f})  FPS {m['fps']:.2f}",
        f"  transfer {m['transfer_ms']:.1f}, network {m['network_ms']:.1f}, post-processing "
        f"{m['postprocess_ms']:.1f} ms",
        f"  {m['passes']} passes after {m['warmup']}, {m['images']} images, {m['threads']} "
        f"threads, {m['device']}",
        noise,
        f"  throughput {m['throughput_fps']:.2f} images a second at batch {m['throughput_batch']}",
        f"  {m['gmacs']:.1f} G multiply-adds, {m['network_mb']:.0f} MB; machine "
        f"{m['peak_gflops']:.0f} GFLOP/s, {m['peak_gbs']:.1f} GB/s: share {m['share']:.2f}",
        f"  against plain: {_agreement(row)}",
    ]


def _agreement(row: dict[str, Any]) -> str:
    """Equal ids first, then classes' logits, then quantities."""
    words: dict[str, str] = {}
    for key, value in row["metric"].items():
        what, _, measure = key.removeprefix("agreement.").partition("_")
        if measure == "equal":
            words["0" + what] = f"{100 * value:.3f} % {what} pixels"
        elif measure == "max":
            words["1" + what] = f"{what} {value:.1g}"
        elif measure == "rms":
            words["3" + what] = f"{what} {value:.1g}"
        elif measure == "median_rel":
            most = row["metric"][f"agreement.{what}_max_rel"]
            words["2" + what] = f"{what} {value:.1g} (largest {most:.1g})"
    return ", ".join(words[key] for key in sorted(words))


def _table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Several rows, line by line, the head first; `faster` is than plain's."""
    head = ["engine", "precision", "ms", "p95", "FPS", "transfer", "network", "post", "faster"]
    lines = [[*head, "against plain"]]
    done = {(row["engine"], row["precision"]): row["metric"] for row in rows}
    plain = done.get(("plain", "fp32"), {}).get("latency.mean_ms")
    for row in rows:
        m = row["metric"]
        if row["status"] != "done":
            about = f"{row['status']}: {row['why']}"
            lines.append([row["engine"], row["precision"], *[""] * 7, about])
            continue
        stages = ("mean", "p95", "transfer", "network", "postprocess")
        mean, p95, *times = (f"{m[f'latency.{key}_ms']:.1f}" for key in stages)
        faster = "" if plain is None else f"{plain / m['latency.mean_ms']:.2f}x"
        noisy = ", noisy" if m["latency.noisy"] else ""
        values = [mean, p95, f"{m['latency.fps']:.2f}", *times, faster, _agreement(row) + noisy]
        lines.append([row["engine"], row["precision"], *values])
    return lines
