"""Predictions that were made elsewhere have the numbers that they would have here."""

import json

import cv2
import numpy as np
import pytest
import torch
from small_networks import model
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.data.loader import eval_batches
from mtl_bench.data.png import read as read_png
from mtl_bench.evaluate.score import score
from mtl_bench.evaluate.walk import evaluate, open_walks, predict, true_size
from mtl_bench.tasks.panoptic.files import read_ids, write_panoptic
from mtl_bench.tasks.panoptic.grouping import to_instance_ids


@pytest.fixture(scope="module")
def predicted(smoke_root, tmp_path_factory):
    """A model's numbers, and what it predicts as files below two folders, named as images are."""
    from mtl_bench.core.config import Cell, load_recipe

    cell = Cell(load_recipe("smoke"), backbone="tiny", method="fixed")
    own = model("tiny")
    expected = evaluate(own, cell, smoke_root, torch.device("cpu")).metrics
    root = tmp_path_factory.mktemp("predicted")
    (walk,) = open_walks(cell.recipe, own.tasks, smoke_root)
    labels = walk.samples.dataset.labels
    with torch.inference_mode():
        for batch in eval_batches(walk.samples, 1):
            found = predict(own, batch, own.tasks, true_size(batch))
            name = f"{batch.names[0].split('_')[0]}/{batch.names[0]}_leftImg8bit"
            ids_HW = to_instance_ids(found["panoptic"]["panoptic"][0], labels).numpy()
            for folder in ("ids", "depths"):
                (root / folder / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / f"ids/{name}_instanceIds.png"), ids_HW.astype(np.uint16))
            np.save(root / f"depths/{name}_depth.npy", found["depth"]["depth"][0, 0].numpy())
            (root / f"depths/{name}_depth_colors.png").write_bytes(b"no map")
    return cell.recipe, root, expected


def test_files_have_the_numbers_of_the_network(predicted, smoke_root):
    recipe, root, expected = predicted
    folders = {"panoptic": root / "ids", "depth": root / "depths"}
    found = score(recipe, folders, smoke_root).metrics
    same = {key for key in expected if key.startswith("panoptic.")}
    assert len(same) > 10
    assert {key: found[key] for key in same} == {key: expected[key] for key in same}
    median = {key for key in expected if key.startswith("depth_median.")}
    assert {k: found[k] for k in median} == pytest.approx({k: expected[k] for k in median})


def test_the_truth_is_without_fault(predicted, smoke_root, tmp_path):
    recipe, _, _ = predicted
    for file in smoke_root.glob("gtFine/val/*/*_instanceIds.png"):
        name = file.name.replace("_gtFine_instanceIds", "")
        (tmp_path / name).write_bytes(file.read_bytes())
    found = score(recipe, {"panoptic": tmp_path}, smoke_root, "val").metrics
    assert found["panoptic.pq"] == found["semantic.miou"] == 100
    assert not any(key.startswith("depth") for key in found)


def test_the_command_prints_them(predicted, smoke_root):
    _, root, expected = predicted
    words = ["score", "--recipe", "smoke", "--data", str(smoke_root), f"--panoptic={root / 'ids'}"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["panoptic.pq"] == expected["panoptic.pq"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "say where predictions are"),
        (("--panoptic",), "say where predictions are"),
        (("--panoptc", "x"), "'--panoptc' is no option and no task"),
        (("--depth", "nowhere"), "no folder 'nowhere'"),
    ],
)
def test_wrong_words_are_one_line(words, said, smoke_root):
    result = CliRunner().invoke(app, ["score", "--data", str(smoke_root), *words])
    assert result.exit_code == 2
    assert said in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_a_frame_without_a_file_or_with_two(predicted, smoke_root, tmp_path):
    recipe, root, _ = predicted
    files = sorted(root.glob("ids/*/*.png"))
    for file in files[1:]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with pytest.raises(ValueError, match="no file for the frame"):
        score(recipe, {"panoptic": tmp_path}, smoke_root)
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / files[0].name).write_bytes(files[0].read_bytes())
    with pytest.raises(ValueError, match="no file for the frame"):  # other folders than the image's
        score(recipe, {"panoptic": tmp_path}, smoke_root)
    name = files[0].name.replace("_leftImg8bit", "")
    (tmp_path / name).write_bytes(files[0].read_bytes())
    (tmp_path / files[0].name).write_bytes(files[0].read_bytes())
    with pytest.raises(ValueError, match="2 files for the frame"):
        score(recipe, {"panoptic": tmp_path}, smoke_root)


def test_the_official_evaluators_files_are_read(tmp_path):
    ids = np.zeros((4, 6), np.int64)
    ids[0], ids[1, :3], ids[1, 3:], ids[2] = 7, 26001, 26002, 26
    file = write_panoptic(tmp_path, "val", [("a", ids)])
    png = file.with_suffix("") / "a_panoptic.png"
    found = read_ids(png)
    for value in np.unique(ids):
        assert len(np.unique(found[ids == value])) == 1
    assert (found[ids == 7] == 7).all()
    assert (found[ids >= 26000] // 1000 == 26).all()
    assert len(np.unique(found)) == 5
    foreign = {"id": 26002, "category_id": 33}
    listed = json.loads(file.read_text())
    segments = listed["annotations"][0]["segments_info"]
    listed["annotations"][0]["segments_info"] = [s for s in segments if s["id"] != 26002]
    other = tmp_path / "other"
    other.mkdir()
    (other / "a_panoptic.png").write_bytes(png.read_bytes())
    (tmp_path / "other.json").write_text(json.dumps(listed))
    with pytest.raises(ValueError, match="no segment 26002"):
        read_ids(other / "a_panoptic.png")
    third = (tmp_path / "other").rename(tmp_path / "third")
    listed["annotations"][0]["segments_info"].append(foreign)
    (tmp_path / "third.json").write_text(json.dumps(listed))
    assert (read_ids(third / "a_panoptic.png")[ids == 26002] // 1000 == 33).all()


def test_depth_files(tmp_path):
    task = model("tiny").tasks[1]
    file = tmp_path / "a_depth.png"
    steps = np.full((4, 6), 2560, np.uint16)
    steps[0, 0] = 0  # nothing there: the nearest one's
    cv2.imwrite(str(file), steps)
    assert read_png(file, 16)[0, 0] == 0
    assert (task.read_result(file, (4, 6))["depth_m"] == 10).all()
    assert task.read_result(file, (8, 12))["depth"].shape == (1, 1, 8, 12)
    for content in (np.zeros((4, 6)), np.ones((4, 6, 2)), np.array([None])):
        np.save(tmp_path / "b.npy", content)
        with pytest.raises(ValueError, match=r"b\.npy"):
            task.read_result(tmp_path / "b.npy", (4, 6))
