import json
import os
import subprocess
import sys
import time

import pytest

from mtl_bench.bench import store
from mtl_bench.bench.jobs import load_cell
from mtl_bench.core import locks, plugins, provenance
from mtl_bench.core.config import Cell, Recipe
from mtl_bench.core.files import read_json, write_json

METHOD = "from mtl_bench.core.method import LossMethod\n\n\nclass Mine(LossMethod): ...\n"
CHANGED = METHOD.replace("...", "x = 1")


@pytest.fixture
def cell(tmp_path, monkeypatch):
    """A cell whose method can be edited."""
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "mine.py").write_text(METHOD)
    return Cell(Recipe(), "tiny", "mine")


@pytest.fixture
def directory(cell, tmp_path):
    path = store.run_dir(cell, tmp_path / "runs")
    path.mkdir(parents=True)
    return path


def write_row(directory, cell):
    write_json(
        directory / "row.json", {"metric": {"panoptic.pq": 0.5}, "code": provenance.code(cell)}
    )


def test_write_json_leaves_the_old_file_or_the_new_one(tmp_path):
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert read_json(path) == {"a": 1}


def test_status_follows_what_is_in_the_directory(cell, tmp_path):
    runs = tmp_path / "runs"
    assert store.status(cell, runs) == "missing"
    directory = store.run_dir(cell, runs)
    directory.mkdir(parents=True)
    assert store.status(cell, runs) == "missing"
    store.begin(cell, runs)
    assert store.status(cell, runs) == "interrupted"
    with locks.claim(directory):
        assert store.status(cell, runs) == "running"
    store.write_failure(directory, "ValueError: bad", "line\n" * 100, 1)
    state = store.inspect(cell, runs)
    assert (state.word, state.why) == ("failed", "ValueError: bad")
    assert len(read_json(directory / "failed.json")["traceback"].splitlines()) == 30
    write_row(directory, cell)
    assert store.status(cell, runs) == "done"


def test_row_is_stale_when_its_code_changed(cell, directory, tmp_path, change_harness):
    write_row(directory, cell)
    runs = tmp_path / "runs"
    method = tmp_path / "methods" / "mine.py"
    method.write_text(METHOD + "# reworded\n")
    assert store.status(cell, runs) == "done"
    method.write_text(CHANGED)
    state = store.inspect(cell, runs)
    assert (state.word, state.why) == ("stale", "train: methods/mine.py changed")
    assert state.row is not None
    assert not state.trained
    method.write_text(METHOD)
    assert store.status(cell, runs) == "done"
    change_harness("evaluate", "time")
    state = store.inspect(cell, runs)
    assert (state.why, state.trained) == ("evaluate, time: harness changed", True)
    method.write_text("class Mine(")
    assert "mine.py, line 1: SyntaxError" in store.inspect(cell, runs).why
    method.unlink()
    assert "no method called 'mine'" in store.inspect(cell, runs).why
    assert not store.inspect(cell, runs).trained


def test_a_row_of_an_older_version_is_stale_and_says_so(cell, directory, tmp_path):
    flat = {"method": "a", "backbone": "b", "harness": "c"}
    write_json(directory / "row.json", {"metric": {}, "code": flat})
    state = store.inspect(cell, tmp_path / "runs")
    assert (state.word, state.why) == ("stale", "stamped by an older version")
    assert not state.trained


def test_a_composition_is_stale_with_either_of_its_files(cell, directory, tmp_path):
    (tmp_path / "methods" / "other.py").write_text(METHOD)
    both = Cell(Recipe(), "tiny", "mine+other")
    place = store.run_dir(both, tmp_path / "runs")
    place.mkdir()
    write_row(place, both)
    assert store.status(both, tmp_path / "runs") == "done"
    (tmp_path / "methods" / "other.py").write_text(CHANGED)
    state = store.inspect(both, tmp_path / "runs")
    assert (state.word, state.why) == (
        "stale",
        "train: methods/mine.py or methods/other.py changed",
    )


def test_begin_continues_its_own_checkpoint_and_sets_that_of_other_code_aside(
    cell, tmp_path, change_harness
):
    runs = tmp_path / "runs"
    store.run_dir(cell, runs).mkdir(parents=True)
    directory, why = store.begin(cell, runs)
    assert why == ""
    (directory / "last.pt").write_text("state")
    (directory / "log.txt").write_text("log")
    store.write_failure(directory, "out of memory")
    assert store.begin(cell, runs) == (directory, "")
    assert (directory / "last.pt").exists()
    assert not (directory / "failed.json").exists()
    for number, text in enumerate((CHANGED, METHOD), 1):
        (tmp_path / "methods" / "mine.py").write_text(text)
        line = store.begin(cell, runs)[1]
        aside = directory / f"set-aside-{number}"
        assert line == (
            f"starting over (methods/mine.py changed); what there was is kept in {aside}"
        )
        assert not (directory / "last.pt").exists()
        assert (aside / "last.pt").read_text() == "state"
        assert (directory / "log.txt").exists()
        (directory / "last.pt").write_text("state")
    store.clear(directory)
    assert (directory / "set-aside-1").is_dir()
    store.begin(cell, runs)
    change_harness("evaluate")
    (directory / "last.pt").write_text("state")
    assert store.begin(cell, runs) == (directory, "")  # training goes on
    assert (directory / "last.pt").exists()


def test_begin_sets_aside_what_an_older_version_stamped_and_clears_what_was_not_trained(
    cell, directory, tmp_path
):
    flat = {"method": "a", "backbone": "b", "harness": "c"}
    write_json(directory / "code.json", flat)
    assert store.begin(cell, tmp_path / "runs")[1] == ""
    assert not list(directory.glob("set-aside-*"))
    write_json(directory / "code.json", flat)
    (directory / "last.pt").write_text("state")
    assert "stamped by an older version" in store.begin(cell, tmp_path / "runs")[1]
    assert read_json(directory / "set-aside-1" / "code.json") == flat


def test_cell_file_gives_the_cell_back(cell, tmp_path):
    store.run_dir(cell, tmp_path).mkdir()
    directory, _ = store.begin(cell, tmp_path)
    assert load_cell(directory / "cell.json") == cell
    (directory / "cell.json").write_text('{"recipe": {}, "sed": 1}')
    with pytest.raises(ValueError, match=r"cell.json is not a cell: .*did you mean 'seed'"):
        load_cell(directory / "cell.json")
    with pytest.raises(ValueError, match="no cell file"):
        load_cell(tmp_path / "gone.json")


def test_rows_of_a_grid_have_todays_status(cell, directory, tmp_path):
    other = Cell(Recipe(), "tiny", "mine", seed=1)
    write_row(directory, cell)
    first, second = store.rows([cell, other], tmp_path / "runs")
    assert (first["status"], first["metric"]) == ("done", {"panoptic.pq": 0.5})
    assert (second["status"], second["seed"], "metric" in second) == ("missing", 1, False)
    assert second["cell"]["backbone"] == "tiny"
    assert "name" not in first
    names = {cell.id: "First", other.id: "Second"}
    found = store.rows([cell, other], tmp_path / "runs", names)
    assert [row["name"] for row in found] == ["First", "Second"]


# --- claims ---------------------------------------------------------------------------------------


def write_claim(directory, pid):
    (directory / "claim").write_text(json.dumps(locks.process(pid)))


def dead_pid():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_claim_is_exclusive_and_goes_with_the_block(directory):
    with locks.claim(directory):
        assert locks.claimed_by(directory)["pid"] == os.getpid()
        with pytest.raises(locks.ClaimedError, match=str(os.getpid())), locks.claim(directory):
            pass
        assert locks.claimed_by(directory) is not None
    assert not (directory / "claim").exists()


def test_claim_of_a_dead_process_is_void_at_once(directory):
    write_claim(directory, dead_pid())
    assert locks.claimed_by(directory) is None
    with locks.claim(directory):
        assert locks.claimed_by(directory)["pid"] == os.getpid()
    assert list(directory.iterdir()) == []


def test_claim_of_a_killed_process_nobody_waited_for_is_void(directory):
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    write_claim(directory, process.pid)
    assert locks.claimed_by(directory) is not None
    process.kill()
    deadline = time.monotonic() + 10
    while locks.claimed_by(directory) is not None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.wait()


# --- provenance -----------------------------------------------------------------------------------


def test_command_line_names_no_place_of_this_machine():
    argv = ["/opt/someone/bin/mtl-bench", "train", "runs/x/cell.json", "--data", "/mnt/cs"]
    argv += ["--plugins=/opt/someone/mine", "--set", "recipe.optim.lr=3e-4", "../someone/a.toml"]
    assert provenance.command_line(argv) == (
        "mtl-bench train runs/x/cell.json --data cs --plugins=mine "
        "--set recipe.optim.lr=3e-4 a.toml"
    )


def test_environment_tells_versions_and_hardware_and_no_names():
    import getpass
    import platform

    found = provenance.environment("cpu")
    assert found["torch"]
    assert found["threads"] >= 1
    assert found["device"] == found["cpu"]
    text = json.dumps({key: value for key, value in found.items() if key != "cpu"})
    assert platform.node() not in text
    assert f"/{getpass.getuser()}" not in text


def test_git_state(tmp_path):
    assert provenance.git_state(tmp_path) == (None, None)
    for words in (["init", "-q"], ["config", "user.email", "a@b.c"], ["config", "user.name", "n"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    (tmp_path / "file").write_text("1")
    subprocess.run(["git", "add", "file"], cwd=tmp_path, check=True)
    subprocess.run(["git", "commit", "-qm", "one"], cwd=tmp_path, check=True)
    commit, dirty = provenance.git_state(tmp_path)
    assert len(commit) == 40
    assert dirty is False
    (tmp_path / "file").write_text("2")
    assert provenance.git_state(tmp_path) == (commit, True)
