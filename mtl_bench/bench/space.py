"""What trials may set, and the quasi-random values that they take.

A space says of keys that --set takes, those that begin as in TUNED, where their values lie:

    "recipe.optim.lr" = { log = ["0.1x", "10x"] }       between two numbers, evenly in the logarithm
    "method.alpha" = { uniform = [0.1, 0.9] }           between two numbers; whole where both are
    "recipe.optim.weight_decay" = [0.0, 1e-5, 1e-4]     one of these

"0.1x" is times the recipe's number. A method's class says the same of its hyper-parameters, in
`space`, where { "dirichlet": 1.0 } are shares of the tasks that add up to 1; a subclass has its
base's. What a line sets itself is not tuned. Trial 0 changes nothing: it is the published setting.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell
from mtl_bench.core.plain import DISTINCT, SOME, Checked, did_you_mean, to_dict
from mtl_bench.core.recipe import Count, Whole

TIMES = re.compile(r"(\d+\.?\d*)x")  # "2x", "0.5x"
RANGES = ("log", "uniform")
TUNED = (  # what begins a key that trials may set: none is what lines and problems are told by
    *("recipe.augment.", "recipe.network.", "recipe.loss.", "recipe.optim.", "recipe.pseudo."),
    *("method.", "backbone."),
)
SPLIT = "val"  # that trials are judged on
DRAW = 17  # of the scrambling: another one would be other trials
DEFAULT: Mapping[str, Any] = MappingProxyType(
    {
        "recipe.optim.lr": {"log": ["0.0562x", "17.8x"]},  # two and a half decades
        "recipe.optim.weight_decay": [0.0, 1e-5, 1e-4],
    }
)


@dataclass(frozen=True)
class Tune(Checked):
    """How every line of a grid is tuned, with as many trials as any other: its section [tune]."""

    trials: Annotated[Count, "of each line on each problem, the published setting among them"] = 6
    seeds: Annotated[tuple[Whole, ...], SOME, DISTINCT, "of trials; none of them is a result's"] = (
        100,
    )
    space: Mapping[str, Any] = field(default_factory=lambda: DEFAULT)


def check(key: str, where: Any) -> None:
    """A space's entry is one of those above.

    Raises:
        ValueError: it is not, with what it may be.
    """
    (form, of), *more = where.items() if isinstance(where, dict) and where else [("", where)]
    if form == "dirichlet" and not more and _is_number(of) and of > 0:
        return
    if not form and isinstance(of, list) and of:
        return
    numbers = [_bound(bound) for bound in of] if form in RANGES and isinstance(of, list) else []
    least = 0.0 if form == "log" else -math.inf
    if more or len(numbers) != 2 or not least < numbers[0] < numbers[1]:
        raise ValueError(
            f'"{key}" is a list of values, {{ log = [LOW, HIGH] }} or {{ uniform = [LOW, HIGH] }}, '
            f"not {where!r}"
        )


def of_method(name: str) -> dict[str, Any]:
    """What a method declares, or a class that it derives from, by hyper-parameter.

    Raises:
        ValueError: no such method, or what no trial could be drawn from.
    """
    space, path = plugins.read_attribute("methods", name, "space"), plugins.path_of("methods", name)
    if not isinstance(space, dict):
        raise ValueError(f"{path}: space is {{HYPER-PARAMETER: VALUES, ...}}, not {space!r}")
    known = plugins.arguments("methods", name)
    for key, where in space.items():
        if key not in known:
            like = did_you_mean(str(key), known)
            raise ValueError(f"{path}: space has '{key}', no argument of the constructor{like}")
        try:
            check(key, where)
        except ValueError as error:
            raise ValueError(f"{path}: in space, {error}") from error
    return space


def draws(tune: Tune, cell: Cell) -> list[dict[str, Any]]:
    """The settings of every trial of a cell, by key of --set; of trial 0 none."""
    space = {**tune.space, **_of_method(cell)}
    widths = [len(cell.tasks) if "dirichlet" in where else 1 for where in space.values()]
    found: list[dict[str, Any]] = [{}]
    for point in _points(sum(widths), tune.trials - 1):
        shares = iter(point)
        each = zip(space.items(), widths, strict=True)
        parts = {key: (where, [next(shares) for _ in range(n)]) for (key, where), n in each}
        found.append({key: _value(cell, key, *part) for key, part in parts.items()})
    return found


def times(cell: Cell, key: str, factor: str) -> Any:
    """A cell's number times 2 for "2x", whole where it is; the text where there is no number."""
    number = value_of(cell, key)
    if type(number) not in (int, float):
        return factor
    product = float(factor[:-1]) * number
    return round(product) if type(number) is int else product


def value_of(cell: Cell, key: str) -> Any:
    """What a cell has under a key of --set; None where it has nothing there."""
    first, *rest = key.split(".")
    value: Any = to_dict(cell)
    for part in (f"{first}_args" if rest and first in ("method", "backbone") else first, *rest):
        value = value.get(part) if isinstance(value, dict) else None
    return value


# --- parts ----------------------------------------------------------------------------------------


def _of_method(cell: Cell) -> dict[str, Any]:
    """What the cell's method declares, less what the cell sets."""
    names, found = plugins.part_names(cell.method), dict[str, Any]()
    for name in names:
        prefix = "method." if len(names) == 1 else f"method.{name}."
        found |= {prefix + key: where for key, where in of_method(name).items()}
    return {key: where for key, where in found.items() if value_of(cell, key) is None}


def _points(dimensions: int, count: int) -> list[list[float]]:
    """Points of a scrambled Halton sequence, coordinates in [0, 1).

    Neither how many there are nor how many coordinates they have changes the first ones.
    """
    from scipy.stats import qmc

    if not (dimensions and count):
        return [[]] * count
    found: list[list[float]] = (
        qmc.Halton(dimensions, scramble=True, seed=DRAW).random(count).tolist()
    )
    return found


def _value(cell: Cell, key: str, where: Any, shares: Sequence[float]) -> Any:
    """What a key is set to, by shares in [0, 1)."""
    if isinstance(where, list):
        return where[int(shares[0] * len(where))]
    ((form, of),) = where.items()
    if form == "dirichlet":
        return _simplex(cell, of, shares)
    low, high = (times(cell, key, bound) if isinstance(bound, str) else bound for bound in of)
    if not (_is_number(low) and _is_number(high)):
        raise ValueError(f"{key} is no number here that {of[0]} could be times of")
    value = (
        math.exp(math.log(low) + shares[0] * math.log(high / low))
        if form == "log"
        else low + shares[0] * (high - low)
    )
    return round(value) if type(low) is type(high) is int else float(f"{value:.3g}")


def _simplex(cell: Cell, concentration: float, shares: Sequence[float]) -> dict[str, float]:
    """Task -> share, Dirichlet-distributed where `shares` are uniform."""
    from scipy.stats import gamma

    drawn = [float(gamma.ppf(max(share, 1e-6), concentration)) for share in shares]
    total = sum(drawn)
    pairs = zip(cell.tasks, drawn, strict=True)
    return {task: float(f"{share / total:.3g}") for task, share in pairs}


def _bound(bound: Any) -> float:
    if isinstance(bound, str) and TIMES.fullmatch(bound):
        return float(bound[:-1])
    return float(bound) if _is_number(bound) else math.nan


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)
