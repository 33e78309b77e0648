"""A replayed row of a grid, from its parent in the cache to the report."""

from dataclasses import replace

import numpy as np
import pytest
from support.training import scales_cell, scales_root

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.grid import baseline_cell, load_grid
from mtl_bench.bench.launch import Here
from mtl_bench.core.config import Cell
from mtl_bench.core.files import read_json, write_json
from mtl_bench.train import curve


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    said = []
    root = scales_root()
    runs = tmp_path_factory.mktemp("runs")
    return Here(runs, root, "cpu", "off", said.append, Data(root)), said


def weights(here: Here, cell: Cell, prefix="weight.") -> np.ndarray:
    rows = curve.read(here.runs / cell.slug / "curve.csv")
    keys = [key for key in rows[0] if key.startswith(prefix)]
    return np.array([[float(row[key]) for key in keys] for row in rows], np.float32)


@pytest.mark.parametrize("method", ["uncertainty", "nash"])
def test_mean_weights_are_reproduced_to_the_float_and_the_parent_runs_once(method, here):
    place, said = here
    cell = scales_cell(method, replay="mean")
    (parent,) = cell.parents
    place.run(cell)
    assert f"{cell.label} needs {parent.label} first" in said
    rows = [read_json(place.runs / each.slug / "row.json") for each in (parent, cell)]
    assert rows[1]["cell"]["replay"] == "mean"
    assert "replay" not in rows[0]["cell"]
    written = (place.runs / parent.slug / "row.json").stat().st_mtime_ns

    modes = ("shuffled", "level") if method == "nash" else ("final",)
    for mode in modes:
        said.clear()
        place.run(replace(cell, replay=mode))
        assert not any("first" in line for line in said)
    assert (place.runs / parent.slug / "row.json").stat().st_mtime_ns == written

    for prefix in ("weight.", "head.") if method == "nash" else ("weight.",):
        own = weights(place, parent, prefix)
        assert len(np.unique(own)) > 3
        mean = own.mean(0, np.float64).astype(np.float32)
        assert (weights(place, cell, prefix) == mean).all()
        if "final" in modes:
            assert (weights(place, replace(cell, replay="final"), prefix) == own[-1]).all()
            continue
        level = own.mean(1, np.float64, keepdims=True).astype(np.float32)
        assert (weights(place, replace(cell, replay="level"), prefix) == level).all()
        shuffled = weights(place, replace(cell, replay="shuffled"), prefix)
        assert sorted(shuffled.tolist()) == sorted(own.tolist())
    # the same batches: all begin with the same losses
    first = [weights(place, each, "loss.")[0] for each in (parent, cell)]
    assert np.array_equal(*first)


def test_a_parent_that_lacks_its_log_or_is_stale_is_one_line(here):
    place, _ = here
    cell = scales_cell("fixed", replay="final")
    place.run(cell.parents[0])
    directory = place.runs / cell.parents[0].slug
    (directory / "curve.csv").rename(directory / "away")
    why = rf"needs .*{directory.name}, which is here without its curve.csv: run that one again"
    with pytest.raises(ValueError, match=why):
        place.run(cell)
    (directory / "away").rename(directory / "curve.csv")
    row = read_json(directory / "row.json")
    row["code"]["train"]["method"] = "another"
    write_json(directory / "row.json", row)
    with pytest.raises(ValueError, match="a cell that this one needs is stale") as error:
        place.run(cell)
    assert "\n" not in str(error.value)
    assert store.status(cell, place.runs) == "failed"


def test_rows_and_axes_of_a_grid_and_its_baseline(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'recipe = "scales"\n[axes]\nbackbone = ["mlp"]\nmethod = ["nash"]\n[[row]]\n'
        'name = "Nash"\n[[row]]\nname = "Nash, mean"\nreplay = "mean"\n'
        '[baseline]\nmethod = "fixed"\nsingle_task = true\n'
    )
    plain, mean = load_grid(str(path)).cells
    assert (plain.replay, mean.replay) == (None, "mean")
    assert mean.parents == (plain,)
    settings = {"method": "fixed", "single_task": True}
    assert baseline_cell(mean, settings) == baseline_cell(plain, settings)
    path.write_text(path.read_text().replace('"mean"', '"average"'))
    with pytest.raises(ValueError, match="'replay' must be mean or final or shuffled or level"):
        load_grid(str(path))


def test_the_shipped_controls():
    grid = load_grid("controls")
    grid.kind.check(grid.jobs)
    assert grid.report["control"] in grid.names.values()
    assert {cell.replay for cell in grid.cells} == {None, "mean", "shuffled", "level"}
    own = {cell.id for cell in grid.cells}
    assert all(parent.id in own for cell in grid.cells for parent in cell.parents)
