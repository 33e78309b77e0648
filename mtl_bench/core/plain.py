"""Frozen dataclasses to plain values and back, and names that were nearly right."""

import dataclasses
import typing
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from types import MappingProxyType, UnionType
from typing import Any

T = typing.TypeVar("T")


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
        ValueError: a key that the dataclass lacks, or a value of another type, with its full path.
    """
    types = typing.get_type_hints(kind)
    fields = {f.name: types[f.name] for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for key in values:
        if key not in fields:
            raise ValueError(f"unknown key '{where}{key}'{did_you_mean(key, fields)}")
    return kind(**{k: _convert(fields[k], v, f"{where}{k}") for k, v in values.items()})


def _convert(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(f"'{where}' is a section, not the value {value!r}")
        return from_dict(kind, value, f"{where}.")  # type: ignore[arg-type]
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (UnionType, typing.Union):
        nothing = value == "none" and type(None) in args and str not in args
        if value is None or nothing:
            return None
        return _convert(next(a for a in args if a is not type(None)), value, where)
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = [args[0]] * len(value) if args[-1] is Ellipsis else args
        if len(inner) == len(value):
            return tuple(_convert(a, v, where) for a, v in zip(inner, value, strict=True))
    elif origin is Mapping and isinstance(value, Mapping):
        return MappingProxyType(dict(value))
    elif kind is float and type(value) in (int, float):
        return float(value)
    elif type(value) is kind:
        return value
    name = getattr(kind, "__name__", str(kind)) if origin is None else str(kind)
    raise ValueError(f"'{where}' must be {name}, not {value!r}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)`, or the known names where none is near."""
    names = sorted(known)
    near = get_close_matches(word, names, n=1)
    if near:
        return f" (did you mean '{near[0]}'?)"
    return f" (known: {', '.join(names)})" if names else ""
