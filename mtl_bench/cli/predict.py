"""`predict`: what a trained cell sees in a user's images or video."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli import options as o

if TYPE_CHECKING:
    from mtl_bench.show.predict import Predictor
    from mtl_bench.show.predict.job import Job

OUTPUT = "What is written"


def register(app: typer.Typer) -> None:
    app.command(
        "predict",
        rich_help_panel="One cell",
        epilog="Example: mtl-bench predict --checkpoint runs/NAME drive.mp4 --out predicted",
    )(predict)


def predict(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...", help="Images, folders of images or patterns; or one video."
        ),
    ],
    checkpoint: o.CheckpointOption,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="A new folder; it appears when all is done.")
    ],
    what: Annotated[
        str | None,
        typer.Option(
            metavar="KIND,KIND,...",
            help="Files of each frame: overlay, depth, ids, points. Without it: of images all, of "
            "a video's frames none.",
            rich_help_panel=OUTPUT,
            show_default=False,
        ),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd",
            help="Images, depth and points for the Rerun viewer, too.",
            rich_help_panel=OUTPUT,
            show_default=False,
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="HxW",
            help="What images are resized to for the network, in place of its training size.",
            show_default=False,
        ),
    ] = None,
    camera: o.CameraOption = None,
    calib: o.CalibOption = None,
    fx: o.PixelsOption = None,
    fy: o.PixelsOption = None,
    cx: o.PixelsOption = None,
    cy: o.PixelsOption = None,
    camera_height: o.HeightOption = None,
    device: o.DeviceOption = o.Device.auto,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Predict images or a video: panoptic overlay, depth, ids and point cloud, or a video of it.

    Without options for the camera it is that of the data set which an image lies in, else a guess.
    What cannot be predicted is listed at the end and in prediction.json; the exit code is 1 then.
    """
    from mtl_bench.show.predict import job as predictions

    given = o.given_camera(camera, calib, (fx, fy, cx, cy), camera_height)
    paths = predictions.find(inputs)
    video = predictions.is_video(paths)
    predictor = _predictor(checkpoint, None if size is None else o.size(size), device)
    job = predictions.Job(predictor, given, _kinds(what, video, predictor.cell.tasks))
    run = predictions.predict_video if video else predictions.predict_images
    with (
        predictions.whole_folder(out) as folder,
        predictions.recorded(job, rerun),
        _progress(job, quiet),
    ):
        record = run(job, paths, folder)
        record |= {"checkpoint": str(checkpoint), "cell": predictor.cell.slug}
        predictions.write_record(folder, record)
    if not quiet:
        for line in predictions.summary(record, predictor):
            typer.echo(line)
        typer.echo(f"{record['frames']} frames, {record['fps']:.1f} FPS: {out}")
    for failure in record["failed"]:
        typer.echo(f"not predicted: {failure['why']}", err=True)
    if record["failed"]:
        raise typer.Exit(1)


def _predictor(checkpoint: Path, size: tuple[int, int] | None, device: o.Device) -> "Predictor":
    """The checkpoint's model, ready to be asked."""
    from mtl_bench.bench.jobs import load_run
    from mtl_bench.bench.stored import load_model
    from mtl_bench.core.device import Compute, choose_device
    from mtl_bench.show.predict import Predictor

    cell, weights = load_run(checkpoint)
    compute = Compute(choose_device(device.value), cell.recipe.optim.precision)
    return Predictor(load_model(cell, weights, compute), cell, compute.device, size)


def _kinds(what: str | None, video: bool, tasks: tuple[str, ...]) -> list[str]:
    """The kinds of files that `--what` names, or that the cell's tasks give.

    Raises:
        ValueError: an unknown kind, or one of a task that the cell lacks.
    """
    from mtl_bench.core.quality import declared, in_turns

    pairs = in_turns([(k, task) for k in kinds] for task, kinds in declared("files").items())
    task_of = dict(pairs)
    if what is None:
        return [] if video else [kind for kind, task in task_of.items() if task in tasks]
    kinds = [word.strip() for word in what.split(",") if word.strip()]
    for kind in kinds:
        if kind not in task_of:
            raise ValueError(f"--what '{kind}' is none of {', '.join(task_of)}")
        if task_of[kind] not in tasks:
            raise ValueError(f"--what {kind} takes the task {task_of[kind]}, which the cell lacks")
    return kinds


@contextmanager
def _progress(job: "Job", quiet: bool) -> Iterator[None]:
    """A bar on stderr with frames a second, while the job runs."""
    with o.bar("predicting", quiet, "{task.fields[fps]:.1f} FPS") as bar:
        task = bar.add_task("", total=None, fps=0.0)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total or None, fps=job.fps)

        job.progress = show
        yield
