"""The columns of what tasks measure, in the order in which a table has them.

They are read from the tasks' files as text, so that a list of results need not wait for torch.
"""

import ast
import functools
from dataclasses import replace

from mtl_bench.core import plugins
from mtl_bench.core.columns import Column

ALLOWED = (ast.Call, ast.Name, ast.Starred, ast.Tuple, ast.keyword, ast.Constant, ast.UnaryOp)
ALLOWED += (ast.UAdd, ast.USub, ast.Load)


def quality() -> tuple[Column, ...]:
    """Of every task that can be read, each behind those whose results it reads."""
    return tuple(
        column
        for name in plugins.ordered(plugins.readable("tasks"))
        for column in _columns(name, plugins.path_of("tasks", name).read_bytes())
    )


@functools.cache
def _columns(task: str, text: bytes) -> tuple[Column, ...]:
    """What a file's `columns = (Column(...), ...)` says.

    Raises:
        ValueError: anything but columns of plain values.
    """
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
