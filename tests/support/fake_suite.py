"""Rows of a suite: some problems, many lines, several seeds, made up."""

from types import SimpleNamespace

import numpy as np
from fake_rows import make_row

from mtl_bench.bench.jobs import CELLS
from mtl_bench.bench.tuning import Trial, Tried
from mtl_bench.core import config
from mtl_bench.report.delta import with_delta

PROBLEMS = {  # recipe -> keys of its metrics, and whether less is better
    "scales": {f"regress.y{i}.unexplained": True for i in range(3)},
    "digits": {"classify.left.accuracy": False, "reconstruct.right_picture.unexplained": True},
    "dense": {
        "segmentation.miou": False,
        "segmentation.pixel_acc": False,
        "depth_supervised.abs_err": True,
        "depth_supervised.rel_err": True,
    },
}
CONTROL = "scalarised"


def suite_grid(**report):
    return SimpleNamespace(
        name="leaderboard",
        question="Which method is better?",
        recipe=", ".join(PROBLEMS),
        report={"rows": "method", "control": CONTROL, **report},
        cells=(),
        skips=(),
    )


def suite_rows(lines, seeds=5, problems=PROBLEMS, noise=0.4):
    """Line -> its points of gain over the control, the same in every problem and task, and noise.

    The control is among the rows, and the single-task baseline of every problem and seed.
    """
    rng = np.random.default_rng(3)
    lines = {"baseline": -2.0, CONTROL: 0.0, **lines}
    rows = []
    for recipe, metrics in problems.items():
        for seed in range(seeds):
            common = {key: rng.normal(0, 3) for key in metrics}
            for name, shift in lines.items():
                row = _row(recipe, name, seed)
                for key, less in metrics.items():
                    points = common[key] + shift + rng.normal(0, noise)
                    row["metric"][key] = 0.5 * float(np.exp((-1 if less else 1) * points / 100))
                row["time"] = {"train_s": 9.0, "step_ms": 4.0 + 2 * (shift > 0)}
                rows.append(row)
    baseline = {
        (row["cell"]["recipe"]["name"], row["seed"]): row
        for row in rows
        if row["method"] == "baseline"
    }
    return with_delta(rows, lambda row: baseline[row["cell"]["recipe"]["name"], row["seed"]])


def suite_trials(lines, trials=6, problems=PROBLEMS, failed=()):
    """Line -> its best points of gain; trials of the control trade its tasks.

    Args:
        failed: (line, number) of trials that failed on every problem.
    """
    rng = np.random.default_rng(4)
    found = []
    for recipe, metrics in problems.items():
        tasks = list(dict.fromkeys(key.split(".")[0] for key in metrics))
        tasks = tasks if len(tasks) > 1 else [key.rpartition(".")[0] for key in metrics]
        for line, shift in {CONTROL: 0.0, **lines}.items():
            for number in range(trials):
                trade = rng.normal(0, 4 if line == CONTROL else 1, len(tasks))
                scores = shift + trade - trade.mean() - rng.exponential(3)
                cell = config.Cell(config.Recipe(name=recipe), f"net_{recipe}", line, seed=100)
                values = {"recipe.optim.lr": 0.1 / (number + 1)} if number else {}
                trial = Trial(line, recipe, number, cell, values)
                bad = (line, number) in failed
                of = {} if bad else dict(zip(tasks, map(float, scores), strict=True))
                score = -np.inf if bad else float(np.mean(scores))
                found.append(Tried(trial, score, of, 0.0 if bad else 10.0 + 5 * (shift > 0)))
    return found


def fail(row):
    """The row, in place, as that of a run that failed."""
    row.update(status="failed", error="ValueError: loss is nan", metric={})


def _row(recipe, method, seed):
    row = make_row(f"net_{recipe}", seed, method=method)
    cell = config.Cell(config.Recipe(name=recipe), f"net_{recipe}", method, seed=seed)
    row |= {"metric": {}, **CELLS.identity(cell), "slug": f"{recipe}-{method}-s{seed}"}
    return row
