"""What a plug-in's class says of itself, read from its syntax tree: attributes, and arguments.

A line of classes is a class, its base, the base's base, ...: see `plugins.lineage`.
"""

import ast
import contextlib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

GIVEN = (  # the harness fills these arguments in
    *("self", "terms", "seed", "strides", "size", "outputs", "pretrained"),
)
TOLD = re.compile(r"^ {4}(\w[\w, ]*): (.*(?:\n {8}.*)*)", re.MULTILINE)  # in a section Args
PLAIN = {"int": int, "float": float, "bool": bool, "str": str}


class Argument(NamedTuple):
    """An argument of a plug-in's constructor that is its user's to set."""

    kind: Any  # its type, as `plain.convert` takes it; Any where the file says none that is known
    text: str  # its default, as it is written
    default: Any  # its value; ... where it is no literal
    about: str = ""  # what the class's docstring says of it


def declared_in(line: Sequence[ast.ClassDef]) -> dict[str, Any]:
    """Class attributes whose value is written out; the nearest class counts."""
    values = ((name, literal(value)) for name, value in assigned_in(reversed(line)))
    return {name: value for name, value in values if value is not ...}


def assigned_in(classes: Iterable[ast.ClassDef]) -> Iterator[tuple[str, ast.expr]]:
    """Names and values that the bodies of classes assign, one after another."""
    for item in itertools.chain.from_iterable(node.body for node in classes):
        targets = item.targets if isinstance(item, ast.Assign) else [getattr(item, "target", None)]
        if isinstance(item, (ast.Assign, ast.AnnAssign)) and item.value is not None:
            yield from ((ast.unparse(target), item.value) for target in targets if target)


def literal(written: ast.expr) -> Any:
    """Its value; ... where it is none that is written out."""
    with contextlib.suppress(ValueError):
        return ast.literal_eval(_frozen(written))
    return ...


def _frozen(written: ast.expr) -> ast.expr:
    """What stands in a MappingProxyType, or the expression itself."""
    if isinstance(written, ast.Call) and ast.unparse(written.func) == "MappingProxyType":
        return written.args[0]
    return written


def arguments_of(line: Sequence[ast.ClassDef]) -> dict[str, Argument]:
    """Of a class and its bases, the nearest first: those of the nearest constructor."""
    items = (item for node in line for item in node.body if isinstance(item, ast.FunctionDef))
    for item in items:
        if item.name == "__init__":
            break
    else:
        return {}
    plain, keywords = [*item.args.posonlyargs, *item.args.args], item.args.kwonlyargs
    defaults = [*[None] * (len(plain) - len(item.args.defaults)), *item.args.defaults]
    pairs = zip([*plain, *keywords], [*defaults, *item.args.kw_defaults], strict=True)
    told = _told(line)
    return {
        found.arg: _argument(found.annotation, default)._replace(about=told.get(found.arg, ""))
        for found, default in pairs
        if found.arg not in GIVEN
    }


def _told(line: Sequence[ast.ClassDef]) -> dict[str, str]:
    """Argument -> what the section Args of its class's docstring says; `a, b: ...` is of both."""
    found: dict[str, str] = {}
    for node in line:
        section = (ast.get_docstring(node) or "").partition("\nArgs:\n")[2]
        for names, text in TOLD.findall(section):
            found |= {name: " ".join(text.split()) for name in names.split(", ")} | found
    return found


def _argument(annotation: ast.expr | None, written: ast.expr | None) -> Argument:
    inner = None if written is None else _frozen(written)
    default: Any = ... if inner is None else literal(inner)
    of = type(default) if type(default) in PLAIN.values() else Any
    kind = of if annotation is None else _type(annotation)
    return Argument(kind, "" if inner is None else ast.unparse(inner), default)


def _type(node: ast.expr) -> Any:
    """What an annotation stands for; Any where that is no type of plain values."""
    match node:
        case ast.Name(id=name):
            return PLAIN.get(name, Any)
        case ast.Constant(value=None):
            return None
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            sides = _type(left), _type(right)
            return Any if Any in sides else sides[0] | sides[1]
        case ast.Subscript(value=ast.Name(id="tuple"), slice=ast.Tuple(elts=inner)):
            if isinstance(inner[-1], ast.Constant):  # ...
                return tuple[_type(inner[0]), ...]  # type: ignore[misc]
            return tuple[tuple(map(_type, inner))]  # type: ignore[misc]
        case ast.Subscript(value=ast.Name(id="Mapping"), slice=ast.Tuple(elts=[_, value])):
            return Mapping[str, _type(value)]  # type: ignore[misc]
    return Any
