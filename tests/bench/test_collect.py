"""Results of several machines in one runs folder, and rows as one file."""

import errno
import json
import lzma
import os
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest
from support.launching import hold
from typer.testing import CliRunner

from mtl_bench.bench import collect, store
from mtl_bench.bench.jobs import CELLS, TIMINGS, Timing, load_cell
from mtl_bench.cli.app import app
from mtl_bench.core import files, provenance
from mtl_bench.core.config import Cell, Recipe, load_recipe
from mtl_bench.core.files import read_json, write_json
from mtl_bench.core.plain import to_dict
from mtl_bench.train import checkpoint

METHODS = ("fixed", "nash", "rlw")


def cell_of(method="fixed", seed=0) -> Cell:
    return Cell(Recipe(), "tiny", method, seed=seed)


def write(runs: Path, cell: Cell, pq=30.0, **changes) -> Path:
    """A run as it is left, with something in each file."""
    directory = store.run_dir(cell, runs)
    directory.mkdir(parents=True)
    write_json(directory / "cell.json", to_dict(cell))
    code = provenance.code(cell)
    row = {**CELLS.identity(cell), "status": "done", "metric": {"panoptic.pq": pq}, "code": code}
    write_json(directory / "row.json", {**row, "time": {"train_s": 60.0}, **changes})
    (directory / "curve.csv").write_text("step,step_ms\r\n1,2\r\n")
    (directory / "samples.npz").write_bytes(b"pictures")
    (directory / "last.pt").write_bytes(b"weights")
    write_json(directory / "code.json", code)
    return directory


def write_timing(runs: Path, **values) -> Path:
    timing = Timing("tiny", "plain", size="64x128", passes=3, **values)
    file = TIMINGS.row_file(timing, runs)
    file.parent.mkdir(parents=True, exist_ok=True)
    row = {**TIMINGS.identity(timing), "status": "done", "metric": {"latency.mean_ms": 3.0}}
    write_json(file, {**row, "code": TIMINGS.code(timing), "seconds": 1.0})
    return file


def run(*words, code=0) -> str:
    done = CliRunner().invoke(app, ["collect", *map(str, words)])
    assert done.exit_code == code, done.output
    return done.output


@pytest.fixture
def other(tmp_path) -> Path:
    """Another machine's runs: three cells and a timing that are done."""
    for method in METHODS:
        write(tmp_path / "other", cell_of(method))
    write_timing(tmp_path / "other")
    return tmp_path / "other"


def contents(runs: Path) -> dict[str, bytes]:
    found = (p for p in runs.rglob("*") if p.is_file())
    return {str(p.relative_to(runs)): p.read_bytes() for p in found}


# --- runs folders ---------------------------------------------------------------------------------


def test_rows_curves_and_timings_come_without_weights(other, tmp_path):
    runs = tmp_path / "runs"
    assert run(other, "--runs", runs) == f"collected 4 into {runs}\n"
    names = {"cell.json", "row.json", "curve.csv", "samples.npz"}
    for method in METHODS:
        mine, theirs = (store.run_dir(cell_of(method), place) for place in (runs, other))
        assert {path.name for path in mine.iterdir()} == names
        assert all((mine / n).read_bytes() == (theirs / n).read_bytes() for n in names)
        assert load_cell(mine / "cell.json") == cell_of(method)
        assert store.status(cell_of(method), runs) == "done"
    assert store.to_run([cell_of(method) for method in METHODS], runs) == []
    (timing,) = (runs / "latency").glob("*.json")
    assert timing.read_bytes() == (other / "latency" / timing.name).read_bytes()


def test_what_does_not_fit_is_left_out_with_its_reason(other, tmp_path):
    runs, code = tmp_path / "runs", deepcopy(provenance.code(cell_of()))
    code["evaluate"]["harness"] = "another"
    write(other, cell_of("fixed", 1), code=code)
    write(other, cell_of("fixed", 2), metric=[3])
    for seed, name, values in (
        (3, "failed.json", {"error": "NaN at step 7"}),
        (4, "code.json", {}),
    ):
        directory = other / cell_of("fixed", seed).slug
        directory.mkdir()
        write_json(directory / "cell.json", to_dict(cell_of("fixed", seed)))
        write_json(directory / name, values)
    (write(other, cell_of("fixed", 5)) / "curve.csv").write_text("step,x\r\n1,2\r\n3,4\r\n")
    write(runs, cell_of("nash"), pq=31.0)
    hold(runs / cell_of("rlw").slug, os.getpid())
    kept = contents(runs)
    lines = run(other, "--runs", runs).splitlines()
    assert lines[0] == f"collected 2 into {runs}"
    slug = {seed: cell_of("fixed", seed).slug for seed in range(6)}
    told = {line.split(":")[0]: line for line in lines[1:]}
    assert told.keys() == {
        *("left out, stale", "left out, unreadable", "left out, failed", "left out, unfinished"),
        *("left out, already here", "left out, running here"),
    }
    assert f"1 (evaluate: harness changed): {slug[1]}" in told["left out, stale"]
    assert f"1 (NaN at step 7): {slug[3]}" in told["left out, failed"]
    assert told["left out, unfinished"] == f"left out, unfinished: 1: {slug[4]}"
    assert told["left out, already here"] == f"left out, already here: 1: {cell_of('nash').slug}"
    for words in ("is damaged (its 'metric')", "curve.csv is damaged", slug[2], slug[5]):
        assert words in told["left out, unreadable"]
    assert kept.items() <= contents(runs).items()
    assert not any(slug[seed] in "".join(contents(runs)) for seed in range(1, 6))


@pytest.mark.parametrize("what", ["failed", "stale", "interrupted"])
def test_a_good_result_takes_the_place_of_what_is_none_and_nothing_trained_is_lost(
    what, other, tmp_path
):
    runs = tmp_path / "runs"
    mine = write(runs, cell_of(), pq=1.0, **({"code": {}} if what == "stale" else {}))
    if what != "stale":
        (mine / "row.json").unlink()
    if what == "failed":
        write_json(mine / "failed.json", {"error": "x"})
    assert store.status(cell_of(), runs) == what
    run(other, "--runs", runs)
    assert store.stored(cell_of(), runs).word == "done"
    assert read_json(mine / "row.json")["metric"] == {"panoptic.pq": 30.0}
    assert (mine / "set-aside-1" / "last.pt").read_bytes() == b"weights"
    assert not (mine / "last.pt").exists()


def test_weights_come_where_they_are_asked_for_also_later(other, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "require", lambda path, cell: None)
    runs = tmp_path / "runs"
    run(other, "--runs", runs)
    assert run(other, "--weights", "--runs", runs).startswith("collected 3 into")
    directory = store.run_dir(cell_of(), runs)
    assert (directory / "last.pt").read_bytes() == b"weights"
    assert (directory / "code.json").is_file()
    assert "already here: 4" in run(other, "--weights", "--runs", runs)
    (directory / "last.pt").unlink()
    row = read_json(directory / "row.json")  # of another training: its weights are not ours
    write_json(directory / "row.json", {**row, "metric": {"panoptic.pq": 31.0}})
    run(other, "--weights", "--runs", runs)
    assert not (directory / "last.pt").exists()


def test_a_stale_row_without_weights_is_not_trained_again_unasked(other, tmp_path):
    runs, cell = tmp_path / "runs", cell_of()
    run(other, "--runs", runs)
    row = read_json(runs / cell.slug / "row.json")
    row["code"]["evaluate"]["harness"] = "another"
    write_json(runs / cell.slug / "row.json", row)
    with pytest.raises(ValueError, match=r"evaluate: harness changed, and .*last.pt is not here"):
        store.can_renew(cell, runs)
    with pytest.raises(ValueError, match=r"no checkpoint .*last.pt; mtl-bench collect --weights"):
        checkpoint.read(runs / cell.slug / "last.pt")
    row["code"]["train"]["harness"] = "another"
    write_json(runs / cell.slug / "row.json", row)
    assert not store.can_renew(cell, runs)  # what there was would be of no use


def test_what_other_code_made_comes_where_it_is_asked_for_and_replaces_nothing(other, tmp_path):
    runs, pack, old = tmp_path / "runs", tmp_path / "rows.xz", deepcopy(provenance.code(cell_of()))
    old["train"]["harness"] = "another"
    for seed in (1, 2, 3):
        write(other, cell_of("fixed", seed), code=old)
    said = run("--pack", pack, "--runs", other, "--stale").splitlines()
    assert said[0].startswith(f"packed 7 of {other}")
    assert run("--pack", tmp_path / "less.xz", "--runs", other).startswith("packed 4 ")

    write(runs, cell_of("fixed", 1), pq=1.0)  # done
    write(runs, cell_of("fixed", 2), pq=2.0, code=old)  # as stale as the other
    kept = contents(runs)
    assert "left out, stale: 3 (train: harness changed)" in run(pack, "--runs", tmp_path / "none")
    said = run(pack, "--runs", runs, "--stale").splitlines()
    assert said[0] == f"collected 5 into {runs}"
    assert said[1].startswith("left out, already here: 2: ")
    assert kept.items() <= contents(runs).items()
    assert store.status(cell_of("fixed", 3), runs) == "stale"


def test_sources_that_are_none_are_one_line_before_anything_is_taken(other, tmp_path):
    runs, empty, foreign = tmp_path / "runs", tmp_path / "empty", tmp_path / "foreign.xz"
    empty.mkdir()
    foreign.write_bytes(b"PK")
    for source, why in (
        (empty, "no runs in"),
        (foreign, "is no pack of rows, or damaged"),
        (tmp_path / "gone", "no runs folder or pack"),
        (runs, "is --runs itself" if runs.exists() else "no runs folder or pack"),
    ):
        text = run(other, source, "--runs", runs, code=2)
        assert why in text
        assert text.count("\n") == 1
        assert not runs.exists()
    assert "is --runs itself" in run(other, "--runs", other, code=2)
    assert "nothing to collect" in run(code=2)
    assert "--curves goes with --pack" in run(other, "--curves", code=2)
    assert "--smoke goes with --pack FILE.xz --grid NAME" in run(other, "--smoke", code=2)
    assert "--seeds goes with --pack" in run("--pack", foreign, "--seeds", 3, code=2)
    assert "--weights does not go with --pack" in run("--weights", "--pack", foreign, code=2)


# --- packs ----------------------------------------------------------------------------------------


def test_a_pack_brings_back_the_same_rows(other, tmp_path):
    pack, runs = tmp_path / "rows.xz", tmp_path / "runs"
    text = run("--pack", pack, "--runs", other)
    assert text.startswith(f"packed 4 of {other} in {pack}, ")
    assert run(pack, "--runs", runs) == f"collected 4 into {runs}\n"
    for method in METHODS:
        mine, theirs = (store.run_dir(cell_of(method), place) for place in (runs, other))
        assert (mine / "row.json").read_bytes() == (theirs / "row.json").read_bytes()
        assert {path.name for path in mine.iterdir()} == {"cell.json", "row.json"}
        assert store.status(cell_of(method), runs) == "done"
    assert "already here: 4" in run(pack, "--runs", runs)

    run("--pack", tmp_path / "again.xz", "--runs", runs)
    assert (tmp_path / "again.xz").read_bytes() == pack.read_bytes()
    head, *lines = lzma.decompress(pack.read_bytes()).decode().splitlines()
    assert json.loads(head) == collect.FORMAT
    assert len(lines) == 4

    run("--pack", pack, "--curves", "--runs", other)
    run(pack, "--runs", runs)  # now with what was lacking
    curve = runs / cell_of().slug / "curve.csv"
    assert curve.read_bytes() == (other / cell_of().slug / "curve.csv").read_bytes()


def test_of_a_grid_only_its_jobs_are_packed(other, tmp_path):
    grid = tmp_path / "mine.toml"
    grid.write_text('[axes]\nbackbone = ["tiny"]\nmethod = ["fixed", "famo"]\n')
    small = replace(cell_of(), recipe=load_recipe("small"))
    write(other, small)
    lines = run("--pack", tmp_path / "rows.xz", "--grid", grid, "--runs", other).splitlines()
    assert lines[0].startswith("packed 1 of")
    missing = replace(small, method="famo").slug
    assert lines[1] == f"left out, missing: 1: {missing}"
    grid.write_text('[axes]\nbackbone = ["tiny"]\nmethod = ["famo"]\n')
    text = run("--pack", tmp_path / "none.xz", "--grid", grid, "--runs", other, code=2)
    assert "nothing to pack" in text
    assert not (tmp_path / "none.xz").exists()


def test_failures_travel_where_they_are_asked_for(other, tmp_path):
    """A tuned grid counts them: without them a pack would not tell which trials are left."""
    pack, runs, cell = tmp_path / "rows.xz", tmp_path / "runs", cell_of("fixed", 7)
    for seed, code in ((7, provenance.code(cell)), (8, {})):
        directory = store.run_dir(cell_of("fixed", seed), other)
        directory.mkdir()
        write_json(directory / "cell.json", to_dict(cell_of("fixed", seed)))
        write_json(directory / "code.json", code)
        write_json(directory / "failed.json", {"error": "NaN at step 7"})
    lines = run("--pack", pack, "--failures", "--runs", other).splitlines()
    assert lines[0].startswith("packed 5 of")
    assert lines[1].startswith("left out, stale: 1 (")
    run(pack, "--runs", runs)
    state = store.stored(cell, runs)
    assert (state.word, state.why) == ("failed", "NaN at step 7")
    assert "already here: 5 (tried here, too)" in run(pack, "--runs", runs)
    runs = tmp_path / "more"
    run(other, "--failures", "--runs", runs)
    assert store.status(cell, runs) == "failed"
    write(tmp_path / "third", cell)
    run(tmp_path / "third", "--runs", runs)
    assert store.status(cell, runs) == "done"
    assert "tried here, too" in run(pack, "--runs", runs)


@pytest.mark.parametrize("harm", ["cut", "flipped", "other words", "newer", "no lines"])
def test_a_damaged_or_foreign_pack_is_one_line_and_takes_nothing(harm, other, tmp_path):
    pack, runs = tmp_path / "rows.xz", tmp_path / "runs"
    run("--pack", pack, "--runs", other)
    whole = pack.read_bytes()
    middle = len(whole) // 2
    flipped = bytes([whole[middle] ^ 1])
    pack.write_bytes(
        {
            "cut": whole[:middle],
            "flipped": whole[:middle] + flipped + whole[middle + 1 :],
            "other words": lzma.compress(b"some text\n"),
            "newer": lzma.compress(json.dumps({**collect.FORMAT, "version": 2}).encode()),
            "no lines": lzma.compress(b""),
        }[harm]
    )
    text = run(pack, "--runs", runs, code=2)
    assert f"{pack} is no pack of rows, or damaged" in text
    assert text.count("\n") == 1
    assert not runs.exists()


def test_a_line_that_this_version_cannot_read_hurts_no_other(other, tmp_path):
    pack, runs = tmp_path / "rows.xz", tmp_path / "runs"
    run("--pack", pack, "--runs", other)
    lines = lzma.decompress(pack.read_bytes()).decode().splitlines()
    values = json.loads(lines[1])
    changes = ({"cell": {**values["cell"], "later": 1}}, {"row": 3}, {"cell": None})
    others = [{**values, **change} for change in (*changes, {"curve.csv": 3})]
    for more in map(json.dumps, [*others, 3, [values], None]):
        pack.write_bytes(lzma.compress("\n".join([*lines, more]).encode()))
        text = run(pack, "--runs", runs)
        assert "left out, unreadable: 1 (" in text
        assert f"line 6 of {pack}" in text


def test_a_full_disk_leaves_nothing_half_written(other, tmp_path, monkeypatch):
    pack, runs = tmp_path / "rows.xz", tmp_path / "runs"

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", full)
        assert "No space left" in run("--pack", pack, "--runs", other, code=2)
        assert "No space left" in run(other, "--runs", runs, code=2)
    assert not pack.exists()
    assert list(tmp_path.glob(".rows*")) == []
    assert {store.status(cell_of(method), runs) for method in METHODS} == {"missing"}
    assert run(other, "--runs", runs).startswith("collected 4")


def test_a_cell_with_weights_of_its_own_travels_by_their_hash(tmp_path):
    weights, pack = tmp_path / "mine.pth", tmp_path / "rows.xz"
    weights.write_bytes(b"some")
    cell = replace(cell_of(), pretrained=str(weights))
    write(tmp_path / "other", cell)
    run("--pack", pack, "--runs", tmp_path / "other")
    assert str(tmp_path) not in lzma.decompress(pack.read_bytes()).decode()
    run(pack, "--runs", tmp_path / "runs")
    assert store.status(cell, tmp_path / "runs") == "done"
