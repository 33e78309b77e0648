"""A small tuned grid, and rows as if its cells had run."""

from mtl_bench.bench import store
from mtl_bench.bench.jobs import CELLS
from mtl_bench.core import provenance
from mtl_bench.core.files import write_json
from mtl_bench.core.plain import to_dict
from mtl_bench.core.quality import quality

GRID = """question = "Which?"
recipe = "conflict"

[axes]
method = ["fixed", "scalarised", "cagrad"]
backbone = ["mlp"]
granularity = ["tasks"]
seed = [0, 1]

[baseline]
method = "fixed"
single_task = true

[report]
rows = "method"
control = "scalarised"

[tune]
trials = 3
seeds = [100]
"""


def grid_file(folder, text=GRID, name="mine.toml"):
    path = folder / name
    path.write_text(text)
    return str(path)


def finish(cell, runs, error=1.0):
    """Leave a row whose every metric is this far from perfect."""
    directory = store.run_dir(cell, runs)
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / "cell.json", to_dict(cell))
    metric = {c.key: error for c in quality() if c.task in cell.tasks}
    row = {"status": "done", "metric": metric, "time": {"train_s": 36.0, "step_ms": 1.0}}
    code = provenance.code(cell)
    write_json(directory / "row.json", {**CELLS.identity(cell), **row, "code": code})


def fail(cell, runs):
    directory = store.run_dir(cell, runs)
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / "cell.json", to_dict(cell))
    store.write_failure(directory, "ValueError: on purpose")
