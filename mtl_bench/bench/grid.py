"""A grid file -> ordered jobs: axes, named rows, skips with their reasons, how to tabulate them.

    question = "What does the page answer?"
    recipe = "small"                # by name, or the path of a recipe file

    [axes]                          # their product, the first axis slowest
    backbone = ["a", "b"]           # or "all": every plug-in of the kind
    seed = [0, 1]
    "method.alpha" = [0.5, 1.5]     # any key that --set takes; with a dot in it, it is quoted

    [[row]]                         # each point of the axes gives one cell a row, in this order
    name = "Halved"                 # what the report calls it
    method = "c"                    # any such keys, but none of the axes
    "method.weights" = { center = 100, offset = 0.005 }

    [[row]]
    name = "Continued, and twice as long"
    method = "d"
    video = true
    "recipe.optim.steps" = "2x"     # times the recipe's number, whatever the recipe is

    [[skip]]                        # jobs that have all these values
    backbone = "b"
    why = "the reason, shown in the report"

    [baseline]                      # what turns a cell into the one that its delta is against
    method = "c"
    single_task = true

    [report]                        # read by mtl_bench/report
    rows = "name"                   # or an axis
    control = "Halved"              # the line that every other is tested against

    [tune]                          # trials of every line; see mtl_bench/bench/tuning.py
    trials = 6
    seeds = [100]                   # none of the grid's
    [tune.space]                    # beside it, what each method declares; see bench/space.py
    "recipe.optim.lr" = { log = ["0.1x", "10x"] }

Several problems stand in place of `recipe`, each with its recipe's backbone where neither axes nor
rows say one, or with settings of its own:

    suite = ["a", "b", { recipe = "c", backbone = "d", "recipe.data.val_scenes" = 200 }]

`method` and `backbone` stand in the axes or in every row; a file without [[row]] is the axes alone.
Keys of a row: method, backbone, tasks, seed, video, single_task, granularity, pretrained, replay,
recipe, recipe.SECTION.KEY, method.KEY, backbone.KEY. Under [baseline] a cell keeps recipe, backbone
and seed, and nothing else of its own. A wrong key is told with its line. `replay` trains a row with
the weights that its method logged, whose own run need not be in the grid: see train/replay.py.

A grid of timings says which networks to time, at which sizes, on which engines:

    kind = "latency"
    question = "What does the page answer?"

    [axes]
    backbone = ["a", "b"]
    size = ["1024x2048"]            # height x width, pixels
    tasks = [["x", "y"], ["x"]]
    engine = ["plain", "eager"]     # "plain" is what speed-ups are over
    precision = ["fp32", "bf16"]

    [[skip]]
    backbone = "b"
    precision = ["bf16", "fp16"]    # a list: any of these
    why = "the reason, shown in the report"

    [smoke]                         # what stands in place of all this with --smoke
    size = ["64x128"]
    passes = 3

    [weights]                       # of a backbone: a folder in runs/; those of others are random
    a = "runs/fixed-a-s0-0123456789ab"

    [quality]                       # whose quality the plots set beside the speed
    grid = "backbones"
    recipe = "small"

There, any value can be set with --set: an axis to one value (engine=plain), passes, seconds,
device, recipe, backbone.KEY of the plug-in, weights.BACKBONE, quality.recipe. A precision that an
engine does not have on the device is skipped.
"""

import functools
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from mtl_bench.bench import sections
from mtl_bench.bench.jobs import (
    CELLS,
    NOTHING,
    TIMINGS,
    Job,
    Kind,
    Timing,
    load_cell,
    recipe_of,
)
from mtl_bench.bench.space import TIMES, Tune, times
from mtl_bench.core import plugins, toml_file
from mtl_bench.core.config import (
    Cell,
    Latency,
    Recipe,
    load_recipe,
    override,
    parse_settings,
    set_values,
)
from mtl_bench.core.plain import did_you_mean, from_dict, to_dict
from mtl_bench.core.toml_file import Place, TomlFile
from mtl_bench.deploy import engines

GRIDS = Path(__file__).parent / "grids"
MOST = 10_000  # points of one grid: each takes a millisecond to look at, again and again
MANY = 1000  # of which the number is said before
SMOKE_STEPS = 6
AXES = ("backbone", "size", "tasks", "engine", "precision")  # of timings
Values: TypeAlias = Mapping[str, Any]
FORMS: dict[type, str] = {
    str: '{} = "text"',
    dict: "[{}], a section",
    list: "[[{}]], two brackets on each side",
}


@dataclass(frozen=True)
class Skip:
    job: Job
    why: str

    @property
    def cell(self) -> Job:  # as the report of cells calls it
        return self.job


@dataclass(frozen=True, eq=False)
class Grid:
    """A named set of jobs of one kind and how to tabulate them."""

    name: str  # of its folder in reports/; ends in -smoke for a smoke run
    question: str
    kind: Kind[Any]
    recipe: Recipe | str  # of timings its name: whose network; of a suite all names
    axes: Mapping[str, tuple[Any, ...]]
    jobs: tuple[Any, ...]
    skips: tuple[Skip, ...] = ()
    smoke: bool = False
    report: Values = field(default_factory=lambda: NOTHING)
    names: Mapping[str, str] = field(default_factory=lambda: NOTHING)  # cell id -> its row's
    baseline: Values = field(default_factory=lambda: NOTHING)  # see baseline_cell
    quality: Values = field(default_factory=lambda: NOTHING)  # grid, recipe
    tune: Tune | None = None  # see `tuning`

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Its jobs.

        Raises:
            ValueError: they are timings.
        """
        if self.kind is not CELLS:
            raise ValueError(f"grid '{self.name}' times networks: it has no cells to train")
        return self.jobs


def baseline_cell(cell: Cell, settings: Values) -> Cell:
    """What a cell's delta is against: its recipe, backbone and seed under a grid's [baseline]."""
    plain = replace(
        cell,
        tasks=cell.recipe.tasks,
        replay=None,
        video=False,
        single_task=False,
        granularity="terms",
        method_args=NOTHING,
    )
    return set_values(plain, settings)


def load_grid(
    name: str,
    *,
    recipe: str | None = None,
    seeds: int | None = None,
    smoke: bool = False,
    settings: Sequence[str] = (),
    pretrained: str | None = None,
    device: str = "cpu",
    say: Callable[[str], None] = print,
) -> Grid:
    """A shipped grid by name, or a user's by the path of its TOML file.

    Args:
        recipe: in place of the grid's; where it has a backbone of its own, that, too.
        seeds: seeds 0 .. seeds - 1 in place of the grid's.
        smoke: the file's `smoke_recipe` (without one: `smoke`) or its [smoke], or some steps of
            `recipe`, of a suite or of what is tuned, under a name that says so.
        settings: `key=value` for every job; stands in place of an axis or of a row's value, and is
            what a row's "2x" multiplies.
        pretrained: as in `Cell`, for every cell.
        device: auto | cpu | cuda, of timings, where no setting says another.
        say: is told the number of points where they take their time.

    Raises:
        ValueError: no such grid, or a key or value that it cannot have, with file and line.
    """
    file = read(name)
    if kind_of(file) is CELLS:
        return _of_cells(file, recipe, seeds, smoke, settings, pretrained, say)
    for option, value in (("--seeds", seeds), ("--pretrained", pretrained)):
        if value is not None:
            raise ValueError(f"{option} {value}: grid '{name}' times, and trains nothing")
    return _of_timings(file, recipe, smoke, settings, device, say)


# --- the file -------------------------------------------------------------------------------------

SHARED: dict[str, type] = {"kind": str, "question": str, "axes": dict, "skip": list}
KINDS: dict[str, tuple[Kind[Any], dict[str, type]]] = {  # a file's `kind` -> its keys
    "training": (
        CELLS,
        {
            **{"recipe": str, "smoke_recipe": str, "suite": list, "row": list},
            **{"baseline": dict, "tune": dict, "report": dict},
        },
    ),
    "latency": (TIMINGS, {"smoke": dict, "weights": dict, "quality": dict}),
}


def grid_names() -> list[str]:
    return sorted(path.stem for path in GRIDS.glob("*.toml"))


def kind_of(file: TomlFile) -> Kind[Any]:
    """What a grid is of."""
    return KINDS[file.values.get("kind", "training")][0]


def question_of(name: str) -> str:
    """What a grid asks, without expanding it."""
    return str(read(name).values.get("question", ""))


def read(name: str) -> TomlFile:
    """Find and read a grid file; its keys are known ones and of the right form.

    Raises:
        ValueError: no such grid, or a key that its kind of file cannot have, with its line.
    """
    path = Path(name) if name.endswith(".toml") else GRIDS / f"{name}.toml"
    if not path.is_file():
        hint = "" if name.endswith(".toml") else did_you_mean(name, grid_names())
        raise ValueError(f"no grid called '{name}'{hint}; a file of your own: --grid PATH.toml")
    file = toml_file.read(path)
    kind = str(file.values.get("kind", "training"))
    if kind not in KINDS:
        raise file.error(f"no kind of grid '{kind}'{did_you_mean(kind, KINDS)}", "kind", ("", 0))
    keys = SHARED | KINDS[kind][1]
    for key, value in file.values.items():
        wrong = f"unknown key '{key}'{did_you_mean(key, keys)}" if key not in keys else ""
        if not wrong and not isinstance(value, keys[key]):
            wrong = f"write it as {FORMS[keys[key]].format(key)}"
        if wrong:
            raise file.error(wrong, key, ("", 0), (key, 0))
    file.refuse_sections_in("axes", "row", "skip", "baseline", "smoke", "weights")
    for index, rule in enumerate(file.values.get("skip", [])):
        if not isinstance(rule.get("why"), str):
            raise file.error("a [[skip]] needs its reason: why = '...'", "", ("skip", index))
    return file


def _axes(file: TomlFile) -> dict[str, tuple[Any, ...]]:
    """Each axis and its values; "all" is every plug-in of the axis's kind.

    Raises:
        ValueError: an axis without a list of values, with its line.
    """
    found: dict[str, tuple[Any, ...]] = {}
    for axis, values in file.values.get("axes", {}).items():
        if values == "all" and f"{axis}s" in plugins.KINDS:
            values = list(plugins.files(f"{axis}s"))
        if not isinstance(values, list) or not values:
            message = f"axis '{axis}' is a list of values, not {values!r}"
            raise file.error(message, axis, ("axes", 0))
        found[axis] = tuple(values)
    return found


# --- expanding ------------------------------------------------------------------------------------


class Points(ABC):
    """What a kind of job makes of a grid's points."""

    file: TomlFile

    @abstractmethod
    def make(self, values: dict[str, Any], row: int) -> Job:
        """The job of a point of the axes and a row."""

    @abstractmethod
    def matches(self, rule: Values, job: Any) -> bool:
        """Whether a job has every value that a skip names."""

    def lack(self, job: Any) -> str | None:
        """Why a job cannot be, whatever the file skips."""
        return None


def _grid(
    points: Points,
    axes: Mapping[str, tuple[Any, ...]],
    say: Callable[[str], None],
    *,
    smoke: bool,
    **more: Any,
) -> Grid:
    """The product of axes and rows, less the skips; equal jobs count once."""
    file = points.file
    rows: list[Values] = file.values.get("row", [])
    count = math.prod(map(len, axes.values())) * max(len(rows), 1)
    if count > MOST:
        raise ValueError(
            f"{file.path}: {count} {kind_of(file).noun}s, and a grid may have {MOST}; take values "
            f"out, or make several grids of it"
        )
    if count > MANY:
        say(f"{file.path.stem}: {count} {kind_of(file).noun}s")
    rules = file.values.get("skip", [])
    jobs: dict[str, Job] = {}
    skips: dict[str, Skip] = {}
    names: dict[str, str] = {}
    product = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    for point, (index, row) in itertools.product(product, enumerate(rows or [NOTHING])):
        values = {key: value for key, value in {**point, **row}.items() if key != "name"}
        job = points.make(values, index)
        why = next((rule["why"] for rule in rules if points.matches(_values(rule), job)), None)
        why = why or points.lack(job)
        if why is not None:
            skips.setdefault(job.id, Skip(job, why))
            continue
        jobs.setdefault(job.id, job)
        if rows and names.setdefault(job.id, row["name"]) != row["name"]:
            message = f"rows '{names[job.id]}' and '{row['name']}' are the same cell"
            raise file.error(message, "name", ("row", index))
    return Grid(
        name=f"{file.path.stem}-smoke" if smoke else file.path.stem,
        question=str(file.values.get("question", "")),
        kind=kind_of(file),
        axes=MappingProxyType(dict(axes)),
        jobs=tuple(jobs.values()),
        skips=tuple(skips.values()),
        smoke=smoke,
        report=MappingProxyType(file.values.get("report", {})),
        names=MappingProxyType(names),
        **more,
    )


def _values(rule: Values) -> Values:
    return {key: value for key, value in rule.items() if key != "why"}


# --- cells ----------------------------------------------------------------------------------------


def _of_cells(
    file: TomlFile,
    recipe: str | None,
    seeds: int | None,
    smoke: bool,
    settings: Sequence[str],
    pretrained: str | None,
    say: Callable[[str], None],
) -> Grid:
    axes = _axes(file)
    tune = sections.tune(file, smoke)
    if seeds is not None:
        if seeds < 1:
            raise ValueError(f"{seeds} seeds: at least 1 is needed")
        axes["seed"] = tuple(range(seeds))
    elif smoke and tune is not None:
        axes["seed"] = axes.get("seed", (0,))[:1]
    suite = sections.suite(file, recipe)
    sections.check_rows(file, axes, suite)
    shortened = smoke and (recipe or suite or (tune and "smoke_recipe" not in file.values))
    apart = smoke and not shortened
    key, otherwise = ("smoke_recipe", "smoke") if apart else ("recipe", "small")
    first = next(iter(suite), None)
    start = load_recipe(first or recipe or str(file.values.get(key, otherwise)))
    start = _smoke_of(start) if shortened else start
    if recipe and start.backbone and not suite:
        settings = [f"backbone={start.backbone}", *settings]
    given = {setting.partition("=")[0].strip() for setting in settings}
    given |= {"recipe"} if smoke or recipe else set()
    axes = {axis: values for axis, values in axes.items() if axis not in given}
    axes = {"recipe": tuple(suite), **axes} if suite else axes
    for row in file.values.get("row", []) if "recipe" in given else ():
        row.pop("recipe", None)
    points = _CellPoints(file, Cell(start, "", "", pretrained=pretrained), settings, suite, smoke)
    for index, rule in enumerate(file.values.get("skip", [])):
        for key, value in _values(rule).items():
            points.set(points.start, {key: value}, ("skip", index))
    baseline = file.values.get("baseline", {})
    grid = _grid(
        points,
        axes,
        say,
        smoke=smoke,
        recipe=", ".join(suite) or points.start.recipe,
        baseline=MappingProxyType(baseline),
        tune=tune,
    )
    points.set(points.start, baseline, ("baseline", 0))
    if tune is not None and grid.jobs:
        sections.check_tuned(file, grid.jobs, tune, points.set)
    return grid


def _smoke_of(recipe: Recipe) -> Recipe:
    """A recipe for as many steps as show that it runs."""
    optim = replace(recipe.optim, steps=SMOKE_STEPS, warmup_steps=2)
    return replace(recipe, smoke=True, optim=optim, latency=Latency(passes=5, warmup=1))


@dataclass(frozen=True)
class _CellPoints(Points):
    file: TomlFile
    start: Cell
    settings: Sequence[str]
    suite: Mapping[str, Values] = field(default_factory=lambda: NOTHING)
    smoke: bool = False
    load: Callable[[str], Recipe] = field(default_factory=lambda: functools.cache(load_recipe))

    def make(self, values: dict[str, Any], row: int) -> Cell:
        """Its values, then `--set`, then what multiplies a number."""
        places: tuple[Place, ...] = (("row", row), ("axes", 0))
        start = self.start
        recipe = values.pop("recipe", None)
        if recipe is not None:
            try:
                loaded = self.load(str(recipe))
            except ValueError as error:
                raise self.file.error(str(error), "recipe", *places) from error
            if recipe in self.suite:
                loaded = _smoke_of(loaded) if self.smoke else loaded
                values = {"backbone": loaded.backbone, **self.suite[recipe], **values}
                places = (*places, ("", 0))
            start = replace(start, recipe=loaded, tasks=())
        factors = {k: v for k, v in values.items() if isinstance(v, str) and TIMES.fullmatch(v)}
        plain = {key: value for key, value in values.items() if key not in factors}
        cell = override(self.set(start, plain, *places), self.settings)
        if not cell.backbone:
            message = (
                f'recipe {recipe} names no backbone: {{ recipe = "{recipe}", backbone = "NAME" }}'
            )
            raise self.file.error(message, "suite", ("", 0))
        return self.set(cell, {k: times(cell, k, v) for k, v in factors.items()}, *places)

    def matches(self, rule: Values, job: Cell) -> bool:
        try:
            return set_values(job, rule).id == job.id
        except ValueError:  # values that this cell cannot have together with its own
            return False

    def set(self, cell: Cell, values: Values, *places: Place) -> Cell:
        """Set all at once; a mistake is looked for key by key, and told with its line."""
        try:
            return set_values(cell, values)
        except ValueError as error:
            for key, value in values.items():
                try:
                    set_values(cell, {key: value})
                except ValueError as own:
                    raise self.file.error(str(own), key, *places) from own
            raise self.file.error(str(error), "", *places) from error


# --- timings --------------------------------------------------------------------------------------


def _of_timings(
    file: TomlFile,
    recipe: str | None,
    smoke: bool,
    settings: Sequence[str],
    device: str,
    say: Callable[[str], None],
) -> Grid:
    if device == "auto":
        from mtl_bench.core.device import choose_device

        device = choose_device(device).type
    changes = dict(file.values.get("smoke", {})) if smoke else {}
    changes |= {} if recipe is None else {"recipe": recipe}
    changes |= parse_settings(settings)
    weights = dict(file.values.get("weights", {})) | _section(changes, "weights")
    quality = dict(file.values.get("quality", {})) | _section(changes, "quality")
    fixed = {"device": device} | {k: v for k, v in changes.items() if not _is_axis(k, v)}
    axes = _axes(file)
    for axis in axes:
        if axis not in AXES:
            raise file.error(f"unknown axis '{axis}'{did_you_mean(axis, AXES)}", axis, ("axes", 0))
    axes = {axis: values for axis, values in axes.items() if axis not in fixed}
    axes |= {axis: tuple(v) for axis, v in changes.items() if axis not in fixed}
    for key in ("backbone", "engine"):
        if key not in axes and key not in fixed:
            raise file.error(f"axis '{key}' is missing", "", ("axes", 0))
    known = Timing.__dataclass_fields__
    for index, rule in enumerate(file.values.get("skip", [])):
        for key in _values(rule).keys() - known.keys():
            message = f"unknown key '{key}'{did_you_mean(key, known)}"
            raise file.error(message, key, ("skip", index))
    points = _TimingPoints(file, fixed, weights)
    more = {"recipe": Timing.recipe, "quality": MappingProxyType(quality)}
    grid = _grid(points, axes, say, smoke=smoke, **more)
    return replace(grid, recipe=grid.jobs[0].recipe) if grid.jobs else grid


def _is_axis(key: str, value: Any) -> bool:
    """Whether a setting is several values; `tasks` is a list itself."""
    return isinstance(value, list) and (key != "tasks" or isinstance(value[0], list))


def _section(changes: dict[str, Any], name: str) -> dict[str, str]:
    """Take `name.KEY` out of the settings."""
    keys = [key for key in changes if key.startswith(f"{name}.")]
    return {key.removeprefix(f"{name}."): str(changes.pop(key)) for key in keys}


@dataclass(frozen=True)
class _TimingPoints(Points):
    file: TomlFile
    fixed: Values
    weights: Mapping[str, str]  # backbone -> folder in runs/

    def make(self, values: dict[str, Any], row: int) -> Timing:
        point = {**self.fixed, **values}
        own = {key: value for key, value in point.items() if not key.startswith("backbone.")}
        arguments = {key.removeprefix("backbone."): point[key] for key in point.keys() - own.keys()}
        try:
            timing = from_dict(Timing, own | ({"backbone_args": arguments} if arguments else {}))
        except ValueError as error:
            for axis in AXES:
                if f"'{axis}'" in str(error):
                    raise self.file.error(str(error), axis, ("axes", 0), ("smoke", 0)) from error
            raise
        return self._with_weights(timing)

    def _with_weights(self, timing: Timing) -> Timing:
        """With the folder of trained weights that its backbone has.

        Raises:
            ValueError: they are of another backbone, other tasks or other network sizes.
        """
        if timing.backbone not in self.weights:
            return timing
        folder = self.weights[timing.backbone]
        cell = load_cell(Path(folder) / "cell.json")
        lacks = [task for task in timing.tasks if task not in cell.tasks]
        wrong = ""
        if cell.backbone != timing.backbone:
            wrong = f"trained {cell.backbone}"
        elif cell.single_task or lacks:
            wrong = f"has no one network for the tasks {', '.join(timing.tasks)}"
        elif cell.recipe.network != recipe_of(timing).network:
            wrong = f"has another network: time it with --set recipe={cell.recipe.name}"
        if wrong:
            raise ValueError(f"weights.{timing.backbone}: {folder} {wrong}")
        return replace(timing, weights=folder)

    def matches(self, rule: Values, job: Timing) -> bool:
        """A rule may name several values for a key, any of which the timing has."""
        own = to_dict(job)
        return all(
            own[key] in value if _is_axis(key, value) else own[key] == value
            for key, value in rule.items()
        )

    def lack(self, job: Timing) -> str | None:
        """An engine that the kind of device lacks keeps one line, in fp32."""
        if job.engine not in plugins.files("engines"):
            return None  # `Timings.check` says so
        has = engines.facts(job.engine).precisions
        if job.precision in has.get(job.device, ("fp32",)):
            return None
        return f"{job.engine} has no {job.precision} on {job.device}"
