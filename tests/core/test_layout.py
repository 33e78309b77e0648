"""The house stays in order: twelve rooms, one direction of imports, names at home, a quick CLI."""

import ast
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from mtl_bench.core import plugins

PACKAGE = plugins.PACKAGE
MODULES = sorted(PACKAGE.rglob("*.py"))
LINES = 600  # beyond that a file is hardly one idea

# A module imports only from rooms before its own (or from its own).
ROOMS = (
    *("core", "data", "model", "tasks", "train", "evaluate", "deploy", "bench", "show", "report"),
    *("cli", "__main__"),
)
# Rooms and files where the names of tasks, data sets, methods and backbones are at home
HOMES = ("tasks/", "data/", "bench/recipes/", "bench/grids/", "report/literature/")
AT_HOME = {
    "core/recipe.py",  # its defaults are the recipe `paper`
    "cli/data.py",  # the command `data synthetic`
}
# The checks of plug-ins run on a small backbone; every label set numbers as Cityscapes does; a run
# of predictions records under this key what its lengths are in.
NAMED = {
    ("bench/check/tasks.py", "tiny"),
    ("core/labels.py", "Cityscapes"),
    ("show/predict/job.py", "depth"),
}
# Plug-ins whose names are also common words are found by whole literals alone
WORDS = ("panoptic", "cityscapes", "kitti", "synthetic")


def relative(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "mtl_bench":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mtl_bench."):
            found.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            names = (alias.name.split(".") for alias in node.names)
            found |= {name[1] for name in names if name[0] == "mtl_bench" and len(name) > 1}
    return found - {"__version__"}


def test_the_package_has_few_rooms():
    entries = [path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"]
    assert len(entries) <= 14, sorted(entries)


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_module(path):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    assert len(text.splitlines()) <= LINES
    assert text.isascii()
    if text:
        assert ast.get_docstring(tree) or path.stem == "__init__", "says not what it is for"
    if path.parent != PACKAGE or path.stem != "__init__":
        known = ROOMS[: ROOMS.index(room(path)) + 1]
        assert imported_rooms(tree) <= set(known), "imports against the flow"


def words_of(tree: ast.AST) -> set[str]:
    """Identifiers, imported modules and literals of a module; sentences are no names."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {node.value} if " " not in node.value else set()
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_names_of_plug_ins_stay_at_home(path):
    if relative(path).startswith(HOMES) or relative(path) in AT_HOME:
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    kinds = ("methods", "backbones", "tasks", "datasets")
    names = {name for kind in kinds for name in plugins.files(kind)}
    assert len(names) >= 40
    literals = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
    found = {name for name in names if name in literals}
    found |= {word for word in words_of(tree) if any(name in word.lower() for name in WORDS)}
    assert {(relative(path), name) for name in found} <= NAMED


def test_every_grid_and_recipe_ships_with_a_purpose():
    for folder, key in (("grids", "question"), ("recipes", "about")):
        paths = list((PACKAGE / "bench" / folder).glob("*.toml"))
        assert paths
        for path in paths:
            assert f"{key} = " in path.read_text()


# --- a quick command line -------------------------------------------------------------------------

PROBE = """
import sys
from mtl_bench.cli.app import app
try:
    app(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
heavy = {"torch", "timm", "torchvision", "pandas", "matplotlib", "wandb", "cv2", "scipy"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


@pytest.mark.parametrize(
    "words",
    [
        "--help",
        "list",
        "list -v",
        "status --grid backbones",
        "ablate --grid backbones --dry-run",
        "ablate --help",
        "env --help",
        "report --help",
        "train --help",
        "predict --help",
        "figure cloud --help",
        "latency --help",
        "export --help",
        "data synthetic --help",
        "data cache --help",
        "new method quick",
    ],
)
def test_nothing_heavy_is_imported(words, tmp_path):
    subprocess.run([sys.executable, "-c", PROBE, *words.split()], check=True, cwd=tmp_path)


def processor_s(*words):
    """Of the best of seven runs: the machine may be busy."""
    taken = []
    for _ in range(7):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True, env=os.environ)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(taken)


def test_help_takes_little_more_than_the_library_that_parses_it():
    """2.6 times as much on an idle machine; drawn by rich it was twice that."""
    library = processor_s("-c", "import typer")
    assert processor_s("-m", "mtl_bench", "--help") < 3.5 * library


def test_help_waits_for_no_library_of_pictures():
    probe = PROBE.replace('"torch"', '"rich", "torch"')
    subprocess.run([sys.executable, "-c", probe, "--help"], check=True, capture_output=True)


def test_help_stands_in_the_panels_that_are_named():
    words = [sys.executable, "-m", "mtl_bench", "train", "--help"]
    text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert "Usage: mtl-bench train [OPTIONS] [CELL.JSON]\n" in text
    options, _, panel = text.partition("\nWhere and how to run:\n")
    assert "  --backbone NAME" in options
    assert "  --device" in panel


@pytest.mark.parametrize(
    "words",
    [
        "",
        "ablate",
        "train",
        "evaluate",
        "predict",
        "latency",
        "export",
        "status",
        "report",
        "list",
        "new",
        "check",
        "env",
        "data",
        "data synthetic",
        "data check",
        "data cache",
    ],
)
def test_every_command_has_help_with_an_example(words):
    command = [sys.executable, "-m", "mtl_bench", *words.split(), "--help"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert f"Example: mtl-bench {words}".rstrip() in " ".join(text.split())
