"""The benchmarks still find what they import and the recipe they time: nobody runs them often."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
IMPORTED = {"steps.py"}  # by methods_cost.py


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.name)
def test_a_benchmark_says_how_it_is_used(path):
    words = ["-c", "import steps"] if path.name in IMPORTED else [path.name, "--help"]
    done = subprocess.run(
        [sys.executable, *words], cwd=FOLDER, env=os.environ, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert path.name in IMPORTED or "usage:" in done.stdout


def test_steps_are_those_of_the_default_recipe():
    found = "b = steps.open_bench('tasks', torch.device('cpu')); steps.our_step(b, 'pcgrad')()"
    done = subprocess.run(
        [sys.executable, "-c", f"import torch, steps; {found}; print(b.cell.recipe.name)"],
        cwd=FOLDER,
        env=os.environ,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "small\n", done.stderr
