"""Finds, describes and loads plug-ins: one file each, whose stem is its name.

Kinds: methods, backbones, tasks, datasets, engines. Searched in this order: the package's own
folders (the checkout's, or those inside an installed wheel), those of the working directory, and
what `--plugins` names: a folder with such folders in it, a folder of plug-ins of any kind, or one
file. A file reached twice counts once; a package's file is its `__init__.py`. `_name.py` is a
helper that its neighbours import with `from ._name import ...`.

Finding and describing read the files as text; only `load` runs one. A task that is of one field of
the data set is named with that: `regress:y0` is `regress.py`'s task on the field y0.
"""

import ast
import contextlib
import functools
import hashlib
import importlib
import importlib.util
import inspect
import os
import re
import sys
import traceback
import types
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from mtl_bench.core.declared import Argument, arguments_of, assigned_in, declared_in, literal
from mtl_bench.core.files import content
from mtl_bench.core.fingerprint import (
    ancestry,
    forget_edited,
    imported,
    of_package,
    ours,
    stamp,
    submodule,
)
from mtl_bench.core.fingerprint import load as load_text
from mtl_bench.core.plain import Rule, did_you_mean

PACKAGE = Path(__file__).resolve().parents[1]
VARIABLE = "MTL_BENCH_PLUGINS"  # what --plugins adds to; the processes that run cells inherit it
BASES = {  # kind -> its contract, and the base of every plug-in
    "methods": ("mtl_bench.core.method", "Method"),
    "backbones": ("mtl_bench.core.backbone", "Backbone"),
    "tasks": ("mtl_bench.core.task", "Task"),
    "datasets": ("mtl_bench.core.dataset", "Dataset"),
    "engines": ("mtl_bench.core.engine", "Engine"),
}
KINDS = tuple(BASES)
SHIPPED = {  # in the package; the others have a folder of their own beside it
    "tasks": PACKAGE / "tasks",
    "datasets": PACKAGE / "data",
    "engines": PACKAGE / "deploy" / "engines",
}
NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")  # ASCII, and short: runs' folders are called by it
ANY = "[!_.]*"  # matches the stems of plug-ins, and not those of what lies beside them
NAMED = "is no name: a lower-case letter, then at most 63 such letters, digits and _"
IS_NAME = Rule(
    "a name of a-z, 0-9 and _",
    lambda value: all(NAME.fullmatch(part) for part in part_names(value) if value),
)
IS_TASK = Rule(
    "a name of a-z, 0-9 and _, or that, a colon and a field of letters, digits and _",
    lambda value: bool(re.fullmatch(rf"{NAME.pattern}(:\w+)?", value, re.ASCII)),
)

_listed: ContextVar[dict[tuple[str, str], dict[str, list[Path]]] | None] = ContextVar(
    "listed", default=None
)


@dataclass(frozen=True)
class Description:
    name: str
    summary: str  # first line of the file's docstring
    path: Path
    error: str | None = None  # why it cannot be chosen
    doc: str = ""


# --- finding --------------------------------------------------------------------------------------


def add_folder(path: Path | str) -> None:
    """Search a folder (or one file) too, in this process and in those that it starts.

    Raises:
        ValueError: no such folder, or a path that a list of paths cannot hold.
    """
    place = Path(path).resolve()
    if not (place.is_dir() or (place.suffix == ".py" and place.is_file())):
        raise ValueError(f"no plug-in folder or file '{path}'")
    if os.pathsep in str(place):
        raise ValueError(f"plug-in folder '{place}': its path may not contain '{os.pathsep}'")
    known = [p for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    if str(place) not in known:
        os.environ[VARIABLE] = os.pathsep.join([*known, str(place)])


def folders(kind: str) -> list[Path]:
    """Where plug-ins of a kind are searched, in order; only those that exist."""
    shipped = PACKAGE / "_shipped"
    own = shipped if shipped.is_dir() else PACKAGE.parent
    extra = [Path(p) for p in os.environ.get(VARIABLE, "").split(os.pathsep) if p]
    found = [SHIPPED.get(kind, own / kind), *(root / kind for root in (Path.cwd(), *extra))]
    found += [place for place in extra if place.is_dir()]
    return list(dict.fromkeys(place.resolve() for place in found if place.is_dir()))


def files(kind: str) -> dict[str, Path]:
    """Name -> file; the first where two folders have the same name (`path_of` refuses those)."""
    return {name: paths[0] for name, paths in _candidates(kind).items()}


def path_of(kind: str, name: str) -> Path:
    """The file of a plug-in.

    Raises:
        ValueError: an unknown name, one that two files have, or what is no name.
    """
    name = stem_and_field(name)[0]
    word = kind[:-1]
    paths = _candidates(kind, name if NAME.fullmatch(name) else ANY).get(name)
    if paths is None:
        raise ValueError(
            f"no {word} called '{name}'{did_you_mean(name, files(kind))}; "
            f"to add it, write {kind}/{name}.py (mtl-bench new {word} {name})"
        )
    if len(paths) > 1:
        raise ValueError(f"two {kind} are called '{name}': {paths[0]} and {paths[1]}; rename one")
    if not NAME.fullmatch(name):
        raise ValueError(f"'{name}' {NAMED}; rename {paths[0]}")
    return paths[0]


def kinds_of(name: str) -> list[str]:
    """The kinds that have a plug-in of this name."""
    return [kind for kind in KINDS if name in _candidates(kind)]


@contextlib.contextmanager
def listed_once() -> Iterator[None]:
    """Within, folders are listed once: for a walk over many jobs, each of which asks for some."""
    outer = _listed.get()
    token = _listed.set({} if outer is None else outer)
    try:
        yield
    finally:
        _listed.reset(token)


def _candidates(kind: str, name: str = ANY) -> dict[str, list[Path]]:
    """Files by name: at least of one name, whose other files need not be read, or of any."""
    seen = _listed.get()
    if seen is None:
        return _found(kind, name)
    key = kind, os.environ.get(VARIABLE, "")
    if key not in seen:
        seen[key] = _found(kind, ANY)
    return seen[key]


def _found(kind: str, name: str) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    paths = [path for folder in folders(kind) for path in _files_in(folder, name)]
    extra = (Path(p) for p in os.environ.get(VARIABLE, "").split(os.pathsep))
    paths += [path for path in extra if path.is_file() and fnmatchcase(name_of(path), name)]
    for path in dict.fromkeys(path.resolve() if path.is_file() else path for path in paths):
        if _kind_of(path) == kind:
            found.setdefault(name_of(path), []).append(path)
    return dict(sorted(found.items()))


def stamps(*kinds: str) -> tuple[object, ...]:
    """What changes when a file of these kinds comes, goes or is edited."""
    paths = [path for kind in kinds for several in _candidates(kind).values() for path in several]
    return tuple((path, stamp(path)) for path in paths)


def stem_and_field(task: str) -> tuple[str, str]:
    """A task's file and the field that it is of: `regress:y0` -> regress, y0; without one ""."""
    stem, _, field = task.partition(":")
    return stem, field


def _files_in(folder: Path, name: str) -> list[Path]:
    """Links that lead nowhere, too, of which a list tells that they are broken."""
    if name == ANY:
        return sorted([*folder.glob(f"{name}.py"), *folder.glob(f"{name}/__init__.py")])
    return [p for p in (folder / f"{name}.py", folder / name / "__init__.py") if os.path.lexists(p)]


def name_of(path: Path) -> str:
    """The stem; of a package its folder's name."""
    return path.parent.name if path.stem == "__init__" else path.stem


def _kind_of(path: Path) -> str | None:
    """By the folder's name; in a folder of another name, by what the file imports or defines."""
    folder = path.parent.parent if path.stem == "__init__" else path.parent
    for kind, place in SHIPPED.items():
        if folder == place:  # other modules lie beside the plug-ins
            try:
                return kind if _derives(path, kind) else None
            except ValueError:  # listed as broken
                return kind
    if folder.name in KINDS:
        return folder.name
    if not path.is_file():  # a link that leads nowhere
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    for kind, (module, base) in BASES.items():
        package, _, last = module.rpartition(".")
        imports = (
            rf"^\s*(from\s+{module}\b|import\s+{module}\b|from\s+{package}\s+import\s+{last}\b)"
        )
        if re.search(imports, text, re.MULTILINE) and base in text:
            return kind
    return None


@functools.cache
def _derives(path: Path, kind: str) -> bool:
    """Whether a file of this package defines a class that descends from a kind's contract."""
    return bool(lineage(kind, path))


def lineage(kind: str, path: Path) -> list[ast.ClassDef]:
    """A file's plug-in class, its base, the base's base, ...; empty if none leads to the contract.

    Raises:
        ValueError: a file that is no Python.
    """
    module, base = BASES[kind]
    contract = of_package(module.removeprefix("mtl_bench.")), base
    public = [name for name in load_text(path).statements if not name.startswith("_")]
    lines = (ancestry(path, name) for name in public)
    return next((list(line.values()) for line in lines if contract in [*line][1:]), [])


def declared(kind: str, name: str) -> dict[str, object]:
    """As `declared_in`, of a plug-in by its name; also what its bases declare, without importing.

    Raises:
        ValueError: an unknown or ambiguous name, or a file that is no Python.
    """
    return declared_in(lineage(kind, path_of(kind, name)))


def read_attribute(kind: str, name: str, attribute: str) -> Any:
    """A class attribute of a plug-in that its contract has, be it a base's, without importing.

    Raises:
        ValueError: it is not written out; an unknown plug-in, or none of this kind.
    """
    path = path_of(kind, name)
    line = lineage(kind, path)
    if not line:
        raise ValueError(f"{path} defines no subclass of {BASES[kind][1]}")
    *_, written = (value for other, value in assigned_in(reversed(line)) if other == attribute)
    value = literal(written)
    if value is ...:
        raise ValueError(
            f"{path}: {attribute} = {ast.unparse(written)} cannot be read without running it; "
            f"write its values out"
        )
    return value


@functools.cache
def _parse(text: bytes) -> ast.Module:
    return ast.parse(text)


# --- describing -----------------------------------------------------------------------------------


def describe(kind: str) -> list[Description]:
    """Every plug-in of a kind, in order of name, without importing any."""
    return [_describe(name, paths) for name, paths in _candidates(kind).items()]


def _describe(name: str, paths: list[Path]) -> Description:
    path = paths[0]
    try:
        tree = _parse(content(path))
    except (SyntaxError, ValueError) as error:  # ValueError: null bytes, or no file
        line = f" (line {error.lineno})" if isinstance(error, SyntaxError) else ""
        return Description(name, "", path, f"{type(error).__name__}: {error.args[0]}{line}")
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    doc = ast.get_docstring(tree) or next(filter(None, map(ast.get_docstring, classes)), "")
    missing = sorted(_imports(tree) - {name for name in _imports(tree) if _installed(name)})
    wrong = None
    if len(paths) > 1:
        wrong = f"two files have this name: {paths[0]} and {paths[1]}"
    elif not NAME.fullmatch(name):
        wrong = f"'{name}' {NAMED}"
    elif not classes:
        wrong = "defines no class"
    elif missing:
        wrong = f"needs {', '.join(missing)}, not installed here"
    return Description(name, doc.partition("\n")[0], path, wrong, doc)


def _imports(tree: ast.Module) -> set[str]:
    """Top-level packages that the file imports when it is loaded."""
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def _installed(package: str) -> bool:
    return package in sys.modules or importlib.util.find_spec(package) is not None


def attributes(kind: str, name: str) -> dict[str, Any]:
    """Class attributes of a plug-in that have a literal value, without importing it.

    Raises:
        ValueError: an unknown or ambiguous name.
    """
    return dict(_attributes(content(path_of(kind, name))))


@functools.cache
def _attributes(text: bytes) -> Mapping[str, Any]:
    values = ((name, literal(value)) for name, value in _assigned(text))
    return {name: value for name, value in values if value is not ...}


def readable(kind: str) -> list[str]:
    """Names whose attributes can be read: of one file, which is Python."""
    found = []
    for name, paths in _candidates(kind).items():
        with contextlib.suppress(SyntaxError, ValueError):  # ValueError: null bytes, or no file
            _parse(content(paths[0]))
            found += [name] * (len(paths) == 1)
    return found


def class_attributes(text: bytes, name: str) -> list[ast.expr]:
    """What a plug-in's class assigns to a name, as it is written."""
    return [value for other, value in _assigned(text) if other == name]


def _assigned(text: bytes) -> Iterator[tuple[str, ast.expr]]:
    """Names and values in the bodies of a file's classes: of those that derive from a contract, or
    where none does directly of all."""
    classes = [node for node in _parse(text).body if isinstance(node, ast.ClassDef)]
    contracts = {base for _, base in BASES.values()}
    own = [c for c in classes if {ast.unparse(b) for b in c.bases} & contracts]
    yield from assigned_in(own or classes)


def bases(kind: str, text: bytes) -> list[str]:
    """Names of the shipped plug-ins that a file's classes derive from."""
    package = ".".join(("mtl_bench", *SHIPPED[kind].relative_to(PACKAGE).parts))
    tree = _parse(text)
    derived = {
        ast.unparse(base)
        for node in tree.body
        if isinstance(node, ast.ClassDef)
        for base in node.bases
    }
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module]
    return [
        str(node.module).removeprefix(f"{package}.")
        for node in imports
        if str(node.module).rpartition(".")[0] == package
        and any((alias.asname or alias.name) in derived for alias in node.names)
    ]


def family(task: str) -> set[str]:
    """A task and those that it derives from."""
    found = {task}
    for base in bases("tasks", path_of("tasks", task).read_bytes()):
        found |= family(base)
    return found


def ordered(tasks: Iterable[str]) -> list[str]:
    """Names of tasks, each behind those whose results it reads, else by the alphabet.

    Raises:
        ValueError: an unknown task, or tasks that wait for each other.
    """
    after = {name: _after(name) for name in sorted(tasks)}
    found: list[str] = []
    while len(found) < len(after):
        ready = [n for n in after if n not in found and after[n] & after.keys() <= set(found)]
        if not ready:
            raise ValueError(f"tasks wait for each other: {', '.join(after.keys() - set(found))}")
        found.append(ready[0])
    return found


def _after(task: str) -> set[str]:
    """Tasks whose results a task reads; an heir's are those of the task that it derives from."""
    found = [attributes("tasks", name).get("after") for name in family(task)]
    return set().union(*filter(None, found))


def lack(packages: Iterable[str], extra: Iterable[str]) -> str | None:
    """Which of the packages are not installed here, and how to install them; None: all are."""
    lacking = [package for package in packages if importlib.util.find_spec(package) is None]
    if not lacking:
        return None
    words = " ".join(f"'{word}'" for word in extra)
    return f"lacks the package {', '.join(lacking)}" + (f": pip install {words}" if words else "")


# --- loading --------------------------------------------------------------------------------------


def load(kind: str, name: str) -> type[Any]:
    """The class of a plug-in.

    Raises:
        ValueError: unknown or ambiguous name, a file that fails to import (with its line), or one
            that does not define exactly one subclass of `Method` (`Backbone`, `Engine`).
    """
    path, name = path_of(kind, name), stem_and_field(name)[0]
    base_module, base_name = BASES[kind]
    base = getattr(importlib.import_module(base_module), base_name)
    if path.is_relative_to(PACKAGE) and kind in SHIPPED:
        module_name = ".".join(("mtl_bench", *path.relative_to(PACKAGE).with_suffix("").parts))
        module = importlib.import_module(module_name.removesuffix(".__init__"))
        return _only_subclass(module, base, name, path)
    package = f"mtl_bench_plugins_{hashlib.sha256(str(path.parent).encode()).hexdigest()[:8]}"
    if package not in sys.modules:  # a package per folder: relative imports work, nothing leaks out
        sys.modules[package] = types.ModuleType(package)
        sys.modules[package].__path__ = [str(path.parent)]
    module_name, version = f"{package}.{name}", fingerprint(kind, name)
    if getattr(sys.modules.get(module_name), "_fingerprint", version) != version:
        for loaded in [m for m in sys.modules if m.startswith(f"{package}.")]:
            del sys.modules[loaded]  # edited since: an open session sees the new file
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        line = next(
            (
                f", line {f.lineno}"
                for f in reversed(traceback.extract_tb(error.__traceback__))
                if f.filename == str(path)
            ),
            "",
        )
        raise ValueError(f"{path}{line}: {type(error).__name__}: {error}") from error
    vars(module)["_fingerprint"] = version
    return _only_subclass(module, base, name, path)


def _only_subclass(module: types.ModuleType, base: type[Any], name: str, path: Path) -> type[Any]:
    """The one subclass that a module defines, told its name."""
    own = [c for c in vars(module).values() if inspect.isclass(c)]
    own = [c for c in own if c.__module__ == module.__name__ and issubclass(c, base)]
    found = list(dict.fromkeys(own))
    if len(found) != 1:
        names = ", ".join(c.__name__ for c in found) or "none"
        raise ValueError(f"{path} must define one subclass of {base.__name__}, and defines {names}")
    if hasattr(base, "name"):
        vars_of: Any = found[0]
        vars_of.name = name
    return found[0]


def part_names(method: str) -> list[str]:
    """The names in `a` or in a composition `a+b`."""
    return method.split("+")


def fingerprint(kind: str, name: str) -> str:
    """12 hexadecimal digits of the file (or of both files of `a+b`) and the helpers it imports."""
    forget_edited()
    digest = hashlib.sha256()
    for part in part_names(name):
        for path in _with_helpers(path_of(kind, part)):
            digest.update(path.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()[:12]


def _with_helpers(path: Path) -> list[Path]:
    """A file and those outside of this package that it imports, directly or through another."""
    found, left = {path}, [path]
    while left:
        path = left.pop()
        for node in ast.walk(load_text(path).tree):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                targets = imported(node, path).values()
                named = [(t.path, t.name) for t in targets if t.path is not None]
                files = {file for file, _ in named} | {submodule(*pair) for pair in named}
                new = {f for f in files - found if f is not None and f.is_file() and not ours(f)}
                found |= new
                left += new
    return sorted(found)


def arguments(kind: str, name: str) -> dict[str, Argument]:
    """Hyper-parameters: the constructor's arguments that the harness leaves alone, by name.

    Raises:
        ValueError: an unknown or ambiguous plug-in, or one that is no Python.
    """
    path = path_of(kind, name)
    forget_edited()
    return arguments_of(lineage(kind, path))
