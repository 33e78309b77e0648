"""Cells whose processes only behave as told, and what these note down."""

import json
import sys
from pathlib import Path

from mtl_bench.bench import store
from mtl_bench.core import locks, provenance
from mtl_bench.core.config import Cell, Recipe

FAKE = Path(__file__).with_name("fake_cell.py")


def cells(count):
    return [Cell(Recipe(), "tiny", "fixed", seed=seed) for seed in range(count)]


def fake(runs, action="ok", seconds=0.0, actions=None):
    """A command that behaves as told, for some seeds (or cells, by id) otherwise."""
    actions = actions or {}

    def command(cell):
        code = json.dumps(provenance.code(cell))
        chosen = actions.get(cell.id, actions.get(cell.seed, action))
        file = store.run_dir(cell, runs) / "cell.json"
        return [sys.executable, str(FAKE), chosen, str(seconds), code, str(file)]

    return command


def history(runs):
    """[(word, slug, time, threads)]"""
    lines = (runs / "history.txt").read_text().splitlines()
    fields = [line.split() for line in lines]
    return [(f[0], f[1], float(f[2]), f[3]) for f in fields]


def hold(directory, pid):
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "claim").write_text(json.dumps(locks.process(pid)))
