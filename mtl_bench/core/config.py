"""What a training run is: frozen dataclasses, one canonical JSON, one id.

A `Recipe` is everything about training that is not the method, the backbone or the seed; a `Cell`
is a recipe with those three, the tasks and the video stage. Two cells with the same values have
the same id, whatever file or option the values came from.
"""

import hashlib
import json
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from mtl_bench.core import plugins, toml_file
from mtl_bench.core.plain import (
    DISTINCT,
    Checked,
    convert,
    did_you_mean,
    from_dict,
    one_of,
    to_dict,
)
from mtl_bench.core.plugins import IS_NAME, IS_TASK
from mtl_bench.core.recipe import (
    Augment,
    Data,
    Evaluate,
    Latency,
    Loss,
    Network,
    Optim,
    PseudoLabels,
    Recipe,
    Whole,
)

__all__ = ["Augment", "Data", "Evaluate", "Latency", "Loss", "Network", "Optim", "PseudoLabels"]
__all__ += [
    "Cell",
    "Recipe",
    "canonical_json",
    "check_cells",
    "check_tasks",
    "load_recipe",
    "override",
    "training_json",
]
__all__ += ["did_you_mean", "from_dict", "recipe_names", "set_values", "to_dict"]

PROTOCOL = 2  # raised when numbers made before stop being comparable with numbers made after
RECIPES = Path(__file__).parents[1] / "bench" / "recipes"
GRANULARITIES = ("terms", "tasks")
REPLAYS = ("mean", "final", "shuffled", "level")
FROZEN = "frozen"  # a setting of every backbone: "stem" or "all" of it does not learn
HASHED = "sha256:"  # before the hash of initial weights whose file is elsewhere
# Values that recipes have had since protocol 2 began. One that is its default is left out of the
# canonical JSON, so that cells and timings which were run before keep their ids.
LATER: tuple[tuple[str, str], ...] = (  # section, key
    ("data", "train_frames"),
    ("data", "test_scenes"),
    ("data", "stride"),
    ("data", "min_flow"),
    ("network", "decoder"),
    ("network", "depth_slope"),
    ("loss", "hints"),
    ("optim", "milestones"),
    ("optim", "milestone_factor"),
    ("data", "heads"),
    ("data", "cosine"),
    ("data", "norm_ratio"),
    ("evaluate", "protocol"),
    ("evaluate", "also"),
    ("evaluate", "flip"),
    ("optim", "one_batch"),
    ("optim", "statistics_batches"),
)

NOT_SET = {
    "recipe.tasks": "a cell has its own, tasks",
    "recipe.backbone": "a cell has its own, backbone",
    "continues": "train --continue RUN makes such a cell",
    "recipe.name": "a recipe is called as its file",
    "recipe.about": "it is said in the recipe's file",
    "method_args": "its settings are method.KEY",
    "backbone_args": "its settings are backbone.KEY",
}


@dataclass(frozen=True)
class Cell(Checked):
    """One training run and its evaluation.

    Four kinds of cell need others (their `parents`) first: `video` trains its parent's checkpoint
    on, with pseudo labels from it; `continues` trains another cell's checkpoint on, by a recipe of
    its own; `replay` trains from the start, with the weights that its parent, the same cell
    without it, has logged; `single_task` trains nothing, and evaluates and times the networks of
    its parents together.

    Raises:
        ValueError: a value that its field cannot have, or options that exclude each other.
    """

    recipe: Recipe
    backbone: Annotated[str, IS_NAME, "its name, see `list backbones`"]
    method: Annotated[str, IS_NAME, "a name, or a loss-value method and a gradient method: a+b"]
    tasks: Annotated[
        tuple[Annotated[str, IS_TASK], ...], DISTINCT, "names; none: the recipe's"
    ] = ()
    seed: Annotated[Whole, "of initial weights, data order and method"] = 0
    video: Annotated[bool, "the second training, on pseudo-labeled frames too"] = False
    single_task: Annotated[bool, "one network a task, each trained alone"] = False
    granularity: Annotated[
        str, one_of(*GRANULARITIES), "what a method weighs: terms, or tasks as sums of them"
    ] = "terms"
    pretrained: Annotated[
        str | None, "initial weights: timm, or a file; without it they are random"
    ] = None
    method_args: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    backbone_args: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    replay: Annotated[
        str | None,
        one_of(*REPLAYS),
        "train with the weights that the method gave in a run of its own, not by the method: fixed "
        "at their mean or final values, shuffled in time, or level: all equal, by their mean",
    ] = None
    continues: "Cell | None" = None  # whose model and method it goes on from; optimiser anew

    def __post_init__(self) -> None:
        super().__post_init__()
        # In one order, as none changes a number: the recipe's, then the alphabet's
        order, own = self.recipe.tasks, set(self.tasks)
        tasks = (*(task for task in order if task in own), *sorted(own.difference(order)))
        object.__setattr__(self, "tasks", tasks or order)
        object.__setattr__(self, "method_args", _method_args(self.method, self.method_args))
        arguments = _args("backbones", self.backbone, self.backbone_args, "backbone")
        object.__setattr__(self, "backbone_args", arguments)
        if self.single_task and self.video:
            raise ValueError(
                "single_task and video exclude each other: the stage needs one network"
            )
        for other in ("video",) * self.video + ("continues",) * (self.continues is not None):
            if self.replay is not None:
                raise ValueError(
                    f"replay and {other} exclude each other: replayed training begins at step 0"
                )
        if self.single_task and len(self.tasks) < 2:
            raise ValueError(f"single_task needs two tasks or more, not {list(self.tasks)}")
        if self.continues is not None:
            self._check_continued(self.continues)

    def _check_continued(self, start: "Cell") -> None:
        """Raises: ValueError: its checkpoint has no place in this cell's network and method."""
        if self.single_task or start.single_task:
            raise ValueError("single_task cells have no one network to continue")
        own, other = self._kept, start._kept
        different = [key for key in own if own[key] != other[key]]
        if different:
            raise ValueError(
                f"a continued cell keeps its {', '.join(own)}: {different[0]} "
                f"{own[different[0]]} is not {other[different[0]]}, that of {start.slug}"
            )

    @property
    def _kept(self) -> dict[str, Any]:
        """What a cell shares with those that continue it; freezing may differ."""
        arguments = {key: v for key, v in self.backbone_args.items() if key != FROZEN}
        return {
            "tasks": self.tasks,
            "backbone": (self.backbone, arguments),
            "method": (self.method, self.granularity),
            "network": self.recipe.network,
        }

    @property
    def parents(self) -> tuple["Cell", ...]:
        """Cells whose checkpoints, or of `replay` whose weights, this one needs."""
        if self.single_task:
            return tuple(replace(self, single_task=False, tasks=(task,)) for task in self.tasks)
        if self.replay is not None:
            return (replace(self, replay=None),)
        if self.video:
            return (replace(self, video=False),)
        return () if self.continues is None else (self.continues,)

    @cached_property
    def id(self) -> str:
        """12 hexadecimal digits of the canonical JSON: recipe values, not the recipe's name."""
        return hashlib.sha256(canonical_json(self).encode()).hexdigest()[:12]

    @property
    def slug(self) -> str:
        """Name of the run's folder."""
        return f"{self.method}-{self.backbone}-s{self.seed}-{self.id}"

    @property
    def label(self) -> str:
        """What a reader tells cells of one grid apart by, in a few words."""
        words = [self.method, self.backbone, f"s{self.seed}"]
        words += [] if self.tasks == self.recipe.tasks else [",".join(self.tasks)]
        words += ["single-task"] * self.single_task + ["video"] * self.video
        words += ["continued"] * (self.continues is not None)
        words += [] if self.granularity == "terms" else [f"by {self.granularity}"]
        words += [] if self.replay is None else [f"replay {self.replay}"]
        arguments = [*self.method_args.items(), *self.backbone_args.items()]
        return " ".join([*words, *(f"{key}={value}" for key, value in arguments)])


# --- identity -----------------------------------------------------------------------------------


def _method_args(method: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Of `a+b`, settings come by part."""
    names = plugins.part_names(method)
    if len(names) == 1:
        return _args("methods", method, values, "method")
    found = {
        part: _args("methods", part, inner, f"method.{part}")
        if part in names and isinstance(inner, Mapping)
        else inner
        for part, inner in values.items()
    }
    return MappingProxyType({p: inner for p, inner in found.items() if inner or p not in names})


def _args(kind: str, name: str, values: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """A plug-in's settings in one spelling: of the types of its constructor, without defaults."""
    if not values:
        return values
    try:
        known = plugins.arguments(kind, name)
    except ValueError:
        return values  # `check_cells` tells what is wrong with the plug-in
    found = {
        key: convert(known[key].kind, value, f"{where}.{key}") if key in known else value
        for key, value in values.items()
    }
    given = {k: v for k, v in found.items() if k not in known or v != known[k].default}
    return MappingProxyType(given)


def canonical_json(cell: Cell) -> str:
    """What makes a cell itself: without names, prose and how often a checkpoint is written."""
    values = to_dict(cell)
    for key in ("name", "about", "tasks", "backbone"):
        del values["recipe"][key]
    for key in ("checkpoint_every", "cosine_every"):
        del values["recipe"]["optim"][key]
    if not cell.video:
        del values["recipe"]["pseudo"]
    for key in ("cache", "workers"):
        del values["recipe"]["data"][key]
    if cell.replay is None:
        del values["replay"]
    values.pop("continues")
    if cell.continues is not None:
        values["continues"] = cell.continues.id
    values["tasks"] = sorted(cell.tasks, reverse=True)
    values["recipe"]["data"]["dataset"] = cell.recipe.data.dataset.replace("_", "-")
    leave_out_defaults(values["recipe"])
    if cell.pretrained not in (None, "timm"):
        values["pretrained"] = _content_hash(str(cell.pretrained))
    return json.dumps({"protocol": PROTOCOL, **values}, sort_keys=True, separators=(",", ":"))


def leave_out_defaults(sections: dict[str, Any], kept: Collection[tuple[str, str]] = ()) -> None:
    """Of a recipe's sections, or of some of them, drop LATER's values that are defaults.

    Args:
        kept: those that such jobs have always had.
    """
    defaults = _defaults()
    for section, key in LATER:
        own = sections.get(section, {})
        if key in own and (section, key) not in kept and own[key] == defaults[section][key]:
            del own[key]


@lru_cache
def _defaults() -> dict[str, Any]:
    values: dict[str, Any] = to_dict(Recipe())
    return values


def training_json(cell: Cell) -> str:
    """What makes a cell's training: the same without what only comes after it.

    The video stage's labels are made with the evaluation's post-processing.
    """
    recipe = replace(cell.recipe, latency=Latency())
    recipe = recipe if cell.video else replace(recipe, evaluate=Evaluate())
    return canonical_json(replace(cell, recipe=recipe))


@lru_cache
def _content_hash(weights: str) -> str:
    """A weights file counts by what is in it, not by where it is."""
    if weights.startswith(HASHED):
        return weights.removeprefix(HASHED)
    if not Path(weights).is_file():
        raise ValueError(f"no weights file '{weights}'; --pretrained takes 'timm' or a file")
    with Path(weights).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def to_travel(cell: Cell) -> dict[str, Any]:
    """A cell's values for another machine: of a weights file its hash, in place of a path."""
    values: dict[str, Any] = to_dict(cell)
    if cell.pretrained not in (None, "timm"):
        values["pretrained"] = HASHED + _content_hash(str(cell.pretrained))
    if cell.continues is not None:
        values["continues"] = to_travel(cell.continues)
    return values


# --- recipes and overrides ------------------------------------------------------------------------


def recipe_names() -> list[str]:
    return sorted(path.stem for path in RECIPES.glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """A shipped recipe by name, or a user's by the path of its TOML file.

    Raises:
        ValueError: no such recipe, or a key or value that a recipe cannot have.
    """
    path = Path(name) if name.endswith(".toml") else RECIPES / f"{name}.toml"
    if not path.is_file():
        raise ValueError(f"no recipe called '{name}'{did_you_mean(name, recipe_names())}")
    values = toml_file.read(path).values
    try:
        return from_dict(Recipe, {"name": path.stem, **values})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def override(cell: Cell, settings: Iterable[str]) -> Cell:
    """Apply `key=value` strings: `recipe.optim.lr=3e-4`, `method.alpha=1.5`, `seed=3`.

    Raises:
        ValueError: no `=`, an unknown key (with the nearest known one), or a value of another type.
    """
    return set_values(cell, parse_settings(settings))


def parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """`key=value` strings as values of TOML, or as text where a value is none: `seed=3`.

    Raises:
        ValueError: no `=`.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"'{setting}' is not key=value, such as recipe.optim.lr=3e-4")
        try:
            values[key.strip()] = tomllib.loads(f"value = {text.strip()}")["value"]
        except tomllib.TOMLDecodeError:
            values[key.strip()] = text.strip()
    return values


def set_values(cell: Cell, settings: Mapping[str, Any]) -> Cell:
    """As `override`, with values as they are; below `method.` and `backbone.` sections are made."""
    if not settings:
        return cell
    values = to_dict(cell)
    for key, value in settings.items():
        if key in NOT_SET:
            raise ValueError(f"'{key}' cannot be set: {NOT_SET[key]}")
        *sections, last = key.split(".")
        plug_in = sections[:1] in (["method"], ["backbone"])  # checked when it is constructed
        if plug_in:
            sections[0] += "_args"
        target = values
        for section in sections:
            inner = target.setdefault(section, {}) if plug_in else target.get(section)
            if not isinstance(inner, dict):
                raise ValueError(f"unknown key '{key}'{did_you_mean(section, target)}")
            target = inner
        if last not in target and not plug_in:
            raise ValueError(f"unknown key '{key}'{did_you_mean(last, target)}")
        target[last] = to_dict(value)
    return from_dict(Cell, values)


# --- checks ------------------------------------------------------------------------------------


def check_cells(cells: Iterable[Cell]) -> None:
    """What cells name exists: tasks, plug-ins and the hyper-parameters that are set.

    Raises:
        ValueError: an unknown task, plug-in or hyper-parameter, with the nearest known one.
    """
    seen: set[tuple[str, str, tuple[str, ...]]] = set()
    for cell in cells:
        check_tasks(cell.tasks)
        declared = (plugins.attributes("tasks", task) for task in cell.tasks)
        if cell.video and not any(found.get("makes_labels") for found in declared):
            raise ValueError(f"video needs a task that makes labels, not {', '.join(cell.tasks)}")
        for name in plugins.part_names(cell.method) if cell.replay is not None else ():
            if not _replayable(name):
                raise ValueError(
                    f"replay={cell.replay}: an update of method '{name}' is no sum of one batch's "
                    f"gradients by the weights that it logs, so they cannot be trained with again"
                )
        for kind, name, values in _chosen(cell):
            if (kind, name, tuple(values)) in seen:
                continue
            seen.add((kind, name, tuple(values)))
            plugins.path_of(kind, name)
            known = set(plugins.arguments(kind, name)) if values else set()
            known |= {FROZEN} if kind == "backbones" else set()
            for key in values:
                if key not in known:
                    word = kind[:-1]
                    raise ValueError(f"{word} '{name}' has no '{key}'{did_you_mean(key, known)}")


def _replayable(method: str) -> bool:
    """What the method declares; without that, whether it answers with weights."""
    declared = plugins.declared("methods", method)
    return bool(declared.get("replayable", declared.get("needs") != "jacobian"))


def check_tasks(tasks: Iterable[str]) -> None:
    """Tasks exist, and name a field of the data set where they are of one.

    Raises:
        ValueError: an unknown task, one that lacks its field, or one that has a field too many.
    """
    for task in tasks:
        stem = plugins.stem_and_field(task)[0]
        of_field = plugins.attributes("tasks", task).get("of_field")
        if of_field and task == stem:
            raise ValueError(f"task '{task}' is of one field of the data set: {task}:FIELD")
        if task != stem and not of_field:
            raise ValueError(f"task '{stem}' is of no one field: '{stem}', not '{task}'")


def _chosen(cell: Cell) -> list[tuple[str, str, Mapping[str, Any]]]:
    """Kind, name and settings of a cell's plug-ins; of `a+b`, settings come by part."""
    names = plugins.part_names(cell.method)
    parts = {names[0]: cell.method_args} if len(names) == 1 else dict(cell.method_args)
    for name in parts:
        if name not in names:
            raise ValueError(
                f"method '{cell.method}' has no part '{name}': --set method.{names[0]}.KEY=VALUE"
            )
    methods = [("methods", name, parts.get(name, {})) for name in names]
    dataset = cell.recipe.data.dataset.replace("-", "_")
    return [
        *methods,
        ("backbones", cell.backbone, cell.backbone_args),
        *(("tasks", task, {}) for task in cell.tasks),
        ("datasets", dataset, {}),
    ]
