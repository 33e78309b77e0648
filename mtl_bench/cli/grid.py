"""`ablate`, `status` and `report`: a grid of cells or of timings."""

import itertools
import os
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mtl_bench.cli import options as o
from mtl_bench.cli.queue import queue
from mtl_bench.core.config import Cell
from mtl_bench.core.ranks import check_share

if TYPE_CHECKING:
    from mtl_bench.bench.data_state import Data
    from mtl_bench.bench.grid import Grid
    from mtl_bench.bench.jobs import Job, Timing
    from mtl_bench.core.recipe import Recipe


class On(StrEnum):
    local = "local"
    slurm = "slurm"


class Rerun(StrEnum):
    stale = "stale"
    failed = "failed"
    all = "all"
    latency = "latency"


def register(app: typer.Typer) -> None:
    panel = "A grid of cells"
    app.command(
        rich_help_panel=panel,
        epilog="Example: mtl-bench ablate --grid backbones --seeds 3 --jobs 2",
    )(ablate)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench status --grid backbones")(status)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench report --grid backbones")(report)


def ablate(
    grid: o.GridOption,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run, and run nothing.")
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            min=1,
            help="Cells at a time; they share the cores, and the GPUs that CUDA_VISIBLE_DEVICES "
            "names. Without it one a GPU, or else one a core.",
            show_default=False,
        ),
    ] = None,
    rerun: Annotated[
        Rerun | None,
        typer.Option(
            "--rerun",
            help="stale: of cells whose code has changed, run again what it concerns: training, "
            "evaluation, latency. failed: begin failed ones at step "
            "0, not at their checkpoint. all: run every cell again. latency: only time them again.",
            show_default=False,
        ),
    ] = None,
    where: Annotated[
        On,
        typer.Option(
            "--on",
            help="slurm: queue the cells, at most --jobs at a time, and return; see "
            "docs/clusters.md.",
        ),
    ] = On.local,
    slurm: Annotated[
        str,
        typer.Option(
            metavar="NAME=VALUE,...",
            help="Options of sbatch, such as partition=gpu,time=4:00:00,gpus=1.",
            show_default=False,
        ),
    ] = "",
    data: o.DataOption = None,
    runs: o.RunsOption = Path("runs"),
    reports: o.ReportsOption = Path("reports"),
    device: o.DeviceOption = o.Device.auto,
    ranks: o.RanksOption = None,
    wandb: o.WandbOption = o.Wandb.off,
    plugins: o.PluginsOption = None,
    quiet: o.QuietOption = False,
) -> None:
    """Run what a grid still lacks, then write its report.

    Cells that are done are reused, interrupted and failed ones tried again; cells that others need
    run before them, and the baseline's too, be they in a row or not. A grid of latencies takes them
    one at a time.
    """
    from mtl_bench.bench import references, store, tuning
    from mtl_bench.bench.data_state import Data
    from mtl_bench.bench.jobs import CELLS
    from mtl_bench.bench.slurm import options_of

    sbatch = options_of(slurm)
    if sbatch and where is not On.slurm:
        raise ValueError("--slurm is for --on slurm")
    choice = Choice(grid, recipe, seeds, smoke, settings, pretrained)
    chosen = choice.load(device)
    if chosen.kind is not CELLS and (jobs or 1) > 1:
        raise ValueError(f"--jobs {jobs}: a latency is taken with nothing else of ours running")
    each = ranks or 1
    if chosen.kind is not CELLS and each > 1:
        raise ValueError(f"--ranks {each}: ranks train, and this grid times networks")
    if chosen.kind is not CELLS and wandb is not o.Wandb.off:
        raise ValueError(f"--wandb {wandb.value}: a grid that times networks tracks no training")
    if where is On.slurm and chosen.kind is not CELLS:
        raise ValueError(
            "--on slurm queues cells; latencies are taken on a machine that you choose"
        )
    against = references.baselines(chosen)
    tried = [trial.cell for trial in tuning.trials(chosen)] if chosen.tune else []
    chosen.kind.check([*chosen.jobs, *against, *tried])
    for job in (*chosen.jobs, *against, *tried) if each > 1 else ():
        check_share(job.recipe.optim, each)
    if chosen.kind is CELLS and not dry_run:  # it imports pandas
        from mtl_bench.report import grid as of_cells

        of_cells.check(chosen)
    given = Data(None if data is None else data.resolve())
    phases = _phases(chosen, runs, rerun is not None, given)
    first = _left(next(phases), runs, rerun, given)
    for job in [] if dry_run else first:
        if isinstance(job, Cell):
            o.locate(job, data)  # a wrong folder is told at once
    if not quiet or dry_run:
        _announce(chosen, first, runs, rerun, given)
    steps = itertools.chain([first], (_left(each, runs, rerun, given) for each in phases))
    if where is On.slurm:
        passed_on = ["--wandb", wandb.value, "--device", device.value, *["--quiet"] * quiet]
        passed_on += ["--ranks", str(each)] if each > 1 else []
        todo = next(filter(None, steps), [])
        queue(todo, runs, data, given, passed_on, sbatch, jobs, rerun, dry_run, quiet)
        if chosen.tune and todo and not dry_run:
            typer.echo("once they are done, the same command queues what follows from them")
        return
    if dry_run:
        typer.echo("nothing was run (--dry-run)")
        return
    ran = False
    gpus = _gpus(chosen, device, each)
    options = ["--wandb", wandb.value]
    for todo in steps:
        ran = ran or bool(todo)
        if todo:
            several = jobs or _side_by_side(chosen, todo, gpus, each)
            place = (options, device, several, gpus, each)
            _run(chosen, todo, runs, data, given, *place, rerun, quiet)
    if chosen.kind is CELLS:
        references.measure_trivial(
            chosen, runs, lambda: o.data_root(chosen.cells[0], data, quiet), refresh=ran
        )
    rows = _rows(chosen, runs, given)
    page = _write(chosen, rows, runs, reports, choice.command)
    words = [row["status"] for row in rows]
    words += [] if chosen.tune else [store.status(cell, runs, given) for cell in against]
    bad = any(word not in chosen.kind.good for word in words)
    if bad or not quiet:
        done = sum(row["status"] in ("done", "stale") for row in rows)
        typer.echo(f"{done} of {len(rows)} {chosen.kind.noun}s done; report: {page}")
    if bad:
        raise typer.Exit(1)


def status(
    grid: o.GridOption,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    runs: o.RunsOption = Path("runs"),
    plugins: o.PluginsOption = None,
) -> None:
    """List a grid's cells: done, stale, failed, interrupted, running or missing.

    Those that are in no row of the grid but needed by one are marked as such. Of cells that are in
    Slurm's queue stands what Slurm says.
    """
    from mtl_bench.bench import store
    from mtl_bench.bench.jobs import TIMINGS, with_parents
    from mtl_bench.core.locks import claimed_by

    chosen = Choice(grid, recipe, seeds, smoke, settings, pretrained).load()
    from mtl_bench.bench.slurm import Slurm

    own, names = _named(chosen, runs)
    every = with_parents(own)
    known = {job.id for job in own} if chosen.tune else {job.id for job in chosen.jobs}
    queue = Slurm(runs).states() if shutil.which("squeue") else {}
    lines = []
    for job in every:
        state = store.inspect(job, runs)
        queued = queue[job.id].about if job.id in queue and state.row is None else ""
        about = "  ".join(filter(None, (state.why, state.headline, queued)))
        if isinstance(job, Cell):
            name = names.get(job.id, "") if job.id in known else "(needed by another)"
            named = [name] if names or len(every) > len(known) else []
            what = [*named, job.label, str(store.run_dir(job, runs))]
        else:
            what = [*job.words, job.id]
        lines.append([state.word, *what, about])
    for line in [*o.columns(lines), *_skipped(chosen), store.summary(chosen.kind, every, runs)]:
        typer.echo(line)
    if chosen.tune:
        _tell_parts(chosen, runs)
    owner = claimed_by(runs / "latency") if chosen.kind is TIMINGS else None
    if owner is not None:
        typer.echo(f"process {owner.get('pid', '?')} is timing now")


def report(
    grid: Annotated[
        str | None,
        typer.Option(
            "--grid",
            metavar="NAME|FILE",
            help="A grid's name, or a .toml of your own.",
            show_default=False,
        ),
    ] = None,
    table: Annotated[
        str | None,
        typer.Option(
            "--table",
            metavar="NAME",
            help="Published rows, and beside them those of --grid or of all cells in --runs; in "
            "place of a grid's report. cityscapes, kitti: the paper's comparisons. nyuv2, "
            "cityscapes2, celeba, nyuv2-deeplab, cityscapes2-deeplab: what the field compares "
            "methods on.",
            show_default=False,
        ),
    ] = None,
    recipe: o.RecipeOption = None,
    seeds: o.SeedsOption = None,
    smoke: o.SmokeOption = False,
    settings: o.SetOption = None,
    pretrained: o.PretrainedOption = None,
    runs: o.RunsOption = Path("runs"),
    reports: o.ReportsOption = Path("reports"),
    readme: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Put the table between this file's <!-- results:GRID --> marks, too.",
            show_default=False,
        ),
    ] = None,
    plugins: o.PluginsOption = None,
) -> None:
    """Write a grid's tables, plots and page from the rows that there are."""
    choice = Choice(grid, recipe, seeds, smoke, settings, pretrained) if grid else None
    if table is not None:
        _write_table(table, choice, runs, reports, smoke)
        return
    if choice is None:
        raise ValueError("nothing to report: say --grid NAME or --table NAME")
    chosen = choice.load()
    rows = _rows(chosen, runs)
    if not any("code" in row for row in rows):
        raise ValueError(
            f"no {chosen.kind.noun} of grid '{chosen.name}' is done in '{runs}': "
            f"mtl-bench ablate --grid {grid}"
        )
    page = _write(chosen, rows, runs, reports, choice.command)
    typer.echo(str(page))
    if readme is not None:
        from mtl_bench.report.readme import update

        update(readme, page.parent.name, page.parent)
        typer.echo(str(readme))


# --- steps ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Choice:
    """What was said about which jobs to take."""

    grid: str
    recipe: str | None
    seeds: int | None
    smoke: bool
    settings: list[str] | None
    pretrained: str | None

    def load(self, device: o.Device = o.Device.auto) -> "Grid":
        from mtl_bench.bench.grid import load_grid

        return load_grid(
            self.grid,
            recipe=self.recipe,
            seeds=self.seeds,
            smoke=self.smoke,
            settings=self.settings or [],
            pretrained=o.weights(self.pretrained),
            device=device.value,
            say=partial(typer.echo, err=True),
        )

    def needed(self, runs: Path) -> "Sequence[Job]":
        """The jobs that are known by now, trials among them, and all that these need."""
        from mtl_bench.bench.jobs import with_parents

        return with_parents(_named(self.load(), runs)[0])

    @property
    def command(self) -> str:
        """How to run the same jobs again; files without their folders."""
        words = ["mtl-bench", "ablate", "--grid", Path(self.grid).name]
        for option, value in (
            ("--recipe", self.recipe and Path(self.recipe).name),
            ("--seeds", self.seeds),
            ("--pretrained", self.pretrained and Path(self.pretrained).name),
        ):
            words += [option, str(value)] if value is not None else []
        words += ["--smoke"] * self.smoke
        for setting in self.settings or []:
            words += ["--set", setting]
        return shlex.join(words)


def _phases(grid: "Grid", runs: Path, again: bool, data: "Data") -> "Iterator[Sequence[Job]]":
    """What is run one after another: of a grid that is tuned, problem by problem, trials and then
    the results that they choose.

    Args:
        again: trials that failed, too.
    """
    from mtl_bench.bench import references, tuning

    if grid.tune is None:
        yield [*grid.jobs, *references.baselines(grid)]
        return
    for problem in tuning.problems(grid):
        yield tuning.part(grid, problem, runs, data).to_try(again)
        yield [final.cell for final in tuning.finals(grid, runs, data, [problem])]


def _left(jobs: "Sequence[Job]", runs: Path, rerun: str | None, data: "Data") -> "list[Job]":
    from mtl_bench.bench import store

    return store.to_run(jobs, runs, rerun, data)


def _named(grid: "Grid", runs: Path) -> "tuple[list[Job], Mapping[str, str]]":
    """The jobs that are known by now, and what a reader calls them."""
    from mtl_bench.bench import references, tuning

    if grid.tune is None:
        return [*grid.jobs, *references.baselines(grid)], grid.names
    found: dict[str, tuple[Job, str]] = {}
    for trial in tuning.trials(grid):
        name = f"{trial.line} on {trial.problem}, trial {trial.number}"
        found.setdefault(trial.cell.id, (trial.cell, name))
    for final in tuning.finals(grid, runs):
        name = f"{final.line} on {final.problem}, trial {final.choice.trial.number} chosen"
        found.setdefault(final.cell.id, (final.cell, name))
    return [job for job, _ in found.values()], {id: name for id, (_, name) in found.items()}


def _tell_parts(
    grid: "Grid", runs: Path, rerun: str | None = None, data: "Data | None" = None
) -> None:
    """A line for each problem: how far its trials and results are, and the hours left."""
    from mtl_bench.bench import store, tuning

    for problem in tuning.problems(grid):
        part = tuning.part(grid, problem, runs, data)
        wanted = [*part.to_try(rerun is not None), *(each.cell for each in part.finals)]
        todo = store.to_run(wanted, runs, rerun, data)
        trials = store.summary(grid.kind, [each.trial.cell for each in part.trials], runs, data)
        words = [f"  {problem}: trials: {trials}"]
        finals = store.summary(grid.kind, [each.cell for each in part.finals], runs, data)
        waiting = f"{len(part.open)} after their trials" if part.open else ""
        words += ["results: " + "   ".join(filter(None, (finals, waiting)))]
        hours = part.hours(todo, runs, rerun, data) if todo or part.open else 0.0
        words += [
            "hours left: not known, none is done"
            if hours is None
            else f"about {hours:.1f} hours left, one after another"
        ]
        typer.echo("; ".join(words))


def _announce(
    grid: "Grid", todo: "Sequence[Job]", runs: Path, rerun: str | None, data: "Data"
) -> None:
    from mtl_bench.bench import references, store, tuning
    from mtl_bench.bench.jobs import CELLS, with_parents
    from mtl_bench.bench.launch import duration
    from mtl_bench.bench.space import SPLIT

    counts = {axis: len(values) for axis, values in grid.axes.items()}
    counts |= {"row": len(set(grid.names.values()))} if grid.names else {}
    product = " x ".join(f"{n} {a}{'s' * (n > 1 and a[-1] != 's')}" for a, n in counts.items())
    typer.echo(f"{grid.name}: {grid.question}")
    if grid.kind is CELLS:
        about = " or ".join(dict.fromkeys(_told(job.recipe) for job in grid.jobs))
    else:
        first = grid.jobs[0]
        about = f"network of recipe {first.recipe}"
    if grid.tune is not None:
        typer.echo(
            f"{len(grid.jobs)} results = {product}, less {len(grid.skips)} skipped, and their "
            f"baselines; before them {len(tuning.trials(grid))} trials: {grid.tune.trials} of "
            f"every line on every problem, judged on the split {SPLIT}; {about}"
        )
        _tell_parts(grid, runs, rerun, data)
    else:
        every = with_parents([*grid.jobs, *references.baselines(grid)])
        needed = len(every) - len(grid.jobs)
        more = f" and {needed} that they need" if needed else ""
        more = more if grid.kind is CELLS else f" of {first.passes} passes on {first.device}"
        typer.echo(
            f"{len(grid.jobs)} {grid.kind.noun}s{more} = {product}, less {len(grid.skips)} "
            f"skipped; {about}"
        )
        hours = store.hours_to_run(todo, every, runs, rerun, data)
        known = "" if hours is None else duration(hours * 3600)
        about = f"   about {known} one after another" if known and todo else ""
        typer.echo(f"  {store.summary(grid.kind, every, runs, data)}   to run {len(todo)}{about}")
    for line in _skipped(grid):
        typer.echo(line)


def _told(recipe: "Recipe") -> str:
    data = recipe.data
    size = f"{data.dataset}, {data.height}x{data.width}, {recipe.optim.steps} steps"
    return f"recipe {recipe.name} ({size})"


def _skipped(grid: "Grid") -> list[str]:
    """A line for each cell, or for each reason why timings are skipped."""
    from mtl_bench.bench.jobs import CELLS

    if grid.kind is CELLS:
        return [f"  skipped: {skip.job.label}: {skip.why}" for skip in grid.skips]
    reasons = [skip.why for skip in grid.skips]
    return [f"  skipped {reasons.count(why)}: {why}" for why in dict.fromkeys(reasons)]


def _gpus(grid: "Grid", device: o.Device, each: int = 1) -> tuple[str, ...]:
    """What cells are spread over, `each` a cell; a timing takes the GPU that it would take in a
    terminal."""
    from mtl_bench.bench.jobs import CELLS
    from mtl_bench.bench.launch import gpu_pool, together
    from mtl_bench.core.device import choose_device

    if grid.kind is not CELLS or choose_device(device.value).type != "cuda":
        return ()
    import torch

    pool = gpu_pool(os.environ.get("CUDA_VISIBLE_DEVICES"), torch.cuda.device_count())
    return together(pool, each)


def _side_by_side(grid: "Grid", todo: "Sequence[Job]", gpus: Sequence[str], each: int = 1) -> int:
    """A cell a GPU. Without one a cell a core: two processes of one thread do more steps than one
    of two."""
    from mtl_bench.bench.jobs import CELLS, kind_of
    from mtl_bench.core.provenance import cores

    if grid.kind is not CELLS:
        return 1
    trained = sum(kind_of(job).work(job) > 0 for job in todo) or 1
    return min(len(gpus) or max(1, cores() // each), trained)


def _run(
    grid: "Grid",
    todo: "Sequence[Job]",
    runs: Path,
    data: Path | None,
    given: "Data",
    options: list[str],
    device: o.Device,
    jobs: int,
    gpus: Sequence[str],
    each: int,
    rerun: str | None,
    quiet: bool,
) -> None:
    """Render what is missing first, once, so that cells side by side find it; then run them."""
    from mtl_bench.bench import jobs as kinds
    from mtl_bench.bench.launch import Launcher
    from mtl_bench.cli import display

    cells = [job for job in todo if isinstance(job, Cell)]
    roots = {cell.recipe.data: o.data_root(cell, data, quiet) for cell in cells}
    passed_on = ["--device", device.value, *options, *(["--quiet"] if quiet else [])]
    passed_on += ["--ranks", str(each)] if each > 1 else []

    def of_cell(cell: Cell) -> list[str]:
        return kinds.cell_command(cell, runs, roots[cell.recipe.data], passed_on)

    def of_timing(timing: "Timing", file: Path) -> list[str]:
        return kinds.timing_command(timing, file, data)

    command = of_cell if grid.kind is kinds.CELLS else of_timing
    bars = grid.kind is kinds.CELLS  # which would draw while something is timed
    names = _named(grid, runs)[1]
    with display.choose(len(todo), quiet, bars) as shown:
        launcher = Launcher(
            *(runs, command, shown, jobs, rerun, names),
            smoke=grid.smoke,
            data=given,
            gpus=gpus,
            ranks=each,
        )
        launcher.run(todo)


def _rows(grid: "Grid", runs: Path, data: "Data | None" = None) -> list[dict[str, Any]]:
    """One row a job; of cells with their deltas to the stored row of their baseline."""
    from mtl_bench.bench import references, store, tuning

    if grid.tune is None:
        rows = store.rows(grid.jobs, runs, grid.names, data)
    else:
        rows, against = tuning.results(grid, runs, data)
    if not grid.baseline:
        return rows
    from mtl_bench.report.delta import with_delta

    if grid.tune is not None:
        return with_delta(rows, lambda row: against.get(row["cell_id"]))
    return with_delta(rows, lambda row: references.baseline_row(grid, row, runs))


def _write(
    grid: "Grid", rows: list[dict[str, Any]], runs: Path, reports: Path, command: str
) -> Path:
    from mtl_bench.bench import references, tuning
    from mtl_bench.bench.jobs import CELLS

    out = reports / grid.name
    if grid.kind is CELLS:
        from mtl_bench.report import grid as of_cells

        trivial = references.trivial(grid, runs)
        tried = tuning.tried(grid, runs) if grid.tune is not None else ()
        return of_cells.build(grid, rows, out, runs, trivial, command, tried)
    from mtl_bench.report import latency as of_timings

    return of_timings.build(grid, rows, out, references.quality(grid, runs), command)


def _write_table(name: str, choice: Choice | None, runs: Path, reports: Path, smoke: bool) -> None:
    """Measured rows among the published ones of a comparison; say where, and what it lacks.

    Args:
        choice: whose rows; None: those of all cells in `runs`.
        smoke: smoke rows alone, in a folder of their own.

    Raises:
        ValueError: no such table, or a damaged row.
    """
    from mtl_bench.bench import references, store
    from mtl_bench.report import literature

    known = literature.load(name)
    if choice is None:
        rows = store.all_rows(runs)
        command = shlex.join(["mtl-bench", "report", "--table", name, *["--smoke"] * smoke])
    else:
        grid = choice.load()
        rows = store.rows(grid.cells, runs)
        if known.has_deltas and grid.baseline:
            rows += references.baseline_rows(grid, runs)
        command = choice.command.replace("ablate", f"report --table {name}", 1)
    table = literature.compare(known, rows, smoke)
    page = literature.write(table, reports / f"tables-{name}{'-smoke' * smoke}", command)
    if not table.measured:
        kind = "finished smoke cell" if smoke else "finished cell"
        typer.echo(f"no {kind} in '{runs}' belongs to table '{name}': published rows only")
    typer.echo(str(page))
