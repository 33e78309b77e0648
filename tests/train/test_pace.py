"""A busy machine is told of, and shared fairly."""

import os
import re

import pytest

from mtl_bench.bench.grid import load_grid
from mtl_bench.cli import app, grid
from mtl_bench.cli.options import Device
from mtl_bench.train import progress
from mtl_bench.train.progress import WINDOW, Pace


def notes(pace: Pace, steps: list[tuple[float, float]]) -> list[str]:
    return [line for step in steps if (line := pace.note(*step))]


def test_a_steady_pace_says_nothing():
    assert notes(Pace(), [(100.0 + n % 7, 5.0) for n in range(200)]) == []


def test_one_long_step_is_no_slow_pace():
    assert notes(Pace(), [(100.0 if n % 10 else 900.0, 5.0) for n in range(200)]) == []


@pytest.mark.parametrize(
    ("data_ms", "load", "why"),
    [
        (200.0, 0.3, "80 % of it waits for data: raise recipe.data.workers"),
        (5.0, 4.7, r"other work shares the cores \(load 4.7 on 2\)"),
        (5.0, 1.0, "the processor may have been slowed down"),
    ],
)
def test_slow_steps_are_told_once_with_their_cause(data_ms, load, why, monkeypatch):
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0, 0))
    monkeypatch.setattr(progress, "cores", lambda: 2)
    first = [(100.0, 5.0)] * (WINDOW + 30)
    found = notes(Pace(), first + [(250.0, data_ms)] * 60)
    (line,) = found
    assert re.fullmatch(f"steps take 2.5 times as long as the first ones: {why}", line)


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (2, 2), (64, 4)])
def test_a_cell_a_core_is_the_default_on_the_cpu(cores, expected, monkeypatch):
    monkeypatch.setattr("mtl_bench.core.provenance.cores", lambda: cores)
    cells = load_grid("backbones")
    assert len(cells.jobs) == 4
    assert grid._side_by_side(cells, cells.jobs, grid._gpus(cells, Device.cpu)) == expected


def test_a_grid_of_timings_runs_alone():
    timings = load_grid("latency", smoke=True)
    assert grid._side_by_side(timings, timings.jobs, ()) == 1


def test_threads_do_not_spin_long_unless_the_user_says_so(monkeypatch):
    monkeypatch.setattr(app, "app", lambda **options: None)
    monkeypatch.setenv("KMP_BLOCKTIME", "200")
    monkeypatch.setenv("GOMP_SPINCOUNT", "")  # so that it is as before after the test
    monkeypatch.delenv("GOMP_SPINCOUNT")
    with pytest.raises(SystemExit):
        app.main()
    assert os.environ["GOMP_SPINCOUNT"] == "1000"
    assert os.environ["KMP_BLOCKTIME"] == "200"
