"""The columns of what tasks measure, in the order in which a table has them.

They are read from the tasks' files as text, so that a list of results need not wait for torch.
"""

import ast
import functools
from dataclasses import replace

from mtl_bench.core import plugins
from mtl_bench.core.columns import Column

ALLOWED = (
    *(ast.Call, ast.Name, ast.Starred, ast.Tuple, ast.keyword, ast.Constant, ast.UnaryOp),
    *(ast.UAdd, ast.USub, ast.Load),
)


def quality() -> tuple[Column, ...]:
    """Of every task that is found, each behind those whose results it reads."""
    found: dict[str, Column] = {}
    for name in plugins.ordered(plugins.files("tasks")):
        for column in columns_of(name):
            found.setdefault(column.name, column)  # a task's heir has its columns, too
    return tuple(found.values())


def columns_of(task: str) -> tuple[Column, ...]:
    """A task's columns; an heir's come after those of the task that it derives from.

    Raises:
        ValueError: anything but columns of plain values.
    """
    text = plugins.path_of("tasks", task).read_bytes()
    inherited = [column for base in plugins.bases("tasks", text) for column in columns_of(base)]
    return (*inherited, *_columns(task, text))


@functools.cache
def _columns(task: str, text: bytes) -> tuple[Column, ...]:
    """What a file's `columns = (Column(...), ...)` says."""
    for node in plugins.class_attributes(text, "columns"):
        for part in ast.walk(node):
            known = isinstance(part, ALLOWED)
            if not known or (isinstance(part, ast.Name) and part.id != "Column"):
                raise ValueError(f"task '{task}': columns are a tuple of Column(...) of values")
        made = eval(compile(ast.Expression(node), task, "eval"), {"Column": Column})
        return tuple(replace(column, task=task) for column in made)
    return ()


def in_brief() -> list[Column]:
    """The first numbers that one wants to see: each task's headlines, then its other short ones."""
    found = quality()
    tasks = list(dict.fromkeys(column.task for column in found))
    shown = [c for c in found if c.headline or (c.short and c.in_delta)]
    return sorted(shown, key=lambda column: (tasks.index(column.task), not column.headline))
