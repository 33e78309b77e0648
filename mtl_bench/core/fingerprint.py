"""Fingerprints of the code that a stage runs, blind to where it stands and how it is worded.

The code is what can be reached from a stage's roots: the top-level definitions that they name,
those that these name, and so on, through imports of this package and of plug-in helpers. Each
counts by its syntax tree without comments, docstrings, annotations and imports, and a fingerprint
is of the sorted set of them. So a definition may be moved, reordered, reworded or imported in
another way; what it does may not change unseen. Nothing is imported: files are read as text.

A class of which only some members belong to a stage says so, for itself and its subclasses:

    stage_members = {"train": ("losses", "targets"), "evaluate": ("metric", "columns")}

A member that stands under other stages only does not count for this one, nor do members that only
such ones use. Members that stand nowhere count for every stage.
"""

import ast
import hashlib
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from mtl_bench.core.files import content
from mtl_bench.core.scope import COMPREHENSIONS, SCOPES, bound, is_text, same_scope

STAGES = ("train", "evaluate", "time")
PACKAGE = Path(__file__).resolve().parents[1]
NAME = "mtl_bench"
HARNESS = "harness"
# Rooms and modules that make no numbers. They parse, keep, tell and show; the values of a recipe
# stand in the cell's id.
EXCLUDED = {
    *("core.config", "core.recipe", "core.plain", "core.plugins", "core.provenance"),
    *("core.fingerprint", "core.columns", "core.quality", "core.files", "core.locks"),
    *("core.declared", "core.scope", "core.toml_file", "core.canvas", "core.view", "core.ranks"),
    *("train.progress", "train.tracking", "train.curve"),
    *("bench.jobs", "bench.store", "bench.data_state", "cli", "report", "show"),
}
MEMBERS = "stage_members"
NOT_RUN = ("TYPE_CHECKING", "typing.TYPE_CHECKING", "__name__ == '__main__'")
DROPPED = {"ctx", "type_comment", "kind", "type_params", "returns", "simple", "type_ignores"}


@dataclass(frozen=True)
class Root:
    """Where a stage's code begins: definitions of a file.

    Args:
        path: the file.
        names: of its definitions; none: its classes (or those that descend from `base`).
        part: what the file and its helpers outside the package are counted as.
        base: name of a class that the plug-in's class descends from.
    """

    path: Path
    names: tuple[str, ...] = ()
    part: str = HARNESS
    base: str | None = None


@dataclass(frozen=True)
class Target:
    """What an imported name stands for: a file of ours and a name in it, or something foreign."""

    path: Path | None = None
    name: str | None = None  # None: the module itself
    foreign: str = ""  # dotted


@dataclass
class Code:
    """A definition, or one of a module's other statements, in its normal form."""

    digest: str
    uses: list[Target] = field(default_factory=list)


def of_package(dotted: str) -> Path:
    """The file of a module of this package: `train`, `data.labels`."""
    found = _module_file(PACKAGE.joinpath(*dotted.split(".")) if dotted else PACKAGE)
    assert found is not None, dotted
    return found


def fingerprints(stage: str, roots: Iterable[Root]) -> dict[str, str]:
    """Part -> 12 hexadecimal digits of the code that a stage reaches from its roots.

    Raises:
        ValueError: a file that is no Python, or a root that it does not define.
    """
    forget_edited()
    key = stage, tuple(roots)
    if key not in _known:
        _known[key] = _by_part(reach(*key), key[1])
    return _known[key]


_modules: "dict[Path, tuple[tuple[int, int] | None, Module]]" = {}
_known: dict[tuple[str, tuple[Root, ...]], dict[str, str]] = {}


def _by_part(reached: "dict[tuple[Path, str], tuple[str, Code]]", roots: tuple[Root, ...]) -> Any:
    parts: dict[str, set[str]] = {part: set() for part in [*(r.part for r in roots), HARNESS]}
    for part, code in reached.values():
        # with the code it uses beside its own, names alike cannot be exchanged unseen
        used = [reached.get((t.path, t.name or "")) for t in code.uses if t.path is not None]
        beside = [found[1].digest for found in used if found is not None and found[0] == part]
        parts[part].add(_sha(code.digest, *beside))
    return {part: _sha(*sorted(digests))[:12] for part, digests in parts.items()}


def reach(stage: str, roots: Iterable[Root]) -> dict[tuple[Path, str], tuple[str, Code]]:
    """(file, name) of what a stage uses -> part and code; `#1`, ... are statements without names.

    Raises:
        ValueError: a file that is no Python, or a root that it does not define.
    """
    found: dict[tuple[Path, str], tuple[str, Code]] = {}
    entered: set[Path] = set()
    own = {root.path: root.part for root in reversed(tuple(roots))}
    for root in roots:
        left = [(root.part, Target(root.path, name)) for name in root.names or _classes(root)]
        for _, target in left:
            if not any(_definitions(target)):
                raise ValueError(f"{root.path} defines no '{target.name}'")
        while left:
            origin, target = left.pop()
            for path, name in _definitions(target):
                if (path, name) in found or excluded(path):
                    continue
                part = own.get(path, HARNESS if ours(path) else origin)
                module = load(path)
                codes = {name: module.code(name, stage)}
                if path not in entered:
                    entered.add(path)
                    codes |= {f"#{n}": module.code(f"#{n}") for n in range(len(module.effects))}
                for key, code in codes.items():
                    found[path, key] = part, code
                    left += [(part, use) for use in code.uses]
    return found


def ours(path: Path) -> bool:
    """Whether a file is this package's, and no plug-in."""
    return path.is_relative_to(PACKAGE) and not path.is_relative_to(PACKAGE / "_shipped")


@lru_cache(maxsize=4096)
def excluded(path: Path) -> bool:
    """Whether a file of this package makes no numbers; a plug-in's always may."""
    if not ours(path):
        return False
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return not {parts[0], ".".join(parts[:2])}.isdisjoint(EXCLUDED)


def _classes(root: Root) -> list[str]:
    """The class of a plug-in file; all of them where none is seen to descend from the base."""
    module = load(root.path)
    names = [n for n, s in module.statements.items() if isinstance(s[-1], ast.ClassDef)]
    heirs = [n for n in names if root.base in [b for _, b in list(ancestry(root.path, n))[1:]]]
    return heirs or names


def ancestry(path: Path, name: str) -> dict[tuple[Path, str], ast.ClassDef]:
    """A class and those of ours that it descends from, the nearest first, by file and name."""
    found: dict[tuple[Path, str], ast.ClassDef] = {}
    left = deque([(path, name)])
    while left:
        place = left.popleft()
        module = load(place[0])
        for statement in module.statements.get(place[1], []):
            if isinstance(statement, ast.ClassDef) and place not in found:
                found[place] = statement
                for base in statement.bases:
                    for target in _Normal(module).targets_of(base):
                        left.extend(_definitions(target))
    return found


def _definitions(target: Target) -> Iterator[tuple[Path, str]]:
    """Where a name is defined, through re-exports; of a module as a whole, all that it defines."""
    if target.path is None:
        return
    module = load(target.path)
    if target.name is None:
        yield from ((target.path, name) for name in module.statements)
    elif target.name in module.statements:
        yield target.path, target.name
    elif target.name in module.imports:
        yield from _definitions(module.imports[target.name])
    elif (inner := submodule(target.path, target.name)) is not None:
        yield from _definitions(Target(inner))
    else:
        for other in module.stars:
            yield from _definitions(Target(other, target.name))


# --- files ----------------------------------------------------------------------------------------


def stamp(path: Path) -> tuple[int, int] | None:
    """When a file was written, and its size; None where there is none."""
    try:
        status = path.stat()
    except OSError:  # gone, or a link that leads nowhere
        return None
    return status.st_mtime_ns, status.st_size


def forget_edited() -> None:
    """Read all files anew if one of them was edited."""
    if any(stamp(path) != seen for path, (seen, _) in _modules.items()):
        _modules.clear()
        _known.clear()


def load(path: Path) -> "Module":
    """A file as it was when this process first saw it, or saw that any had been edited."""
    if path not in _modules:
        _modules[path] = stamp(path), Module(path)
    return _modules[path][1]


@lru_cache(maxsize=4096)
def _module_file(place: Path) -> Path | None:
    """The file of a module whose path without suffix this is."""
    for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def submodule(path: Path, name: str | None) -> Path | None:
    """The module of this name in a package, whose `__init__.py` this is."""
    return _module_file(path.parent / name) if name and path.stem == "__init__" else None


class Module:
    """A file's top level: what it defines, imports and does."""

    def __init__(self, path: Path):
        self.path = path
        self.statements: dict[str, list[ast.stmt]] = {}
        self.imports: dict[str, Target] = {}
        self.stars: list[Path] = []
        self.effects: list[ast.stmt] = []  # what runs on import and defines nothing
        self._codes: dict[tuple[str, str], Code] = {}
        self._stages: dict[str, dict[str, set[str]] | None] = {}
        text = content(path)
        try:
            tree = ast.parse(text, str(path))
        except (SyntaxError, ValueError) as error:  # ValueError: null bytes
            line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
            raise ValueError(f"{path}{line}: {type(error).__name__}: {error.args[0]}") from None
        self.tree = tree
        for statement in tree.body:
            self._see(statement)

    def _see(self, statement: ast.stmt) -> None:
        nodes = same_scope([statement])
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                self.imports |= imported(node, self.path)
                if isinstance(node, ast.ImportFrom) and node.names[0].name == "*":
                    base = _base(node, self.path)
                    self.stars += [base] if base is not None else []
        if isinstance(statement, (ast.Import, ast.ImportFrom)) or is_text(statement):
            return
        if isinstance(statement, ast.If) and ast.unparse(statement.test) in NOT_RUN:
            return
        names = bound(nodes)
        for name in names:
            self.statements.setdefault(name, []).append(statement)
        if not names:
            self.effects.append(statement)

    def code(self, name: str, stage: str = "") -> Code:
        """The normal form of a definition, or of the statement `#N`."""
        if name.startswith("#"):
            stage, body = "", [self.effects[int(name[1:])]]
        else:
            body = self.statements[name]
        if name not in self._stages:
            self._stages[name] = self._stages_of(name)
        shared = self._stages[name] is None
        key = name, "" if shared else stage
        if key not in self._codes:
            normal = _Normal(self)
            for statement in body if shared else [self._for_stage(name, stage)]:
                normal.write(statement)
            self._codes[key] = Code(_sha("".join(normal.text)), normal.uses)
        return self._codes[key]

    def _stages_of(self, name: str) -> dict[str, set[str]] | None:
        """Stage -> members, as a class or its bases declare them."""
        if not isinstance(self.statements.get(name, [None])[-1], ast.ClassDef):
            return None
        found: dict[str, set[str]] | None = None
        for statement in ancestry(self.path, name).values():
            for member in statement.body:
                value = getattr(member, "value", None)
                if MEMBERS in bound(same_scope([member])) and value is not None:
                    found = found or {}
                    for stage, names in ast.literal_eval(value).items():
                        found.setdefault(stage, set()).update(names)
        return found

    def _for_stage(self, name: str, stage: str) -> ast.ClassDef:
        """A class with the members that count for a stage."""
        statement = self.statements[name][-1]
        declared = self._stages_of(name)
        assert isinstance(statement, ast.ClassDef)
        assert declared is not None
        members = [m for m in statement.body if MEMBERS not in bound(same_scope([m]))]
        named = {id(m): bound(same_scope([m])) for m in members}
        mentions = {
            id(m): {n.attr for n in ast.walk(m) if isinstance(n, ast.Attribute)}
            | {n.id for n in ast.walk(m) if isinstance(n, ast.Name)}
            for m in members
        }
        listed = set().union(*declared.values())
        others = listed - declared.get(stage, set())
        used_by_others = _closure(
            {id(m) for m in members if named[id(m)] & others}, members, named, mentions
        )
        kept = {
            id(m)
            for m in members
            if named[id(m)] & declared.get(stage, set())
            or not (named[id(m)] & listed or id(m) in used_by_others)
        }
        kept = _closure(kept, members, named, mentions)
        body = [m for m in members if id(m) in kept]
        return ast.ClassDef(
            name=statement.name,
            bases=statement.bases,
            keywords=statement.keywords,
            body=body,
            decorator_list=statement.decorator_list,
        )


def _closure(
    chosen: set[int],
    members: list[ast.stmt],
    named: dict[int, set[str]],
    mentions: dict[int, set[str]],
) -> set[int]:
    """Members, and those that they mention, and so on."""
    while True:
        mentioned = set().union(*(mentions[m] for m in chosen))
        more = chosen | {id(m) for m in members if named[id(m)] & mentioned}
        if more == chosen:
            return chosen
        chosen = more


# --- names ----------------------------------------------------------------------------------------


def imported(node: ast.Import | ast.ImportFrom, path: Path) -> dict[str, Target]:
    """Name -> what an import statement of a file binds it to."""
    found = {}
    if isinstance(node, ast.Import):
        for alias in node.names:
            dotted = alias.name if alias.asname else alias.name.partition(".")[0]
            first, _, rest = dotted.partition(".")
            ours = of_package(rest) if first == NAME else None
            found[alias.asname or dotted] = Target(ours, foreign="" if ours else dotted)
        return found
    base = _base(node, path)
    for alias in node.names:
        target = Target(base, alias.name)
        if base is None:
            target = Target(foreign=f"{'.' * node.level}{node.module or ''}.{alias.name}")
        found[alias.asname or alias.name] = target
    return found


def _base(node: ast.ImportFrom, path: Path) -> Path | None:
    """The file of ours that an import is from; None: it is foreign."""
    words = (node.module or "").split(".") if node.module else []
    if node.level:
        folder = path.parents[node.level - 1].joinpath(*words)
        # plug-ins' folders are packages without an __init__.py
        return _module_file(folder) or (folder / "__init__.py" if folder.is_dir() else None)
    return of_package(".".join(words[1:])) if words[:1] == [NAME] else None


class _Normal:
    """Writes nodes in their normal form, and notes which definitions they use."""

    def __init__(self, module: Module):
        self.module = module
        self.text: list[str] = []
        self.uses: list[Target] = []
        self.scopes: list[dict[str, Target | None]] = []  # None: a variable
        self.in_class = False

    def targets_of(self, node: ast.AST) -> list[Target]:
        self.write(node)
        return self.uses

    def write(self, node: Any) -> None:
        """Append a node's text."""
        if isinstance(node, list):
            self.text.append("[")
            for item in node:
                self.write(item)
            self.text.append("]")
        elif not isinstance(node, ast.AST):
            self.text.append(f"{type(node).__name__} {node!r},")
        elif isinstance(node, (ast.Import, ast.ImportFrom)) or is_text(node):
            pass
        elif isinstance(node, (ast.Name, ast.Attribute)):
            if not self._dotted(node):
                self._fields(node)
        elif isinstance(node, SCOPES):
            self._function(node)
        elif isinstance(node, COMPREHENSIONS):
            targets = bound(same_scope(generator.target for generator in node.generators))
            self.scopes.append(dict.fromkeys(targets))
            self._fields(node)
            self.scopes.pop()
        elif isinstance(node, ast.ClassDef):
            outer, self.in_class = self.in_class, True
            self._fields(node)
            self.in_class = outer
        elif isinstance(node, ast.AnnAssign):
            self._annotated(node)
        else:
            self._fields(node)

    def _fields(self, node: ast.AST) -> None:
        self.text.append(f"{type(node).__name__}(")
        for name, value in ast.iter_fields(node):
            if name == "annotation":
                self._follow(value)
            elif name not in DROPPED and value is not None and value != []:
                self.text.append(f"{name}=")
                self.write(value)
        self.text.append(")")

    def _function(self, node: Any) -> None:
        """Defaults and decorators are of the scope outside; annotations are followed only."""
        arguments: ast.arguments = node.args
        every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
        every += [a for a in (arguments.vararg, arguments.kwarg) if a is not None]
        for annotation in [*(a.annotation for a in every), getattr(node, "returns", None)]:
            self._follow(annotation)
        body = node.body if isinstance(node.body, list) else [node.body]
        nodes = same_scope(body)
        local: dict[str, Target | None] = dict.fromkeys([*(a.arg for a in every), *bound(nodes)])
        for inner in nodes:
            if isinstance(inner, (ast.Import, ast.ImportFrom)):
                local |= imported(inner, self.module.path)
        self.text.append(f"{type(node).__name__} {getattr(node, 'name', '')}(")
        self.write(getattr(node, "decorator_list", []))
        for name, values in ast.iter_fields(arguments):
            self.text.append(f"{name}=")
            if name in ("defaults", "kw_defaults"):
                self.write(values)
            else:
                several = values if isinstance(values, list) else [values]
                self.text.append(repr([a.arg for a in several if a is not None]))
        self.scopes.append(local)
        outer, self.in_class = self.in_class, False
        self.write(body)
        self.in_class = outer
        self.scopes.pop()
        self.text.append(")")

    def _annotated(self, node: ast.AnnAssign) -> None:
        if self.in_class:
            self.text.append("Field(")
            self.write(node.annotation)
        else:
            self._follow(node.annotation)
            if node.value is None:
                return
            self.text.append("Assign(")  # as without the annotation
        self.text.append("targets=")
        self.write([node.target])
        if node.value is not None:
            self.text.append("value=")
            self.write(node.value)
        self.text.append(")")

    def _follow(self, annotation: ast.AST | None) -> None:
        """Use what an annotation names, without a trace in the text."""
        if annotation is not None:
            kept, self.text = self.text, []
            self.write(annotation)
            self.text = kept

    def _dotted(self, node: ast.Name | ast.Attribute) -> bool:
        """Write a name, or `module.name`, as what it stands for; False: it is something else."""
        attributes: list[str] = []
        base: ast.AST = node
        while isinstance(base, ast.Attribute):
            attributes.insert(0, base.attr)
            base = base.value
        if not isinstance(base, ast.Name):
            return False
        target = self._target(base.id)
        if target is None:
            if attributes:
                return False
            self.text.append(f"name {base.id},")
            return True
        if target.path is None:
            self.text.append(f"name {'.'.join([target.foreign, *attributes])},")
            return True
        while True:
            path, name = target.path, target.name
            module = load(path) if path.is_file() else None
            if name is None and attributes:
                target = Target(path, attributes.pop(0))
            elif (
                name is not None
                and not (module and name in module.statements)
                # a package that imports its own submodule binds it to itself
                and (not module or module.imports.get(name) in (None, Target(path, name)))
                and (inner := submodule(path, name)) is not None
            ):
                target = Target(inner)
            elif module and name in module.imports and module.imports[name].path is None:
                target = module.imports[name]  # foreign, re-exported
                break
            elif module and name in module.imports and name not in module.statements:
                target = module.imports[name]
            else:
                break
            assert target.path is not None
        if target.path is None:
            self.text.append(f"name {'.'.join([target.foreign, *attributes])},")
            return True
        self.uses.append(target)
        self.text.append(f"name {'.'.join([target.name or 'module', *attributes])},")
        return True

    def _target(self, name: str) -> Target | None:
        """What a name stands for where it is read; None: a variable or a builtin."""
        for scope in reversed(self.scopes):
            if name in scope:
                return scope[name]
        if name in self.module.statements:
            return Target(self.module.path, name)
        if name in self.module.imports:
            return self.module.imports[name]
        starred = (Target(path, name) for path in self.module.stars)
        return next((target for target in starred if any(_definitions(target))), None)


def _sha(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()
