"""Fingerprints see what code does, and neither where it stands nor how it is worded."""

import ast
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from textwrap import dedent

import pytest

from mtl_bench.bench import jobs
from mtl_bench.core import fingerprint, plugins, provenance
from mtl_bench.core.config import Cell, Recipe
from mtl_bench.core.fingerprint import Root

PACKAGE = fingerprint.PACKAGE


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A package of a few lines in place of the real one, and its fingerprint of `train`."""
    package = tmp_path / "mtl_bench"
    monkeypatch.setattr(fingerprint, "PACKAGE", package)
    monkeypatch.setattr(fingerprint, "EXCLUDED", {"config"})
    fingerprint.excluded.cache_clear()
    fingerprint._module_file.cache_clear()
    files = {
        "__init__.py": "",
        "train.py": """
            \"\"\"Trains.\"\"\"
            import numpy as np
            from mtl_bench import config, losses
            from mtl_bench.parts.layers import Layer

            RATE = 0.1
            UNUSED = 1

            def train(steps: int) -> None:
                \"\"\"Does it.\"\"\"
                from mtl_bench.tail import end

                layer = Layer()  # a comment
                for step in range(steps):
                    losses.total(layer, np.ones(step), RATE, config.get())
                return end(layer)
            """,
        "losses.py": """
            def total(layer, values, rate, settings):
                return helper(values) * rate

            def helper(values):
                return values.sum()

            def other(values):
                return 0
            """,
        "tail.py": "def end(layer):\n    return layer.out\n",
        "config.py": "def get():\n    return 1\n",
        "parts/__init__.py": "from mtl_bench.parts.layers import Layer\n",
        "parts/layers.py": """
            class Base:
                size: int = 3

            class Layer(Base):
                \"\"\"A layer.\"\"\"

                def run(self):
                    return self.size
            """,
    }
    monkeypatch.chdir(tmp_path)

    def write(name, text):
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(dedent(text))
        fingerprint._modules.clear()  # as edits may come within a tick of the clock
        fingerprint._known.clear()
        fingerprint._module_file.cache_clear()

    def replace(name, old, new):
        text = (package / name).read_text()
        assert old in text
        write(name, text.replace(old, new))

    def taken(*roots):
        given = roots or [Root(package / "train.py", ("train",))]
        return fingerprint.fingerprints("train", given)

    for name, text in files.items():
        write(name, text)
    taken.write, taken.replace, taken.package = write, replace, package
    yield taken
    fingerprint.excluded.cache_clear()
    fingerprint._module_file.cache_clear()
    fingerprint._modules.clear()
    fingerprint._known.clear()


WORDING = {
    "docstring": ("train.py", '"""Does it."""', '"""Does it well.\n\n    At length.\n    """'),
    "comment": ("train.py", "  # a comment", "  # another"),
    "no docstring": ("parts/layers.py", '"""A layer."""', ""),
    "annotation": ("train.py", "steps: int", "steps"),
    "annotated value": ("train.py", "RATE = 0.1", "RATE: float = 0.1"),
    "layout": (
        "train.py",
        "losses.total(layer, ",
        "losses.total(\n            layer,\n            ",
    ),
    "unused value": ("train.py", "UNUSED = 1", "UNUSED = 2"),
    "unused function": ("losses.py", "return 0", "return 1"),
    "excluded module": ("config.py", "return 1", "return 2"),
}


@pytest.mark.parametrize("edit", WORDING.values(), ids=WORDING)
def test_wording_and_what_is_not_used_leave_a_fingerprint_alone(tree, edit):
    before = tree()
    tree.replace(*edit)
    assert tree() == before


CHANGES = {
    "the root": ("train.py", "range(steps)", "range(steps + 1)"),
    "a constant": ("train.py", "RATE = 0.1", "RATE = 0.2"),
    "a function of another module": ("losses.py", "* rate", "/ rate"),
    "one that that uses": ("losses.py", "values.sum()", "values.max()"),
    "one imported in a function": ("tail.py", "layer.out", "layer.tail"),
    "a base class": ("parts/layers.py", "size: int = 3", "size: int = 4"),
    "a field's type": ("parts/layers.py", "size: int", "size: float"),
    "another library": ("train.py", "import numpy as np", "import torch as np"),
    "what runs on import": ("losses.py", "def total", "print('seen')\n\ndef total"),
}


@pytest.mark.parametrize("edit", CHANGES.values(), ids=CHANGES)
def test_what_the_code_does_is_seen(tree, edit):
    before = tree()
    tree.replace(*edit)
    assert tree() != before


def test_a_definition_may_move_and_be_imported_in_another_way(tree):
    before = tree()
    text = (tree.package / "losses.py").read_text()
    tree.write(
        "losses.py", "from mtl_bench.sums import helper as add\n" + text.split("def helper")[0]
    )
    tree.replace("losses.py", "helper(values)", "add(values)")
    tree.write("sums.py", "def helper" + text.split("def helper")[1])
    assert tree() == before  # moved
    tree.replace("train.py", "from mtl_bench.parts.layers import", "from mtl_bench.parts import")
    tree.replace("train.py", "from mtl_bench import config, losses", "import mtl_bench.losses")
    tree.replace("train.py", "losses.total", "mtl_bench.losses.total")
    tree.replace("train.py", "config.get()", "get()")
    tree.replace("train.py", "import numpy as np", "import numpy\nfrom .config import get")
    tree.replace("train.py", "np.ones", "numpy.ones")
    assert tree() == before  # imported in another way
    (tree.package / "losses.py").rename(tree.package / "parts" / "losses.py")
    tree.replace("train.py", "mtl_bench.losses", "mtl_bench.parts.losses")
    assert tree() == before  # the module moved


def test_definitions_may_be_reordered(tree):
    before = tree()
    total, helper, other = (tree.package / "losses.py").read_text().split("\n\n")
    tree.write("losses.py", "\n\n".join([other, helper, total]))
    assert tree() == before


def test_namesakes_cannot_be_exchanged_unseen(tree):
    tree.write("one.py", "def get():\n    return 1\n")
    tree.write("two.py", "def get():\n    return 2\n")
    text = (
        "from mtl_bench.{} import get\n"
        "from mtl_bench.{} import get as second\n"
        "def end(layer):\n    return first() - second()\n"
        "def first():\n    return get()\n"
    )
    tree.write("tail.py", text.format("one", "two"))
    before = tree()
    tree.write("tail.py", text.format("two", "one"))
    assert tree() != before


def test_local_names_are_not_taken_for_definitions(tree):
    tree.write("tail.py", "def end(layer):\n    x = [helper for helper in layer]\n    return x\n")
    before = tree()
    tree.replace("tail.py", "def end", "def helper():\n    return 5\n\ndef end")
    assert tree() == before


def test_a_plug_in_is_its_class_and_the_helpers_that_it_uses(tree, tmp_path):
    folder = tmp_path / "methods"
    folder.mkdir()
    tree.write("method.py", "class Method:\n    pass\n")
    (folder / "_more.py").write_text("def one():\n    return 1\n\ndef two():\n    return 2\n")
    (folder / "mine.py").write_text(
        "from mtl_bench import method\nfrom . import _more\n\n"
        "class Mine(method.Method):\n    def go(self):\n        return _more.one()\n"
    )
    root = Root(folder / "mine.py", part="method", base="Method")
    before = tree(root)
    assert set(before) == {"method", "harness"}

    def edited(name, old, new):
        text = (folder / name).read_text()
        (folder / name).write_text(text.replace(old, new))
        fingerprint._modules.clear()
        fingerprint._known.clear()
        found = tree(root)
        (folder / name).write_text(text)
        return {part for part in found if found[part] != before[part]}

    assert edited("_more.py", "return 1", "return 3") == {"method"}
    assert edited("_more.py", "return 2", "return 3") == set()
    assert edited("mine.py", "from . import _more", "from ._more import one") == {
        "method"
    }  # _more.
    tree.replace("method.py", "pass", "x = 1")
    assert edited("mine.py", "from . import", "from . import") == {"harness"}


def test_a_helper_imported_by_name_is_the_same_as_through_its_module(tree, tmp_path):
    folder = tmp_path / "methods"
    folder.mkdir()
    (folder / "_more.py").write_text("def one():\n    return 1\n")
    root = Root(folder / "mine.py", part="method")
    prints = []
    for text in (
        "from . import _more\nclass Mine:\n    x = _more.one()\n",
        "from ._more import one\nclass Mine:\n    x = one()\n",
        "from ._more import one as first\nclass Mine:\n    x = first()\n",
    ):
        (folder / "mine.py").write_text(text)
        fingerprint._modules.clear()
        fingerprint._known.clear()
        prints.append(tree(root))
    assert prints[0] == prints[1] == prints[2]


def test_a_file_that_is_no_python_is_named(tree, tmp_path):
    (tmp_path / "bad.py").write_text("class Mine(")
    with pytest.raises(ValueError, match=r"bad.py, line 1: SyntaxError"):
        tree(Root(tmp_path / "bad.py"))
    with pytest.raises(ValueError, match=r"train.py defines no 'trane'"):
        tree(Root(tree.package / "train.py", ("trane",)))


# --- members by stage -----------------------------------------------------------------------------

TASK = """
from mtl_bench.task import Task, score

def weigh(x):
    return x

class Mine(Task):
    def head(self):
        return 1

    def losses(self, maps):
        return self._part(maps)

    def metric(self):
        return self._tally(score())

    def _part(self, maps):
        return weigh(maps)

    def _tally(self, x):
        return x
"""


@pytest.fixture
def task(tree, tmp_path):
    tree.write(
        "task.py",
        """
        from typing import ClassVar

        def score():
            return 1

        class Task:
            stage_members: ClassVar[dict[str, tuple[str, ...]]] = {
                "train": ("losses",),
                "evaluate": ("metric",),
            }
        """,
    )
    path = tmp_path / "tasks" / "mine.py"
    path.parent.mkdir()

    def changed(old, new):
        """The stages that an edit is seen in."""
        found = []
        for text in (TASK, TASK.replace(old, new)):
            path.write_text(text)
            fingerprint._modules.clear()
            fingerprint._known.clear()
            root = Root(path, base="Task")
            found.append({s: fingerprint.fingerprints(s, [root]) for s in fingerprint.STAGES})
        assert TASK.replace(old, new) != TASK or old == new
        return {stage for stage in found[0] if found[0][stage] != found[1][stage]}

    changed.tree = tree
    return changed


def test_members_count_for_their_stage_only(task):
    assert task("return 1", "return 2") == {"train", "evaluate", "time"}  # the head is everyone's
    assert task("self._part(maps)", "self._part(-maps)") == {"train"}
    assert task("self._tally(score())", "self._tally(-score())") == {"evaluate"}


def test_helpers_of_members_count_with_those(task):
    assert task("return weigh(maps)", "return 2 * weigh(maps)") == {"train"}
    assert task("    return x\n\nclass", "    return 2 * x\n\nclass") == {"train"}
    assert task("        return x\n", "        return 2 * x\n") == {"evaluate"}


# --- the package itself ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reached():
    """Files that any stage of a cell reaches."""
    roots = provenance.roots(Cell(Recipe(), "tiny", "pcgrad", video=True))
    return {stage: fingerprint.reach(stage, found) for stage, found in roots.items()}


def names(reached, file):
    return {name for path, name in reached if path == fingerprint.of_package(file)}


def test_each_stage_has_what_it_runs(reached):
    assert {"Compute", "initial_weights", "seed_for"} <= names(reached["train"], "core.device")
    assert "photometric_loss" in names(reached["train"], "tasks.depth.losses")
    assert "label" in names(reached["label"], "tasks.panoptic.pseudo_labels")
    assert "PanopticQuality" in names(reached["evaluate"], "tasks.panoptic.metrics")
    assert not names(reached["evaluate"], "tasks.depth.losses")
    assert "time_cell" in names(reached["time"], "bench.stored")
    assert "measure" in names(reached["time"], "deploy.timer")
    assert not names(reached["time"], "tasks.panoptic.metrics")
    for stage in fingerprint.STAGES:
        assert "Network" in names(reached[stage], "model.network")
        assert "CITYSCAPES20" in names(reached[stage], "data.labels")


PROBE = """
import sys
from mtl_bench.bench import run, stored
print("\\n".join(m.__file__ for n, m in sys.modules.items() if n.startswith("mtl_bench")))
"""
# They start a cell, and what they do to its numbers is in the functions that the stages begin with.
STARTS = {"run", "__init__", "export_predictions"}


def test_all_that_a_cell_imports_is_covered_or_makes_no_numbers(reached):
    """By a stage of a cell, or by the timing of an engine."""
    done = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, check=True, env=os.environ
    )
    timings = [jobs.roots(jobs.Timing("tiny", name)) for name in plugins.files("engines")]
    timed = [fingerprint.reach("time", roots) for roots in timings]
    covered = {path for found in [*reached.values(), *timed] for path, _ in found}
    left = {
        path.relative_to(PACKAGE).as_posix()
        for path in map(Path, done.stdout.split())
        if path not in covered
        and not fingerprint.excluded(path)
        and path.stem not in STARTS
        and any(isinstance(n, ast.FunctionDef) for n in ast.walk(ast.parse(path.read_text())))
    }
    assert left == set()


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of the package that can be edited; says which stages of a cell an edit is seen in."""
    package = tmp_path / "mtl_bench"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("methods", "backbones"):
        shutil.copytree(PACKAGE.parent / folder, tmp_path / folder)

    def moved(path):
        return package / path.relative_to(PACKAGE)

    monkeypatch.setattr(fingerprint, "PACKAGE", package)
    monkeypatch.setattr(plugins, "PACKAGE", package)
    shipped = {kind: moved(folder) for kind, folder in plugins.SHIPPED.items()}
    monkeypatch.setattr(plugins, "SHIPPED", shipped)
    begins = {
        stage: [replace(root, path=moved(root.path)) for root in found]
        for stage, found in provenance.HARNESS_ROOTS.items()
    }
    monkeypatch.setattr(provenance, "HARNESS_ROOTS", begins)
    monkeypatch.chdir(tmp_path)
    fingerprint.excluded.cache_clear()
    fingerprint._module_file.cache_clear()
    cell = Cell(Recipe(), "tiny", "pcgrad")
    before = provenance.code(cell)

    def seen(name, old, new):
        path = tmp_path / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
        changed = provenance.changes(before, provenance.code(cell), {p: p for p in PARTS})
        path.write_text(text)
        return changed

    seen.package = package
    yield seen
    fingerprint.excluded.cache_clear()
    fingerprint._module_file.cache_clear()


PARTS = ("method", "backbone", "harness")


def test_edits_are_seen_by_the_stages_that_they_concern(copied):
    harness, method = "harness changed", "method changed"
    assert copied("mtl_bench/train/loop.py", "to be read from top to bottom", "reworded") == {}
    assert copied("methods/pcgrad.py", '"""', '"""Reworded. ') == {}
    file = "mtl_bench/tasks/depth/losses.py"
    loss = (file, "def smoothness_loss(", "X = 1\ndef smoothness_loss(")
    assert copied(*loss) == {}  # nobody uses it
    assert copied("methods/pcgrad.py", "class PCGrad", "class PCGrad2") == {"train": method}
    assert copied("methods/_solvers.py", "def finite(", "def finite(more=1, *") == {"train": method}
    where = "mtl_bench/tasks/panoptic/losses.py"
    assert copied(where, "def semantic_loss(", "@staticmethod\ndef semantic_loss(") == {
        "train": harness
    }
    where = "mtl_bench/tasks/panoptic/metrics.py"
    assert copied(where, "class SemanticIoU", "@staticmethod\nclass SemanticIoU") == {
        "evaluate": harness
    }
    assert set(copied("backbones/tiny.py", "class Tiny", "@staticmethod\nclass Tiny").values()) == {
        "backbone changed"
    }
    assert copied("mtl_bench/core/device.py", "self.scaler.update()", "pass") == {"train": harness}


def test_what_a_table_says_and_a_further_task_are_no_stages_matter(copied):
    depth = "mtl_bench/tasks/depth/__init__.py"
    assert copied(depth, '"AbsRel", -1, 3', '"Abs Rel", -1, 4') == {}
    assert (
        copied(
            depth, "    columns = (\n", "    columns = (\n        Column('x', 'x', 'x', 1, 1),\n"
        )
        == {}
    )
    with_third = copied.package / "tasks" / "third.py"
    with_third.write_text("from mtl_bench.core.task import Task\n\nclass Third(Task):\n    pass\n")
    assert copied("mtl_bench/train/loop.py", "to be read from top to bottom", "reworded") == {}
