"""Cells are spread over the GPUs that this process sees; none is needed for these tests."""

import itertools

import pytest
from launching import cells, fake

from mtl_bench.bench import launch
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.launch import gpu_pool
from mtl_bench.cli import grid
from mtl_bench.cli.display import Lines


@pytest.mark.parametrize(
    ("visible", "count", "names"),
    [
        (None, 3, ("0", "1", "2")),
        ("2,5", 2, ("2", "5")),
        ("GPU-8932, MIG-1b2c", 2, ("GPU-8932", "MIG-1b2c")),
        ("3,-1,2", 1, ("3",)),  # CUDA stops at the first that there is not
        ("", 0, ()),
        (None, 0, ()),
    ],
)
def test_the_pool_names_what_this_process_sees(visible, count, names):
    assert gpu_pool(visible, count) == names


def test_as_many_cells_as_gpus_are_the_default(monkeypatch):
    monkeypatch.setattr("mtl_bench.core.provenance.cores", lambda: 64)
    chosen = load_grid("backbones")
    assert len(chosen.jobs) == 4
    for gpus, jobs in ((("7",), 1), (("2", "5"), 2), (tuple("01234567"), 4), ((), 4)):
        assert grid._side_by_side(chosen, chosen.jobs, gpus) == jobs


def intervals(runs):
    """GPU -> [(start, end)] of its cells."""
    found, began = {}, {}
    for line in (runs / "history.txt").read_text().splitlines():
        word, slug, when, _, _, gpu = line.split()
        if word == "start":
            began[slug] = float(when)
        else:
            found.setdefault(gpu, []).append((began[slug], float(when)))
    return found


def run(runs, gpus, jobs, count):
    command = fake(runs, seconds=0.4)
    launch.Launcher(runs, command, Lines(quiet=True), jobs, gpus=gpus).run(cells(count))
    return intervals(runs)


def test_every_cell_has_a_gpu_of_its_own(tmp_path):
    found = run(tmp_path, ("2", "GPU-89"), jobs=2, count=5)
    assert set(found) == {"2", "GPU-89"}
    for cells_of_one in found.values():
        ordered = sorted(cells_of_one)
        for (_, end), (start, _) in itertools.pairwise(ordered):
            assert end <= start


def test_more_cells_than_gpus_are_spread_evenly(tmp_path):
    found = run(tmp_path, ("0", "1"), jobs=4, count=4)
    assert {gpu: len(cells_of_one) for gpu, cells_of_one in found.items()} == {"0": 2, "1": 2}


def test_without_a_pool_the_environment_stays(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4")
    assert launch.child_environment(2)["CUDA_VISIBLE_DEVICES"] == "4"
    assert launch.child_environment(2, "1")["CUDA_VISIBLE_DEVICES"] == "1"
