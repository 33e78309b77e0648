"""`ablate`, `status` and `report` of a grid that times networks on engines."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mtl_bench.cli import options as o
from mtl_bench.cli.choice import Choice

if TYPE_CHECKING:
    from mtl_bench.bench.latency_grid import LatencyGrid
    from mtl_bench.bench.timing import Timing

SEEDS = 10  # of the quality beside the speed: those below this that are done are averaged


def ablate(
    choice: Choice,
    dry_run: bool,
    jobs: int,
    rerun: str | None,
    data: Path | None,
    runs: Path,
    reports: Path,
    device: o.Device,
    wandb: o.Wandb,
    quiet: bool,
) -> None:
    """Take the timings that the grid still lacks, one at a time, then write its report."""
    from mtl_bench.bench import claim, latency_runs, launch
    from mtl_bench.bench.timing import check

    if jobs > 1:
        raise ValueError(f"--jobs {jobs}: a latency is taken with nothing else of ours running")
    if wandb is not o.Wandb.off:
        raise ValueError(f"--wandb {wandb.value}: a grid that times networks tracks no training")
    grid = choice.load_latency(device)
    check(grid.timings)
    todo = latency_runs.to_run(grid.timings, runs, rerun)
    if not quiet or dry_run:
        _announce(grid, todo, runs)
    if dry_run:
        typer.echo("nothing was run (--dry-run)")
        return
    if todo:
        try:
            _run(grid, todo, runs, data, quiet)
        except claim.ClaimedError as error:
            typer.echo(f"mtl-bench: {error}", err=True)
            raise typer.Exit(launch.CLAIMED) from None
    page = write(grid, runs, reports, choice.command)
    words = [latency_runs.inspect(timing, runs).word for timing in grid.timings]
    bad = sum(word in latency_runs.BAD for word in words)
    if bad or not quiet:
        done = sum(word in ("done", "stale") for word in words)
        typer.echo(f"{done} of {len(words)} timings done; report: {page}")
    if bad:
        raise typer.Exit(1)


def status(choice: Choice, runs: Path) -> None:
    """List a latency grid's timings."""
    from mtl_bench.bench import claim, latency_runs

    grid = choice.load_latency()
    lines = []
    for timing in grid.timings:
        state = latency_runs.inspect(timing, runs)
        about = "  ".join(filter(None, (state.headline, state.why)))
        lines.append([state.word, *_words(timing), timing.id, about])
    for line in o.columns(lines):
        typer.echo(line)
    for line in _skipped(grid):
        typer.echo(line)
    typer.echo(latency_runs.summary(grid.timings, runs))
    if (owner := claim.claimed_by(runs / "latency")) is not None:
        typer.echo(f"process {owner.get('pid', '?')} is timing now")


def report(choice: Choice, runs: Path, reports: Path) -> Path:
    """Write a latency grid's page from the rows that there are.

    Raises:
        ValueError: no timing has a row.
    """
    from mtl_bench.bench import latency_runs

    grid = choice.load_latency()
    if all(latency_runs.inspect(timing, runs).word == "missing" for timing in grid.timings):
        raise ValueError(
            f"no timing of grid '{grid.name}' is done in '{runs}': "
            f"mtl-bench ablate --grid {choice.grid}"
        )
    return write(grid, runs, reports, choice.command)


# --- steps ----------------------------------------------------------------------------------------


def write(grid: "LatencyGrid", runs: Path, reports: Path, command: str) -> Path:
    from mtl_bench.bench import latency_runs
    from mtl_bench.report import latency as reporting

    rows = latency_runs.rows(grid.timings, runs)
    quality = _quality(grid.quality, runs)
    return reporting.build(grid, rows, reports / grid.name, quality, command)


def _quality(named: Mapping[str, str], runs: Path) -> list[dict[str, Any]]:
    """Done rows of the grid whose quality stands beside the speed, every seed that there is."""
    if "grid" not in named:
        return []
    from mtl_bench.bench import results
    from mtl_bench.bench.grid import load_grid

    cells = load_grid(named["grid"], recipe=named.get("recipe"), seeds=SEEDS).cells
    return [row for row in results.rows(cells, runs) if row["status"] == "done"]


def _announce(grid: "LatencyGrid", todo: "Sequence[Timing]", runs: Path) -> None:
    from mtl_bench.bench import latency_runs

    counts = {axis: len(values) for axis, values in grid.axes.items()}
    named = [f"{n} {axis}{'s' * (n > 1 and axis != 'tasks')}" for axis, n in counts.items()]
    product = " x ".join(named)
    first = grid.timings[0]
    typer.echo(f"{grid.name}: {grid.question}")
    typer.echo(
        f"{len(grid.timings)} timings of {first.passes} passes on {first.device} = {product}, less "
        f"{len(grid.skips)} skipped; network of recipe {first.recipe}"
    )
    hours = latency_runs.hours_to_run(todo, grid.timings, runs)
    about = "" if hours is None or not todo else f"   about {hours:.1f} hours"
    typer.echo(f"  {latency_runs.summary(grid.timings, runs)}   to run {len(todo)}{about}")
    for line in _skipped(grid):
        typer.echo(line)


def _run(
    grid: "LatencyGrid", todo: "Sequence[Timing]", runs: Path, data: Path | None, quiet: bool
) -> None:
    from mtl_bench.bench import latency_runs
    from mtl_bench.bench.timing import lack

    def say(line: str, ok: bool) -> None:
        if not (ok and quiet):
            typer.echo(f"{time.strftime('%H:%M:%S')} {line}")

    def command(timing: "Timing", file: Path) -> list[str]:
        return latency_runs.timing_command(timing, file, data)

    latency_runs.run(todo, runs, command, lack, say, grid.smoke)


def _skipped(grid: "LatencyGrid") -> list[str]:
    """A line for each reason."""
    reasons = dict.fromkeys(skip.why for skip in grid.skips)
    counts = {why: sum(skip.why == why for skip in grid.skips) for why in reasons}
    return [f"  skipped {count}: {why}" for why, count in counts.items()]


def _words(timing: "Timing") -> list[str]:
    arguments = [f"{key}={value}" for key, value in timing.backbone_args.items()]
    named = " ".join([timing.backbone, *arguments])
    return [named, ",".join(timing.tasks), timing.size, timing.engine, timing.precision]
