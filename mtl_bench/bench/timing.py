"""A timing: one network on one engine at one size, its canonical JSON and its id."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mtl_bench import engines
from mtl_bench.bench import results
from mtl_bench.core import plugins
from mtl_bench.core.config import TASKS, Recipe, load_recipe
from mtl_bench.core.plain import did_you_mean, to_dict

PROTOCOL = 1  # raised when times taken before stop being comparable with times taken after
NOTHING: Mapping[str, Any] = MappingProxyType({})
SIZE = re.compile(r"([1-9]\d*)x([1-9]\d*)")


@dataclass(frozen=True)
class Timing:
    """One network on one engine at one size: what `mtl-bench latency` measures at a time.

    Raises:
        ValueError: a size that is not HxW.
    """

    backbone: str
    engine: str
    precision: str = "fp32"
    size: str = "1024x2048"  # height x width of the image, pixels
    tasks: tuple[str, ...] = TASKS
    device: str = "cpu"  # cpu | cuda: the kind; its name stands in the row
    passes: int = 500  # the paper's
    seconds: float | None = None  # ends the passes early, as `mtl-bench latency --seconds` does
    recipe: str = "paper"  # the network's sizes behind the backbone; "paper" is `Recipe()`
    weights: str | None = None  # folder of the run that trained them; None: random
    backbone_args: Mapping[str, Any] = field(default_factory=lambda: NOTHING)

    def __post_init__(self) -> None:
        if not SIZE.fullmatch(self.size):
            raise ValueError(f"size '{self.size}' is not HxW, such as 1024x2048")

    @property
    def height(self) -> int:
        return int(self.size.partition("x")[0])

    @property
    def width(self) -> int:
        return int(self.size.partition("x")[2])

    @property
    def id(self) -> str:
        """12 hexadecimal digits of the canonical JSON."""
        return hashlib.sha256(canonical_json(self).encode()).hexdigest()[:12]

    @property
    def label(self) -> str:
        """A few words that tell it from the others of a grid."""
        words = [self.backbone, ",".join(self.tasks), self.size, self.engine, self.precision]
        return " ".join([*words, *(f"{k}={v}" for k, v in self.backbone_args.items())])


def canonical_json(timing: Timing) -> str:
    """What makes the number: the recipe by its values, the weights by the cell that trained them.

    Neither the number of threads nor the device's name: they are in the row.
    """
    recipe = to_dict(recipe_of(timing))
    values = to_dict(timing) | {key: recipe[key] for key in ("network", "evaluate")}
    del values["recipe"]
    if timing.weights is not None:
        values["weights"] = results.load_cell(Path(timing.weights) / "cell.json").id
    return json.dumps({"protocol": PROTOCOL, **values}, sort_keys=True, separators=(",", ":"))


def recipe_of(timing: Timing) -> Recipe:
    return Recipe() if timing.recipe == Recipe().name else load_recipe(timing.recipe)


def lack(timing: Timing) -> str | None:
    """Why a timing cannot be taken here, and what would change that; None where it can."""
    why = engines.available(timing.engine)
    if why is None:
        try:
            engines.check(timing.engine, timing.precision, timing.device)
        except ValueError as error:
            return str(error)
    return why


def check(timings: Iterable[Timing]) -> None:
    """What timings name exists: backbones and their arguments, tasks, engines.

    Raises:
        ValueError: an unknown one, with the nearest known one.
    """
    for timing in timings:
        if timing.engine not in engines.NAMES:
            hint = did_you_mean(timing.engine, engines.NAMES)
            raise ValueError(f"no engine called '{timing.engine}'{hint}")
        for task in timing.tasks:
            if task not in TASKS:
                raise ValueError(f"no task called '{task}'{did_you_mean(task, TASKS)}")
        plugins.path_of("backbones", timing.backbone)
        settings = plugins.settings("backbones", timing.backbone) if timing.backbone_args else {}
        for key in timing.backbone_args.keys() - settings.keys():
            hint = did_you_mean(key, settings)
            raise ValueError(f"backbone '{timing.backbone}' has no '{key}'{hint}")
