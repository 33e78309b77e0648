"""What a grid is made of: jobs, which are cells (see `core.config`) or timings.

A job has an id, a label, a slug (where its files are in runs/) and parents (jobs that it needs
first). Everything else in which the two kinds differ is asked of `kind_of(job)`.
"""

import hashlib
import json
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Generic, TypeAlias, TypeVar

from mtl_bench.core import plugins, provenance
from mtl_bench.core.columns import FPS
from mtl_bench.core.config import (
    Cell,
    Recipe,
    check_cells,
    check_tasks,
    leave_out_defaults,
    load_recipe,
)
from mtl_bench.core.files import read_json
from mtl_bench.core.fingerprint import STAGES, Root, fingerprints, of_package
from mtl_bench.core.plain import (
    DISTINCT,
    SOME,
    Checked,
    did_you_mean,
    from_dict,
    one_of,
    to_dict,
)
from mtl_bench.core.quality import in_brief
from mtl_bench.core.recipe import Count, Positive
from mtl_bench.deploy import engines

PROTOCOL = 1  # raised when times taken before stop being comparable with times taken after
NOTHING: Mapping[str, Any] = MappingProxyType({})
AFTERWARDS = ("eval_s", "latency_s")  # a row's times of what comes after training
# Of `config.LATER`, what timings have had from their first day
KEPT = (("evaluate", "protocol"), ("evaluate", "also"), ("evaluate", "flip"))
SIZE = re.compile(r"([1-9]\d*)x([1-9]\d*)")


@dataclass(frozen=True)
class Timing(Checked):
    """One network on one engine at one size: what `mtl-bench latency` measures at a time.

    Raises:
        ValueError: a size that is not HxW.
    """

    backbone: Annotated[str, plugins.IS_NAME, "its name, see `list backbones`"]
    engine: Annotated[str, plugins.IS_NAME, "its name, see `list engines`"]
    precision: Annotated[str, "fp32, or what the engine has beside it"] = "fp32"
    size: Annotated[str, "height x width of the image, pixels"] = "1024x2048"
    tasks: Annotated[
        tuple[Annotated[str, plugins.IS_TASK], ...], SOME, DISTINCT, "whose heads are timed"
    ] = Recipe.tasks
    device: Annotated[str, one_of("cpu", "cuda"), "the kind; its name stands in the row"] = "cpu"
    passes: Annotated[Count, "timed ones; the paper's are 500"] = 500
    seconds: Annotated[Positive | None, "ends the passes early"] = None
    recipe: Annotated[
        str, "the network's sizes behind the backbone; paper: the defaults of all"
    ] = "paper"
    weights: str | None = None  # folder of the run that trained them; None: random
    backbone_args: Mapping[str, Any] = field(default_factory=lambda: NOTHING)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not SIZE.fullmatch(self.size):
            raise ValueError(f"size '{self.size}' is not HxW, such as 1024x2048")

    @property
    def height(self) -> int:
        return int(self.size.partition("x")[0])

    @property
    def width(self) -> int:
        return int(self.size.partition("x")[2])

    @property
    def parents(self) -> tuple[Cell, ...]:
        return ()

    @property
    def id(self) -> str:
        """12 hexadecimal digits of the canonical JSON."""
        return hashlib.sha256(canonical_json(self).encode()).hexdigest()[:12]

    @property
    def slug(self) -> str:
        return f"latency/{self.id}"

    @property
    def words(self) -> tuple[str, ...]:
        """What tells it from the others of a grid."""
        arguments = [f"{key}={value}" for key, value in self.backbone_args.items()]
        named = " ".join([self.backbone, *arguments])
        return named, ",".join(self.tasks), self.size, self.engine, self.precision

    @property
    def label(self) -> str:
        return " ".join(self.words)


Job: TypeAlias = Cell | Timing
J = TypeVar("J", Cell, Timing)


def canonical_json(timing: Timing) -> str:
    """What makes the number: the recipe by its values, the weights by the cell that trained them.

    Neither the number of threads nor the device's name: they are in the row.
    """
    recipe = to_dict(recipe_of(timing))
    values = to_dict(timing) | {key: recipe[key] for key in ("network", "evaluate")}
    leave_out_defaults(values, KEPT)
    del values["recipe"]
    if timing.weights is not None:
        values["weights"] = load_cell(Path(timing.weights) / "cell.json").id
    return json.dumps({"protocol": PROTOCOL, **values}, sort_keys=True, separators=(",", ":"))


def recipe_of(timing: Timing) -> Recipe:
    return Recipe() if timing.recipe == Recipe().name else load_recipe(timing.recipe)


def load_cell(path: Path) -> Cell:
    """The cell of a `cell.json`.

    Raises:
        ValueError: no such file, or not a cell.
    """
    values = read_json(path)
    if values is None:
        raise ValueError(f"no cell file '{path}'")
    try:
        return from_dict(Cell, values)
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a cell: {error}") from error


def load_run(path: Path) -> tuple[Cell, Path]:
    """A trained cell and its checkpoint, from a folder in runs/ or the checkpoint alone.

    Raises:
        ValueError: neither is there, or the checkpoint is another cell's.
    """
    if not path.exists():
        raise ValueError(f"no run or checkpoint '{path}'")
    from mtl_bench.train import checkpoint  # takes seconds, for torch

    weights, beside = path / "last.pt", path / "cell.json"
    if not path.is_dir():
        weights, beside = path, path.with_name("cell.json")
        if "cell" in checkpoint.read(weights, lazily=True) or not beside.is_file():
            return checkpoint.cell_of(weights), weights
    cell = load_cell(beside)
    if weights.is_file():
        checkpoint.require(weights, cell)
    return cell, weights


def with_parents(jobs: Iterable[Job]) -> tuple[Job, ...]:
    """The jobs and all that they need, each once and after what it needs."""
    found: dict[str, Job] = {}
    for job in jobs:
        for each in (*with_parents(job.parents), job):
            found.setdefault(each.id, each)
    return tuple(found.values())


# --- the two kinds --------------------------------------------------------------------------------


class Kind(ABC, Generic[J]):
    """In what cells and timings differ: their words, files, code, cost and command."""

    noun: str
    words: tuple[str, ...]  # of a status, in the order of a summary
    good: tuple[str, ...]  # of these; the others make `ablate` end with 1
    unfinished: tuple[str, ...]  # what the next `ablate` runs without being asked
    again: Mapping[str, tuple[str, ...]]  # --rerun -> what it runs beside
    why: str  # the key in a row for what is wrong
    stages: tuple[str, ...]
    owner: tuple[str, ...]  # of what a row says of its job: what tells it from another's
    row: str  # behind a job's slug: its row
    log: str  # and what its process printed

    def row_file(self, job: J, runs: Path) -> Path:
        return runs / f"{job.slug}{self.row}"

    def log_file(self, job: J, runs: Path) -> Path:
        return runs / f"{job.slug}{self.log}"

    def parts(self, job: J) -> dict[str, str]:
        """Part of the code -> what a reader calls it."""
        return {"backbone": f"backbones/{job.backbone}.py"}

    @abstractmethod
    def code(self, job: J) -> provenance.Code:
        """Fingerprints of the code of each of its stages.

        Raises:
            ValueError: a plug-in that is not there, or is no Python.
        """

    @abstractmethod
    def identity(self, job: J) -> dict[str, Any]:
        """What a row says of its job."""

    @abstractmethod
    def headline(self, metric: Mapping[str, Any]) -> str:
        """The first numbers that one wants to see of a row's metrics."""

    @abstractmethod
    def work(self, job: J) -> int:
        """What its duration grows with."""

    @abstractmethod
    def seconds(self, row: Mapping[str, Any], trained: bool = False) -> float:
        """What a row says of its duration, or of what comes after training; 0: nothing."""

    @abstractmethod
    def check(self, jobs: Iterable[J]) -> None:
        """What jobs name exists: plug-ins and their settings.

        Raises:
            ValueError: an unknown one, with the nearest known one.
        """


class Cells(Kind[Cell]):
    noun = "cell"
    words = ("done", "stale", "failed", "interrupted", "running", "missing")
    good = ("done", "stale")
    unfinished = ("missing", "interrupted", "failed", "running")
    again: Mapping[str, tuple[str, ...]] = {
        "stale": ("stale",),
        "failed": (),
        "all": words,
        "latency": ("done", "stale"),
    }
    why = "error"
    stages = STAGES
    owner = ("cell_id",)
    row, log = "/row.json", "/log.txt"

    def code(self, job: Cell) -> provenance.Code:
        return provenance.code(job)

    def parts(self, job: Cell) -> dict[str, str]:
        methods = [f"methods/{name}.py" for name in plugins.part_names(job.method)]
        return {"method": " or ".join(methods), **super().parts(job)}

    def identity(self, job: Cell) -> dict[str, Any]:
        """Rows travel, so a weights file goes without its folder."""
        values = to_dict(job)
        if job.pretrained is not None:
            values["pretrained"] = Path(job.pretrained).name
        if job.continues is not None:
            values["continues"] = job.continues.slug
        if job.replay is None:
            del values["replay"]
        keys = ("method", "backbone", "tasks", "seed", "video", "single_task", "granularity")
        return {
            "cell_id": job.id,
            "slug": job.slug,
            **{key: values[key] for key in (*keys, "pretrained")},
            "recipe": job.recipe.name,
            "smoke": job.recipe.smoke,
            "cell": values,
        }

    def headline(self, metric: Mapping[str, Any]) -> str:
        known = [c for c in (*in_brief(), FPS) if isinstance(metric.get(c.key), (int, float))]
        return "  ".join(f"{c.title} {metric[c.key] * c.scale:.{c.digits}f}" for c in known)

    def work(self, job: Cell) -> int:
        """A single-task cell trains nothing: its row repeats the times of its parents."""
        return 0 if job.single_task else 1

    def seconds(self, row: Mapping[str, Any], trained: bool = False) -> float:
        took = row.get("time", {})
        counted = AFTERWARDS if trained else [key for key in took if key.endswith("_s")]
        return float(sum(took.get(key, 0.0) for key in counted))

    def check(self, jobs: Iterable[Cell]) -> None:
        check_cells(jobs)


class Timings(Kind[Timing]):
    noun = "timing"
    words = ("done", "stale", "wrong", "failed", "unavailable", "missing")
    good = ("done", "stale", "unavailable")  # an engine may be absent
    unfinished = ("missing", "failed", "unavailable")
    again: Mapping[str, tuple[str, ...]] = {
        "stale": ("stale",),
        "failed": ("wrong",),
        "all": words,
        "latency": words,
    }
    why = "why"
    stages = ("time",)
    owner = ("backbone", "tasks", "engine", "precision", "height", "width")
    row, log = ".json", ".log"

    def code(self, job: Timing) -> provenance.Code:
        return {"time": fingerprints("time", roots(job))}

    def identity(self, job: Timing) -> dict[str, Any]:
        return {
            "kind": "latency",
            "backbone": job.backbone,
            "tasks": list(job.tasks),
            "engine": job.engine,
            "precision": job.precision,
            "height": job.height,
            "width": job.width,
            "timing": to_dict(job),
        }

    def headline(self, metric: Mapping[str, Any]) -> str:
        if not {"latency.mean_ms", "latency.fps"} <= metric.keys():
            return ""
        noisy = "  noisy" * bool(metric.get("latency.noisy"))
        return f"{metric['latency.mean_ms']:.1f} ms  FPS {metric['latency.fps']:.1f}{noisy}"

    def work(self, job: Timing) -> int:
        """Passes and pixels; a limit of seconds is not looked at."""
        return job.passes * job.height * job.width

    def seconds(self, row: Mapping[str, Any], trained: bool = False) -> float:
        return float(row["seconds"]) if row["status"] == "done" else 0.0

    def check(self, jobs: Iterable[Timing]) -> None:
        for timing in jobs:
            plugins.path_of("engines", timing.engine)
            check_tasks(timing.tasks)
            plugins.path_of("backbones", timing.backbone)
            arguments = timing.backbone_args
            known = plugins.arguments("backbones", timing.backbone) if arguments else {}
            for key in arguments.keys() - known.keys():
                hint = did_you_mean(key, known)
                raise ValueError(f"backbone '{timing.backbone}' has no '{key}'{hint}")


CELLS, TIMINGS = Cells(), Timings()


def kind_of(job: Job) -> Kind[Any]:
    return TIMINGS if isinstance(job, Timing) else CELLS


# --- of timings -----------------------------------------------------------------------------------


def roots(timing: Timing) -> list[Root]:
    """Of its network and frames only shapes count: training and data sets do not."""
    return [
        provenance.backbone_root(timing.backbone),
        provenance.plugin_root("engines", timing.engine),
        *(provenance.plugin_root("tasks", task) for task in timing.tasks),
        Root(of_package("deploy.timer"), ("row",)),
        Root(of_package("deploy.subject"), ("subject",)),
        Root(of_package("model.network"), ("build_model", "side_by_side")),
    ]


def lack(timing: Timing) -> str | None:
    """Why a timing cannot be taken here, and what would change that; None where it can."""
    why = engines.available(timing.engine)
    if why is None:
        try:
            engines.check(timing.engine, timing.precision, timing.device)
        except ValueError as error:
            return str(error)
    return why


# --- commands -------------------------------------------------------------------------------------


def cell_command(cell: Cell, runs: Path, data: Path, options: Sequence[str] = ()) -> list[str]:
    """What runs a cell, here or in a terminal."""
    file = runs / cell.slug / "cell.json"
    command = [sys.executable, "-m", "mtl_bench", "train", str(file)]
    return [*command, "--runs", str(runs), "--data", str(data), *options]


def timing_command(timing: Timing, file: Path, data: Path | None = None) -> list[str]:
    """What takes a timing, here or in a terminal, and writes its row to `file`."""
    words = ["--engine", timing.engine, "--precision", timing.precision, "--size", timing.size]
    words += ["--tasks", ",".join(timing.tasks), "--passes", str(timing.passes)]
    words += [] if timing.seconds is None else ["--seconds", str(timing.seconds)]
    if timing.weights is not None:
        words += ["--checkpoint", str(Path(timing.weights) / "last.pt")]
    else:
        words += ["--backbone", timing.backbone]
        words += [] if timing.recipe == Recipe().name else ["--recipe", timing.recipe]
        for key, value in timing.backbone_args.items():
            words += ["--set", f"backbone.{key}={json.dumps(value)}"]
    words += ["--device", timing.device, *(["--data", str(data)] if data is not None else [])]
    return [sys.executable, "-m", "mtl_bench", "latency", *words, "--json", str(file)]
