"""What tasks declare of themselves: the columns of what they measure, and words for reports.

It is read from the tasks' files as text, so that a list of results need not wait for torch.
"""

import ast
import functools
import itertools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from mtl_bench.core import plugins
from mtl_bench.core.columns import Column
from mtl_bench.core.recipe import Recipe

VALUES = ast.Call | ast.Name | ast.Starred | ast.Tuple | ast.Dict | ast.keyword | ast.Constant
SIGNS = ast.UnaryOp | ast.UAdd | ast.USub | ast.Load
T = TypeVar("T")


def declared(name: str) -> dict[str, Any]:
    """By task, what its class assigns to a name; every task is behind those it comes `after`.

    Tasks that assign nothing are absent.
    """
    paths = {task: plugins.path_of("tasks", task) for task in _tasks()}
    found = {task: _read(task, path.read_bytes(), name) for task, path in paths.items()}
    return {task: value for task, value in found.items() if value is not None}


def _tasks() -> list[str]:
    """Those that are found, the default recipe's first: one more changes no report without it."""
    return sorted(plugins.ordered(plugins.readable("tasks")), key=lambda t: t not in Recipe.tasks)


@functools.cache
def _read(task: str, text: bytes, name: str) -> Any:
    """What a file's class says: plain values and `Column(...)` of such; None where it does not.

    Raises:
        ValueError: anything else.
    """
    for node in plugins.class_attributes(text, name):
        for part in ast.walk(node):
            known = isinstance(part, VALUES | SIGNS)
            if not known or (isinstance(part, ast.Name) and part.id != "Column"):
                raise ValueError(f"task '{task}': {name} are plain values and Column(...) of them")
        return eval(compile(ast.Expression(node), task, "eval"), {"Column": Column})
    return None


def quality() -> tuple[Column, ...]:
    """The columns of what tasks measure, in the order in which a table has them."""
    return _columns("columns")


def agreement() -> tuple[Column, ...]:
    """The columns of how near an engine's results are."""
    columns = _columns("agreement")
    tasks = dict.fromkeys(column.task for column in columns)
    return tuple(in_turns([c for c in columns if c.task == task] for task in tasks))


def words(key: str, tasks: Collection[str]) -> list[str]:
    """What these tasks' `words` say under a key."""
    stems = {plugins.stem_and_field(task)[0] for task in tasks}
    found = declared("words").items()
    return [said[key] for task, said in found if key in said and task in stems]


def in_turns(several: Iterable[Sequence[T]]) -> list[T]:
    """The first of each, then the second of each, and so on."""
    turns = itertools.zip_longest(*several)
    return [item for turn in turns for item in turn if item is not None]


def columns_of(task: str, name: str = "columns") -> list[Column]:
    """A task's columns; an heir's come after those of the task that it derives from.

    One that is of a field has them once for each field that a data set has for it.
    """
    text = plugins.path_of("tasks", task).read_bytes()
    inherited = [c for base in plugins.bases("tasks", text) for c in columns_of(base, name)]
    own = [*inherited, *(replace(c, task=task) for c in _read(task, text, name) or ())]
    if not plugins.attributes("tasks", task).get("of_field"):
        return own
    datasets = [plugins.attributes("datasets", name) for name in plugins.readable("datasets")]
    several = [facts.get("predicts", {}).get(task, ()) for facts in datasets]
    fields = dict.fromkeys(itertools.chain.from_iterable(several))
    return [_of_field(column, field) for field in fields for column in own]


def _of_field(column: Column, field: str) -> Column:
    """`regress.rmse` of the field y0 is `regress.y0.rmse`."""
    return replace(
        column,
        name=f"{field}_{column.name}",
        key=column.key.replace(".", f".{field}.", 1),
        title=f"{field.replace('_', ' ')} {column.title}",
        task=f"{column.task}:{field}",
    )


def _columns(name: str) -> tuple[Column, ...]:
    """Of every task that is found; an heir's own alone, as its task's are there."""
    return _read_columns(name, plugins.stamps("tasks", "datasets"))


@functools.lru_cache(maxsize=8)
def _read_columns(name: str, stamps: tuple[object, ...]) -> tuple[Column, ...]:
    """Read once, as long as the files are those: reports ask for every number."""
    found = {c.name: c for task in _tasks() for c in columns_of(task, name)}
    return tuple(found.values())


def in_brief() -> list[Column]:
    """The first numbers that one wants to see: each task's headlines, then its other short ones."""
    found = quality()
    tasks = list(dict.fromkeys(column.task for column in found))
    shown = [c for c in found if c.headline or (c.short and c.in_delta)]
    return sorted(shown, key=lambda column: (tasks.index(column.task), not column.headline))
