"""Other data are other rows: what a row and a checkpoint remember of the data they are of."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cityscapes_tree
import kitti_tree
import pytest
from typer.testing import CliRunner

from mtl_bench.bench import data_state, store
from mtl_bench.bench.data_state import Data
from mtl_bench.cli.app import app
from mtl_bench.core import plugins, provenance
from mtl_bench.core.config import Cell, load_recipe, to_dict
from mtl_bench.core.files import write_json
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data.samples import open_samples


def in_layout_of(dataset, tree):
    recipe = load_recipe("kitti-smoke" if dataset == "kitti" else "smoke")
    data = replace(recipe.data, dataset=dataset, height=tree.HEIGHT, width=tree.WIDTH)
    return Cell(replace(recipe, data=data), "tiny", "fixed")


@pytest.fixture(params=["cityscapes", "kitti"])
def found(request, tmp_path):
    """A cell and its data, in either layout."""
    root = tmp_path / "place" / "data"
    if request.param == "kitti":
        kitti_tree.write_tree(root)
        return in_layout_of("kitti", kitti_tree), root
    for split in ("train", "val"):
        cityscapes_tree.write_tree(root, 3, split)
    return in_layout_of("cityscapes", cityscapes_tree), root


def row(cell, root):
    record = json.loads(json.dumps(Data(root).of(cell)))
    return {"metric": {}, "code": provenance.code(cell), "data": record}


def touched(path):
    state = path.stat()
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns + 10**9))


def a_file(cell, root):
    """One that training reads."""
    samples = open_samples(cell.recipe, tasks_of_cell(cell), "train", root, training=True)
    return min(path for path in samples.dataset.paths() if path.suffix == ".png")


def images(root, split):
    return sorted(
        path for path in root.rglob("*.png") if split in path.parts and "leftImg8bit" in path.parts
    )


def test_the_same_folder_is_the_same_data(found, tmp_path):
    cell, root = found
    stored = row(cell, root)
    record = stored["data"]["train"]
    assert record["frames"] > 0
    assert record["files"] > 2 * record["frames"]  # neighbours, labels, cameras
    assert store.state_of(stored, cell, Data(root)).word == "done"
    (root / ".DS_Store").write_text("of no data set")
    (root / "notes.txt").write_text("neither")
    assert store.state_of(stored, cell, Data(root)).word == "done"
    moved = root.parent.rename(tmp_path / "moved") / root.name
    assert store.state_of(stored, cell, Data(moved)).word == "done"
    assert store.state_of(stored, cell).word == "done"  # no data named: nothing to compare


def test_other_files_are_other_data(found, tmp_path):
    cell, root = found
    stored = row(cell, root)
    file = a_file(cell, root)
    with file.open("ab") as opened:
        opened.write(b"more")
    state = store.state_of(stored, cell, Data(root))
    assert (state.word, state.trained) == ("stale", False)
    assert "other data" in state.why
    assert "frames in" in state.why


def test_data_of_evaluation_alone_cost_no_training(tmp_path):
    root = tmp_path / "data"
    for split in ("train", "val"):
        cityscapes_tree.write_tree(root, 3, split)
    cell = in_layout_of("cityscapes", cityscapes_tree)
    stored = row(cell, root)
    with images(root, "val")[0].open("ab") as opened:
        opened.write(b"more")
    state = store.state_of(stored, cell, Data(root))
    assert (state.word, state.trained) == ("stale", True)
    assert state.stale.keys() == {"evaluate"}


def test_training_files_alone_written_anew_are_not_told_by_an_evaluation(tmp_path):
    root = tmp_path / "data"
    for split in ("train", "val"):
        cityscapes_tree.write_tree(root, 3, split)
    cell = in_layout_of("cityscapes", cityscapes_tree)
    stored = row(cell, root)
    touched(images(root, "train")[0])
    state = store.state_of(stored, cell, Data(root))
    assert state.why == "train: its data's files were written anew"
    assert not state.trained
    assert not store.unsure(state.stale)


def test_a_copy_is_told_by_contents_on_request_and_else_by_an_evaluation(found, monkeypatch):
    cell, root = found
    stored = row(cell, root)
    monkeypatch.setenv(data_state.CONTENTS, "1")
    with_contents = row(cell, root)
    monkeypatch.delenv(data_state.CONTENTS)
    for path in root.rglob("*.png"):
        touched(path)
    state = store.state_of(stored, cell, Data(root))
    assert state.why == "train, evaluate: its data's files were written anew"
    assert store.unsure(state.stale)
    assert store.state_of(with_contents, cell, Data(root)).word == "done"
    file = a_file(cell, root)
    content = bytearray(file.read_bytes())
    content[-20] ^= 1
    file.write_bytes(content)
    assert "other contents" in store.state_of(with_contents, cell, Data(root)).why


def test_generated_data_count_by_their_settings(smoke_cell, smoke_root, tmp_path):
    stored = row(smoke_cell, smoke_root)
    again = shutil.copytree(smoke_root, tmp_path / "again", copy_function=shutil.copyfile)
    assert store.state_of(stored, smoke_cell, Data(again)).word == "done"
    assert store.state_of(stored, smoke_cell, Data(None)).word == "done"  # needs no rendering
    settings = json.loads((again / "synthetic.json").read_text())
    (again / "synthetic.json").write_text(json.dumps(settings | {"seed": 77}))
    state = store.state_of(stored, smoke_cell, Data(again))
    assert "other data, generated from other settings" in state.why
    assert not store.unsure(state.stale)
    (again / "synthetic.json").write_text(json.dumps(settings))
    for split in ("train", "val"):  # as another version of the encoder would do
        with images(again, split)[0].open("ab") as opened:
            opened.write(b"more")
    assert store.unsure(store.state_of(stored, smoke_cell, Data(again)).stale)
    of_a_folder = row(smoke_cell, again)
    (again / "synthetic.json").unlink()
    real = row(smoke_cell, again)  # a folder of one's own under the same recipe
    assert "other data" in store.state_of(real, smoke_cell, Data(None)).why
    assert store.state_of(of_a_folder, smoke_cell, Data(None)).word == "done"


def test_a_row_of_an_older_version_is_trusted_with_a_recipes_own_data_alone(
    found, smoke_cell, smoke_root
):
    cell, root = found
    for each, place, word in (
        (cell, root, "stale"),
        (smoke_cell, smoke_root, "done"),
        (smoke_cell, None, "done"),
    ):
        older = {"metric": {}, "code": provenance.code(each)}
        state = store.state_of(older, each, Data(place))
        assert state.word == word
        if word == "stale":
            assert state.stale == dict.fromkeys(data_state.STAGES, provenance.STAMPED_BEFORE)
            assert store.unsure(state.stale)


def test_a_checkpoint_of_other_data_is_void_and_kept(found, tmp_path):
    cell, root = found
    runs = tmp_path / "runs"
    store.run_dir(cell, runs).mkdir(parents=True)
    directory, _ = store.begin(cell, runs, Data(root))
    (directory / "last.pt").write_text("state")
    assert store.begin(cell, runs, Data(root)) == (directory, "")
    file = a_file(cell, root)
    with file.open("ab") as opened:
        opened.write(b"more")
    line = store.begin(cell, runs, Data(root))[1]
    assert "starting over (other data: " in line
    assert (directory / "set-aside-1" / "last.pt").read_text() == "state"
    assert not (directory / "last.pt").exists()
    (directory / "last.pt").write_text("state")
    write_json(directory / "code.json", provenance.code(cell))  # of an older version
    assert "starting over" in store.begin(cell, runs, Data(root))[1]


def test_a_data_set_of_a_plugin_counts_by_all_that_is_in_its_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, str(Path(__file__).parents[1] / "plugins"))
    kind = plugins.load("datasets", "rooms")
    recipe = load_recipe("smoke")
    recipe = replace(recipe, data=replace(recipe.data, dataset="rooms"))
    root = tmp_path / "rooms"
    kind.example(root, recipe.data)
    dataset = kind(root, "train", recipe.data)
    before = data_state._record([dataset], root, contents=False)
    assert before["frames"] == 4
    assert before["files"] == 3 * 6 + 1
    (root / ".cache").mkdir()
    (root / ".cache" / "x").write_text("x")
    assert data_state._record([dataset], root, contents=False) == before


# --- at the command line --------------------------------------------------------------------------


def test_train_on_another_folder_is_not_done_already(smoke_cell, smoke_root, tmp_path, monkeypatch):
    """The command of the issue: the same cell, first on one folder and then on another."""
    monkeypatch.chdir(tmp_path)
    cell = replace(
        smoke_cell,
        recipe=replace(smoke_cell.recipe, optim=replace(smoke_cell.recipe.optim, steps=2)),
    )
    write_json(tmp_path / "cell.json", to_dict(cell))
    other = shutil.copytree(smoke_root, tmp_path / "other")
    (other / "synthetic.json").unlink()
    with images(other, "train")[0].open("ab") as opened:
        opened.write(b"more")

    def train(root, *words, code=0):
        done = CliRunner().invoke(
            app, ["train", "cell.json", "--data", str(root), "--device", "cpu", *words]
        )
        assert done.exit_code == code, done.output
        return done.output

    train(smoke_root)
    assert "done already (--rerun" in train(smoke_root)
    assert "done already, but stale: train: other data" in train(other)
    assert "starting over (train: other data" in train(other, "--stale")
    directory = tmp_path / "runs" / cell.slug
    assert (directory / "set-aside-1" / "row.json").is_file()
    assert "done already (--rerun" in train(other)
    for path in other.rglob("*.png"):
        touched(path)
    before = (directory / "last.pt").read_bytes()
    assert "but stale: train, evaluate: its data's files were written anew" in train(other)
    assert "every metric is that of the row" in train(other, "--stale")
    assert (directory / "last.pt").read_bytes() == before
    assert "done already (--rerun" in train(other)
