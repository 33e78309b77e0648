"""The tests that every plug-in gets by being in its folder: `mtl-bench check NAME`."""

import ast
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mtl_bench.bench.check.backbones import BACKBONE_CHECKS
from mtl_bench.bench.check.datasets import DATASET_CHECKS
from mtl_bench.bench.check.engines import ENGINE_CHECKS
from mtl_bench.bench.check.methods import METHOD_CHECKS
from mtl_bench.bench.check.tasks import TASK_CHECKS
from mtl_bench.core import plugins
from mtl_bench.core.files import content

CHECKS: dict[str, Mapping[str, Callable[..., Any]]] = {
    "methods": METHOD_CHECKS,
    "backbones": BACKBONE_CHECKS,
    "tasks": TASK_CHECKS,
    "datasets": DATASET_CHECKS,
    "engines": ENGINE_CHECKS,
}


@dataclass(frozen=True)
class CheckResult:
    name: str
    ok: bool
    detail: str = ""


def check(kind: str, name: str) -> list[CheckResult]:
    """Run every check of a plug-in; a failed one says what was wrong, none stops the others.

    Args:
        kind: one of `plugins.KINDS`.
        name: the file's stem.
    """
    path = plugins.path_of(kind, name)
    results = [_run("documented", lambda: _documented(path))]
    load = _run("loads", lambda: plugins.load(kind, name))
    results.append(load)
    if load.ok:
        plugin = plugins.load(kind, name)
        results += [_run(title, partial(run, plugin)) for title, run in CHECKS[kind].items()]
    return results


def _run(name: str, call: Callable[[], Any]) -> CheckResult:
    """Every exception of the plug-in is a failed check with its place, which is the point here.

    A text that a check returns stands beside its name.
    """
    try:
        said = call()
    except (Exception, SystemExit) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        return CheckResult(name, False, f"{type(error).__name__}: {error} ({where})")
    return CheckResult(name, True, said if isinstance(said, str) else "")


def _documented(path: Path) -> None:
    text = ast.get_docstring(ast.parse(content(path))) or ""
    if len(text.splitlines()) < 2:
        raise ValueError("the file's docstring needs a line saying what it does, then its source")
