"""wandb: off imports nothing, offline writes a run, anything else is refused."""

import subprocess
import sys

import pytest

from mtl_bench.train.tracking import Tracker


def test_off_does_not_import_wandb():
    code = (
        "import sys; from mtl_bench.train.tracking import Tracker; "
        "t = Tracker('off', None, None); t.log({'x': 1.0}, 1); t.finish(); "
        "assert 'wandb' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_unknown_mode(smoke_cell, tmp_path):
    with pytest.raises(ValueError, match=r"no wandb mode 'offlin' \(known: off, offline, online\)"):
        Tracker("offlin", smoke_cell, tmp_path)


def test_offline_run_carries_the_cells_id(smoke_cell, tmp_path):
    tracker = Tracker("offline", smoke_cell, tmp_path)
    tracker.log({"total": 1.0}, 1)
    tracker.finish()
    (run,) = (tmp_path / "wandb").glob(f"offline-run-*-{smoke_cell.id}")
    assert (run / f"run-{smoke_cell.id}.wandb").stat().st_size > 0
