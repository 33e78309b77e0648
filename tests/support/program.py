"""The program as a person runs it, in a process of its own, and what it leaves."""

import json
import subprocess
import sys
from pathlib import Path

MINE = '''"""Log-sum: scale-invariant weighting of my own.

Source: this test.
"""
from mtl_bench.core.method import LossMethod


class Mine(LossMethod):
    def total(self, step):
        return step.loss_K.clamp_min(1e-8).log().sum()
'''
GRID = """
question = "Does everything run?"
recipe = "smoke"

[axes]
backbone = ["tiny"]
method = ["fixed", "mine"]

[report]
rows = "method"
"""


def mtl_bench(*arguments, cwd: Path, **options) -> subprocess.CompletedProcess:
    words = [sys.executable, "-m", "mtl_bench", *(str(a) for a in arguments)]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False, **options)


def user_folder(folder: Path) -> Path:
    """A user's folder: a grid file, and a plug-in in a folder of its own."""
    (folder / "plugins").mkdir()
    (folder / "plugins" / "mine.py").write_text(MINE)
    (folder / "grid.toml").write_text(GRID)
    return folder


def rows(runs: Path) -> dict[str, dict]:
    """What a row says about the cell, without clocks and without what stood around the run."""
    found = {}
    for path in sorted(runs.glob("*/row.json")):
        row = json.loads(path.read_text())
        kept = {k: v for k, v in row["metric"].items() if not k.startswith("latency.")}
        found[path.parent.name] = {"metric": kept, "cell": row["cell"], "code": row["code"]}
    return found
