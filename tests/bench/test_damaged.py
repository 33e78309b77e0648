"""Files that a run left and something has damaged: named, with the remedy, and the others go on."""

import json
import os
import shutil
import time
from dataclasses import replace

import pytest
import torch
from launching import cells
from typer.testing import CliRunner

from mtl_bench.bench import store
from mtl_bench.bench.jobs import load_run
from mtl_bench.cli.app import app
from mtl_bench.core import locks, provenance
from mtl_bench.core.config import Cell, load_recipe, to_dict
from mtl_bench.core.files import write_json
from mtl_bench.train import checkpoint, curve

JUNK = {
    "emptied": b"",
    "cut": b'{"metric": {"panoptic.pq": 2',
    "binary": bytes(range(256)),
    "a list": b"[1, 2]",
    "a number": b"3",
    "nothing in it": b"{}",
    "wrong metrics": b'{"metric": {"panoptic.pq": "good"}}',
    "wrong sections": b'{"metric": 3, "code": []}',
}


def call(*words, code=0):
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.output
    return done.output


def finished(cell, runs, **more):
    directory = store.run_dir(cell, runs)
    directory.mkdir(parents=True)
    write_json(directory / "cell.json", to_dict(cell))
    row = {"cell_id": cell.id, "metric": {"panoptic.pq": 2.0}, "code": provenance.code(cell)}
    write_json(directory / "row.json", {**row, "time": {"train_s": 3.0}, **more})
    return directory


# --- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("junk", JUNK)
def test_a_damaged_row_is_named_and_costs_one_cell(junk, tmp_path):
    one, other = cells(2)
    directory = finished(one, tmp_path)
    finished(other, tmp_path)
    (directory / "row.json").write_bytes(JUNK[junk])
    state = store.inspect(one, tmp_path)
    assert (state.word, state.row) == ("failed", None)
    assert f"{directory}/row.json is damaged (" in state.why
    assert "delete it to run its cell again" in state.why
    assert "\n" not in state.why
    assert [row["status"] for row in store.rows([one, other], tmp_path)] == ["failed", "done"]
    assert store.to_run([one, other], tmp_path) == [one]
    assert "done 1   failed 1" in store.summary(store.kind_of(one), [one, other], tmp_path)
    assert store.hours_to_run([one], [one, other], tmp_path) == pytest.approx(3 / 3600)


def test_what_keeps_its_training_is_expected_to_take_what_its_row_says_of_the_rest(tmp_path):
    one, other, third = cells(3)
    now = provenance.code(one)
    took = {"train_s": 100.0, "pseudo_s": 10.0, "eval_s": 3.0, "latency_s": 2.0, "step_ms": 9.0}
    timed_before = {**now, "time": {"harness": "earlier"}}
    trained_before = {**now, "train": {"harness": "earlier"}}
    finished(one, tmp_path, time=took, code=timed_before)
    finished(other, tmp_path, time=took, code=trained_before)

    def expected(todo, rerun):
        return store.hours_to_run(todo, [one, other, third], tmp_path, rerun) * 3600

    assert store.to_run([one, other], tmp_path, "stale") == [one, other]
    assert expected([one], "stale") == pytest.approx(5.0)
    assert expected([one], "latency") == pytest.approx(5.0)
    assert expected([one], "all") == pytest.approx(115.0)
    assert expected([other], "stale") == pytest.approx(115.0)
    assert expected([one, other, third], "stale") == pytest.approx(235.0)
    assert store.hours_to_run([one], [third], tmp_path, "stale") * 3600 == pytest.approx(5.0)


def test_rows_of_all_cells_leave_a_damaged_one_out_and_say_so(tmp_path, capsys):
    one, other, third = cells(3)
    (finished(one, tmp_path) / "row.json").write_bytes(b"")
    (finished(other, tmp_path) / "cell.json").write_bytes(b"[]")
    finished(third, tmp_path)
    assert [row["cell_id"] for row in store.all_rows(tmp_path)] == [third.id]
    told = capsys.readouterr().err
    assert f"{one.slug}/row.json is damaged" in told
    assert f"{other.slug}/cell.json is damaged" in told


def test_a_copied_row_is_not_shown_as_another_cells(tmp_path):
    """Seed 0's row in seed 1's folder."""
    zero, one = cells(2)
    source = finished(zero, tmp_path)
    directory = finished(one, tmp_path)
    shutil.copy(source / "row.json", directory)
    state = store.inspect(one, tmp_path)
    assert (state.word, state.row) == ("failed", None)
    assert f"row.json is another cell's: its cell_id is {zero.id}, not {one.id}" in state.why
    assert store.inspect(zero, tmp_path).word == "done"
    assert store.to_run([zero, one], tmp_path) == [one]


@pytest.mark.parametrize("name", ["failed.json", "code.json"])
@pytest.mark.parametrize("junk", ["emptied", "binary", "a list"])
def test_other_records_are_named_too(name, junk, tmp_path):
    (cell,) = cells(1)
    directory = store.run_dir(cell, tmp_path)
    directory.mkdir()
    (directory / name).write_bytes(JUNK[junk])
    message = f"{name} is damaged"
    if name == "failed.json":
        state = store.inspect(cell, tmp_path)
        assert state.word == "failed"
        assert message in state.why
        assert store.begin(cell, tmp_path)[1] == ""  # the next start forgets it
        return
    assert store.inspect(cell, tmp_path).word == "interrupted"
    with pytest.raises(ValueError, match=message):
        store.begin(cell, tmp_path)


def test_what_a_kill_left_half_written_is_swept_away(tmp_path):
    (cell,) = cells(1)
    directory = store.run_dir(cell, tmp_path)
    directory.mkdir()
    (directory / ".last.pt.1-2.tmp").write_bytes(b"half")
    (directory / ".cell.json.1-2.tmp").write_bytes(b"a launcher writes it, maybe now")
    store.begin(cell, tmp_path)
    assert {path.name for path in directory.glob(".*")} == {".cell.json.1-2.tmp"}


GRID = """
recipe = "smoke"
[axes]
backbone = ["tiny"]
method = ["fixed"]
seed = [0, 1]
"""


def test_status_and_report_go_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(GRID)
    one, other = (Cell(load_recipe("smoke"), "tiny", "fixed", seed=seed) for seed in (0, 1))
    (finished(one, tmp_path / "runs") / "row.json").write_bytes(JUNK["binary"])
    directory = finished(other, tmp_path / "runs")
    (directory / "curve.csv").write_bytes(b"step,total\r\n1,0.5\r\n3,")
    (directory / "samples.npz").write_bytes(b"PK\x03\x04 cut")
    text = call("status", "--grid", "mine.toml")
    assert "row.json is damaged" in text
    assert "done 1   failed 1" in text
    text = call("report", "--grid", "mine.toml")
    assert f"left out of the figures: runs/{other.slug}/samples.npz is damaged (" in text
    assert (tmp_path / "reports" / "mine" / "index.html").is_file()
    assert "is damaged" in (tmp_path / "reports" / "mine" / "index.html").read_text()


# --- claims ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"3", b"{}", bytes(range(256)), b'{"pid": "x", "machine": "%s"}']
)
def test_a_damaged_claim_counts_for_a_moment_only(text, tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "WRITING_S", 0.1)
    text = text.replace(b"%s", locks._machine().encode())
    (tmp_path / "claim").write_bytes(text)
    os.utime(tmp_path / "claim", (0, 0))  # however old it seems to be
    assert locks.claimed_by(tmp_path) == {}
    time.sleep(0.15)
    assert locks.claimed_by(tmp_path) is None
    with locks.claim(tmp_path):
        assert locks.claimed_by(tmp_path)["pid"] == os.getpid()


@pytest.mark.parametrize("text", ['{"pid": 1, "machine": "elsewhere"}', ""])
def test_a_claim_of_a_time_that_has_not_come_blocks_nobody(text, tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "WRITING_S", 0.1)
    monkeypatch.setattr(locks, "LEASE_S", 0.1)
    (tmp_path / "claim").write_text(text)
    os.utime(tmp_path / "claim", (time.time() + 24 * 3600,) * 2)
    with locks.claim(tmp_path):
        pass


# --- curves ---------------------------------------------------------------------------------------

HEAD = "step,total,loss.a,step_ms,data_ms\r\n"
WHOLE = HEAD + "1,0.5,,10,1\r\n2,0.4,3,10.5,1\r\n3,0.3,2,10,1\r\n"


@pytest.mark.parametrize("cut", range(len(WHOLE) - 13, len(WHOLE)))
def test_an_unfinished_last_line_is_dropped(cut, tmp_path):
    path = tmp_path / "curve.csv"
    path.write_bytes(WHOLE[:cut].encode())
    assert [row["step"] for row in curve.read(path)] == ["1", "2"]
    assert curve.training_time(path) == (0.0205, 10.25)
    with curve.Curve(path, 2) as resumed:
        resumed.append({"step": 3, "total": 0.3, "loss.a": 2, "step_ms": 10, "data_ms": 1})
    assert path.read_bytes().decode() == WHOLE


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("", "ends at step 0, before the checkpoint's 2"),
        (HEAD + "1,0.5,,10,1\r\n", "ends at step 1, before"),
        (HEAD + "1,0.5,,10,1\r\n3,0.3,2,10,1\r\n", "damaged .line 3 is not step 2"),
        (HEAD + "1,0.5,10,1\r\n", "damaged .line 2 is not step 1"),
        (HEAD + "1,0.5,,10,1,7\r\n", "damaged .line 2 is not step 1"),
        (HEAD + "1,big,,10,1\r\n", "damaged .could not convert"),
        ("loss,total\r\n1,2\r\n", "damaged .no column 'step'"),
        ("{}\r\n{}\r\n", "damaged .no column 'step'"),
        (b"\x89PNG\r\n\xff\xfe\r\n", "damaged .'utf-8' codec"),
        (None, "no curve"),
    ],
)
def test_another_curve_is_named_with_the_remedy(content, why, tmp_path):
    path = tmp_path / "curve.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=rf"{why}.*begin at step 0: train --rerun") as error:
        curve.Curve(path, 2)
    assert str(path) in str(error.value)


# --- checkpoints ----------------------------------------------------------------------------------


def parts():
    model = torch.nn.Linear(2, 2)
    optimizer = torch.optim.Adam(model.parameters())
    return model, torch.nn.Linear(1, 1), optimizer, torch.amp.GradScaler("cpu", enabled=False)


@pytest.fixture
def saved(tmp_path):
    (cell,) = cells(1)
    checkpoint.save(tmp_path / "last.pt", 7, *parts(), cell)
    return cell, tmp_path / "last.pt"


def test_one_that_saw_more_gpus_is_continued_on_fewer(saved, monkeypatch):
    cell, path = saved
    state = torch.load(path)
    state["rng_cuda"] = [torch.tensor([n], dtype=torch.uint8) for n in range(3)]
    torch.save(state, path)
    assert checkpoint.restore(path, cell, *parts()) == 7
    found = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda drawn, gpu: found.append((gpu, drawn)))
    checkpoint.restore(path, cell, *parts())
    assert found == [(0, torch.tensor([0], dtype=torch.uint8))]


def test_a_checkpoint_of_another_cell_is_not_continued(saved):
    cell, path = saved
    assert checkpoint.restore(path, cell, *parts()) == 7
    other = replace(cell, seed=1)
    with pytest.raises(ValueError, match=f"is of cell {cell.id}, not of {other.id}; .*delete it"):
        checkpoint.restore(path, other, *parts())


def rewrite(path, **changes):
    state = checkpoint.read(path) | changes
    torch.save({key: value for key, value in state.items() if value is not None}, path)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda path: path.write_bytes(b""), "is not a readable checkpoint: it is empty"),
        (lambda path: path.write_bytes(bytes(range(256))), "it is no file of torch.save"),
        (lambda path: path.write_bytes(path.read_bytes()[:-900]), "is not a readable checkpoint"),
        (lambda path: torch.save({"format": 1}, path), "not a whole checkpoint: it has no 'model'"),
        (lambda path: torch.save([1], path), "is not a checkpoint of format 1"),
        (lambda path: torch.save({"format": 1, "f": Cell}, path), "more than tensors"),
        (lambda path: rewrite(path, step=None), "it has no 'step'"),
        (lambda path: rewrite(path, step="7"), "it has no 'step'"),
        (lambda path: rewrite(path, rng=[1]), "it has no 'rng'"),
        (lambda path: rewrite(path, cell=3), "it has no 'cell'"),
        (lambda path: rewrite(path, model={"a": 1}), "not of this cell's model"),
        (lambda path: rewrite(path, optimizer={}), "not of this cell's optimizer"),
        (lambda path: rewrite(path, method={"a": 1}), "not of this cell's method"),
    ],
)
def test_junk_is_one_line_that_names_the_file_and_the_remedy(saved, change, why):
    cell, path = saved
    change(path)
    with pytest.raises(ValueError, match=why) as error:
        checkpoint.restore(path, cell, *parts())
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert "weights_only" not in str(error.value)


def test_one_mailed_file_is_enough(saved, tmp_path):
    cell, path = saved
    assert load_run(path) == (cell, path)
    mailed = tmp_path / "inbox" / "from_a_colleague.pt"
    mailed.parent.mkdir()
    path.rename(mailed)
    write_json(mailed.with_name("cell.json"), to_dict(replace(cell, seed=5)))
    assert load_run(mailed) == (cell, mailed)
    mailed.rename(mailed.with_name("last.pt"))
    with pytest.raises(ValueError, match=f"is of cell {cell.id}, not of"):
        load_run(mailed.parent)
    rewrite(mailed.with_name("last.pt"), cell=None)  # of an older version
    assert load_run(mailed.with_name("last.pt"))[0].seed == 5
    rewrite(mailed.with_name("last.pt"), cell={"id": "x", "values": {"recipe": 3}})
    with pytest.raises(ValueError, match=r"the cell in .*last.pt is none of this version's: "):
        load_run(mailed.with_name("last.pt"))
    rewrite(mailed.with_name("last.pt"), cell=None)
    mailed.with_name("cell.json").unlink()
    with pytest.raises(ValueError, match=r"put its cell.json beside it"):
        load_run(mailed.with_name("last.pt"))


def test_a_mailed_file_needs_no_initial_weights(tmp_path):
    weights = tmp_path / "first.pth"
    weights.write_bytes(b"weights")
    cell = replace(cells(1)[0], pretrained=str(weights))
    checkpoint.save(tmp_path / "last.pt", 7, *parts(), cell)
    mailed, identity = checkpoint.cell_of(tmp_path / "last.pt"), cell.id
    weights.unlink()
    assert mailed.id == identity
    assert str(tmp_path) not in json.dumps(to_dict(mailed))
