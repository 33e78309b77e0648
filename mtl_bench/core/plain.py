"""Frozen dataclasses to plain values and back, and names that were nearly right.

What a field may hold stands in its type: `Annotated[int, least(1), "steps of the optimiser"]`. The
type, the rules and the words are read here and nowhere else, by what converts values, by what
checks them and by what lists them.
"""

import dataclasses
import math
import sys
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType, NoneType, UnionType
from typing import Any

T = typing.TypeVar("T")


@dataclass(frozen=True)
class Rule:
    """What a value must be, beyond its type."""

    words: str  # behind "must be"
    holds: Callable[[Any], bool]


def least(bound: float) -> Rule:
    return Rule(f">= {bound:g}", lambda value: value >= bound)


def most(bound: float) -> Rule:
    return Rule(f"<= {bound:g}", lambda value: value <= bound)


def above(bound: float) -> Rule:
    return Rule(f"> {bound:g}", lambda value: value > bound)


def one_of(*values: str) -> Rule:
    return Rule(" or ".join(values), lambda value: value in values)


FINITE = Rule("finite", math.isfinite)
ODD = Rule("odd", lambda value: value % 2 == 1)
SOME = Rule("non-empty", lambda value: len(value) > 0)
ASCENDING = Rule("ascending", lambda value: sorted(set(value)) == list(value))
DISTINCT = Rule("without repetitions", lambda value: len(set(value)) == len(value))


@dataclass(frozen=True)
class Checked:
    """Base of a frozen dataclass whose values are of their types and keep their rules.

    Raises:
        ValueError: one that does not, with its name.
    """

    def __post_init__(self) -> None:
        for name, kind in _types(type(self)).items():
            object.__setattr__(self, name, convert(kind, getattr(self, name), name))


@dataclass(frozen=True)
class Setting:
    """A key, what it may hold and what it means, for a reader."""

    key: str
    kind: str
    default: Any  # dataclasses.MISSING: it has none
    rules: str
    about: str


def settings_of(kind: type[Any], where: str = "") -> Iterator[Setting]:
    """Every field of a (nested) dataclass, in its order; one without words is no setting."""
    for field in dataclasses.fields(kind):
        of = _types(kind)[field.name]
        if dataclasses.is_dataclass(of):
            yield from settings_of(of, f"{where}{field.name}.")  # type: ignore[arg-type]
            continue
        about = "; ".join(word for word in _metadata(of) if isinstance(word, str))
        if about:
            rules = ", ".join(dict.fromkeys(rule.words for rule in _rules(of)))
            yield Setting(f"{where}{field.name}", name_of_type(of), field.default, rules, about)


def to_dict(value: Any) -> Any:
    """Plain values of a (nested) dataclass, as JSON would hold them."""
    if dataclasses.is_dataclass(value):
        return {f.name: to_dict(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): to_dict(v) for k, v in sorted(value.items())}
    if isinstance(value, (list, tuple)):
        return [to_dict(v) for v in value]
    return value


def from_dict(kind: type[T], values: Mapping[str, Any], where: str = "") -> T:
    """Build a (nested) dataclass from plain values.

    Raises:
        ValueError: a key that the dataclass lacks, or a value of another type or against its
            rules, with its full path.
    """
    fields = _types(kind)
    for key in values:
        if key not in fields:
            raise ValueError(f"unknown key '{where}{key}'{did_you_mean(key, fields)}")
    return kind(**{k: convert(fields[k], v, f"{where}{k}") for k, v in values.items()})


def convert(kind: Any, value: Any, where: str) -> Any:
    """A value as one of a type: 1 as 1.0 where a float is due, a list as a tuple.

    Raises:
        ValueError: it is none, or against a rule; `where` is what it is called.
    """
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if isinstance(value, kind):
            return value
        if not isinstance(value, Mapping):
            raise ValueError(f"'{where}' is a section, not the value {value!r}")
        return from_dict(kind, value, f"{where}.")
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        found = convert(args[0], value, where)
        for rule in args[1:]:
            if isinstance(rule, Rule) and found is not None and not rule.holds(found):
                raise ValueError(f"'{where}' must be {rule.words}, not {to_dict(value)!r}")
        return found
    if origin in (UnionType, typing.Union):
        if NoneType in args and (value is None or (value == "none" and str not in args)):
            return None
        return convert(next(a for a in args if a is not NoneType), value, where)
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(inner) == len(value):
            return tuple(convert(a, v, where) for a, v in zip(inner, value, strict=True))
    elif origin is Mapping and isinstance(value, Mapping):
        return MappingProxyType({k: convert(args[1], v, f"{where}.{k}") for k, v in value.items()})
    elif kind is float and type(value) in (int, float):
        if value != value or (type(value) is int and abs(value) > sys.float_info.max):
            raise ValueError(f"'{where}' must be a number, not {value}")
        return float(value)
    elif kind is Any or type(value) is kind:
        return value
    raise ValueError(f"'{where}' must be {name_of_type(kind)}, not {to_dict(value)!r}")


def name_of_type(kind: Any) -> str:
    """For a reader: `float or none`, `list of int`, `list of 2 float`."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return name_of_type(args[0])
    if origin in (UnionType, typing.Union):
        return " or ".join(map(name_of_type, args))
    if origin is tuple:
        count = "" if args[-1] is Ellipsis else f"{len(args)} "
        return f"list of {count}{name_of_type(args[0])}"
    if origin is Mapping:
        return f"table of {name_of_type(args[1])}"
    name = getattr(kind, "__name__", str(kind))
    return {"NoneType": "none", "Any": "any value"}.get(name, name)


def _metadata(kind: Any) -> Collection[Any]:
    return typing.get_args(kind)[1:] if typing.get_origin(kind) is typing.Annotated else ()


def _rules(kind: Any) -> Iterator[Rule]:
    """Of a type and of what it is made of."""
    yield from (rule for rule in _metadata(kind) if isinstance(rule, Rule))
    for inner in typing.get_args(kind):
        yield from _rules(inner)


def _types(kind: Any) -> dict[str, Any]:
    """Name -> type of a dataclass's fields."""
    if kind not in _known:
        types = typing.get_type_hints(kind, include_extras=True)
        _known[kind] = {field.name: types[field.name] for field in dataclasses.fields(kind)}
    return _known[kind]


_known: dict[Any, dict[str, Any]] = {}


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)`, or the known names where none is near."""
    names = sorted(known)
    near = get_close_matches(word, names, n=1)
    if near:
        return f" (did you mean '{near[0]}'?)"
    return f" (known: {', '.join(names)})" if names else ""
