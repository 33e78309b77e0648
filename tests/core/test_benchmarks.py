"""The benchmarks still find what they import: nobody runs them often."""

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
