"""A grid of kind "latency": which networks to time, at which sizes, on which engines.

    kind = "latency"
    question = "What does the page answer?"

    [axes]                          # their product, the first axis slowest
    backbone = ["a", "b"]           # or "all": every plug-in
    size = ["1024x2048"]            # height x width, pixels
    tasks = [["panoptic", "depth"], ["panoptic"]]
    engine = ["plain", "eager"]     # "plain" is what speed-ups are over
    precision = ["fp32", "bf16"]

    [[skip]]                        # timings that have all these values; a list: any of these
    backbone = "b"
    precision = ["bf16", "fp16"]
    why = "the reason, shown in the report"

    [smoke]                         # what stands in place of all this with --smoke
    size = ["64x128"]
    passes = 3

    [weights]                       # of a backbone: a folder in runs/; those of others are random
    a = "runs/fixed-a-s0-0123456789ab"

    [quality]                       # whose quality the plots set beside the speed
    grid = "backbones"
    recipe = "small"

Any value can be set with --set: an axis to one value (engine=plain), passes, seconds, device,
recipe, backbone.KEY of the plug-in, weights.BACKBONE, quality.recipe. A precision that an engine
does not have on the device is skipped.
"""

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mtl_bench import engines
from mtl_bench.bench import grid_file, results
from mtl_bench.bench.timing import Timing, recipe_of
from mtl_bench.core.config import Recipe
from mtl_bench.core.plain import did_you_mean, from_dict, to_dict
from mtl_bench.core.toml_file import TomlFile

AXES = ("backbone", "size", "tasks", "engine", "precision")
NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Skip:
    timing: Timing
    why: str


@dataclass(frozen=True)
class LatencyGrid:
    """A named set of timings."""

    name: str  # of its folder in reports/; ends in -smoke for a smoke run
    question: str
    axes: Mapping[str, tuple[Any, ...]]
    timings: tuple[Timing, ...]
    skips: tuple[Skip, ...] = ()
    smoke: bool = False
    quality: Mapping[str, str] = field(default_factory=lambda: NOTHING)  # grid, recipe
    report: Mapping[str, Any] = field(default_factory=lambda: NOTHING)

    @property
    def recipe(self) -> str:
        return self.timings[0].recipe if self.timings else Recipe().name


def load(
    name: str, *, smoke: bool = False, settings: Sequence[str] = (), device: str = "cpu"
) -> LatencyGrid:
    """A shipped grid by name, or a user's by the path of its TOML file.

    Args:
        smoke: the file's [smoke] in place of its axes and values, under a name that says so.
        settings: `key=value`, as the module's text says.
        device: cpu | cuda, where no setting says another.

    Raises:
        ValueError: no such grid, or a key or value that it cannot have, with file and line.
    """
    file = grid_file.read(name)
    changes = dict(file.values.get("smoke", {})) if smoke else {}
    changes |= parse(settings)
    weights = dict(file.values.get("weights", {})) | _section(changes, "weights")
    quality = dict(file.values.get("quality", {})) | _section(changes, "quality")
    fixed = {"device": device} | {k: v for k, v in changes.items() if not _is_axis(k, v)}
    axes = {axis: values for axis, values in _axes(file).items() if axis not in fixed}
    axes |= {axis: tuple(v) for axis, v in changes.items() if axis not in fixed}
    timings, skips = _expand(file, axes, fixed, weights)
    return LatencyGrid(
        name=f"{file.path.stem}-smoke" if smoke else file.path.stem,
        question=str(file.values.get("question", "")),
        axes=MappingProxyType(axes),
        timings=timings,
        skips=skips,
        smoke=smoke,
        quality=MappingProxyType(quality),
        report=MappingProxyType(file.values.get("report", {})),
    )


def parse(settings: Sequence[str]) -> dict[str, Any]:
    """`key=value` strings as values of TOML, or as text where a value is none.

    Raises:
        ValueError: no `=`.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"'{setting}' is not key=value, such as passes=50")
        try:
            values[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            values[key.strip()] = text.strip()
    return values


# --- timings --------------------------------------------------------------------------------------


def _is_axis(key: str, value: Any) -> bool:
    """Whether a setting is several values; `tasks` is a list itself."""
    return isinstance(value, list) and (key != "tasks" or isinstance(value[0], list))


def _section(changes: dict[str, Any], name: str) -> dict[str, str]:
    """Take `name.KEY` out of the settings."""
    keys = [key for key in changes if key.startswith(f"{name}.")]
    return {key.removeprefix(f"{name}."): str(changes.pop(key)) for key in keys}


def _axes(file: TomlFile) -> dict[str, tuple[Any, ...]]:
    axes = grid_file.axes(file)
    for axis in axes:
        if axis not in AXES:
            raise file.error(f"unknown axis '{axis}'{did_you_mean(axis, AXES)}", axis, ("axes", 0))
    return axes


def _expand(
    file: TomlFile,
    axes: Mapping[str, tuple[Any, ...]],
    fixed: Mapping[str, Any],
    weights: Mapping[str, str],
) -> tuple[tuple[Timing, ...], tuple[Skip, ...]]:
    """The product of the axes, less the skips; equal timings count once."""
    for key in ("backbone", "engine"):
        if key not in axes and key not in fixed:
            raise file.error(f"axis '{key}' is missing", "", ("axes", 0))
    rules = file.values.get("skip", [])
    for index, rule in enumerate(rules):
        if not isinstance(rule.get("why"), str):
            raise file.error("a [[skip]] needs its reason: why = '...'", "", ("skip", index))
        for key in rule.keys() - {"why", *Timing.__dataclass_fields__}:
            message = f"unknown key '{key}'{did_you_mean(key, Timing.__dataclass_fields__)}"
            raise file.error(message, key, ("skip", index))
    timings: dict[str, Timing] = {}
    skips: dict[str, Skip] = {}
    for values in itertools.product(*axes.values()):
        point = {**fixed, **dict(zip(axes, values, strict=True))}
        timing = _with_weights(_timing(file, point), weights)
        matching = (rule["why"] for rule in rules if _matches(rule, timing))
        why = next(matching, None) or _without_precision(timing)
        if why is None:
            timings.setdefault(timing.id, timing)
        else:
            skips.setdefault(timing.id, Skip(timing, why))
    return tuple(timings.values()), tuple(skips.values())


def _timing(file: TomlFile, values: Mapping[str, Any]) -> Timing:
    own = {key: value for key, value in values.items() if not key.startswith("backbone.")}
    arguments = {key.removeprefix("backbone."): values[key] for key in values.keys() - own.keys()}
    try:
        return from_dict(Timing, own | ({"backbone_args": arguments} if arguments else {}))
    except ValueError as error:
        for axis in AXES:
            if f"'{axis}'" in str(error):
                raise file.error(str(error), axis, ("axes", 0), ("smoke", 0)) from error
        raise


def _with_weights(timing: Timing, weights: Mapping[str, str]) -> Timing:
    """With the folder of trained weights that its backbone has.

    Raises:
        ValueError: they are of another backbone, other tasks or other network sizes.
    """
    if timing.backbone not in weights:
        return timing
    folder = weights[timing.backbone]
    cell = results.load_cell(Path(folder) / "cell.json")
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


def _without_precision(timing: Timing) -> str | None:
    """Why it is skipped; an engine that the kind of device lacks keeps one line, in fp32."""
    has = engines.PRECISIONS.get(timing.engine, {timing.device: (timing.precision,)})
    if timing.precision in has.get(timing.device, ("fp32",)):
        return None
    return f"{timing.engine} has no {timing.precision} on {timing.device}"


def _matches(rule: Mapping[str, Any], timing: Timing) -> bool:
    """Whether a timing has every value that the rule names, or one of its several values."""
    own = to_dict(timing)
    return all(
        own[key] in value if _is_axis(key, value) else own[key] == value
        for key, value in rule.items()
        if key != "why"
    )
