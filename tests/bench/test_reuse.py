"""What is not part of training is checked before it and trains nothing anew."""

import json
import shutil
from dataclasses import replace

import cv2
import pytest
import torch

from mtl_bench.bench import store
from mtl_bench.bench.data_state import Data
from mtl_bench.bench.launch import Here
from mtl_bench.core.config import override, training_json
from mtl_bench.train import loop

QUICK = ["recipe.optim.steps=2", "recipe.latency.passes=1", "recipe.latency.warmup=0"]


@pytest.fixture
def here(tmp_path, smoke_root):
    lines = []
    found = Here(tmp_path / "runs", smoke_root, "cpu", "off", lines.append, Data(smoke_root))
    return found, lines


def test_a_cell_that_differs_only_behind_training_takes_the_weights(smoke_cell, here):
    run, lines = here
    first = override(smoke_cell, QUICK)
    other = override(first, ["recipe.evaluate.top_k=5", "recipe.latency.passes=2"])
    longer = override(other, ["recipe.optim.steps=3"])
    assert training_json(first) == training_json(other) != training_json(longer)
    assert first.id != other.id
    run.run(first)
    lines.clear()
    run.run(other)
    assert any("trained already, in" in line for line in lines)
    before, after = (store.run_dir(cell, run.runs) for cell in (first, other))
    weights = [torch.load(path / "last.pt", weights_only=True)["model"] for path in (before, after)]
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    rows = [store.load_row(path) for path in (before, after)]
    assert rows[0]["time"]["train_s"] == rows[1]["time"]["train_s"]
    assert rows[1]["metric"]["latency.passes"] == 2
    assert (before / "curve.csv").read_bytes() == (after / "curve.csv").read_bytes()
    lines.clear()
    (before / "cell.json").write_text("{")  # a damaged neighbour is passed over
    run.run(longer)
    assert not any("trained already" in line for line in lines)


def test_a_video_cell_is_of_its_post_processing_too(smoke_cell):
    video = replace(smoke_cell, video=True)
    for setting, same in (("recipe.evaluate.top_k=5", False), ("recipe.latency.passes=3", True)):
        assert (training_json(override(video, [setting])) == training_json(video)) == same


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("recipe.evaluate.depth_crop=foo", "no recipe.evaluate.depth_crop called 'foo'"),
        ("recipe.evaluate.protocol=foo", "no protocol called 'foo'"),
        ('recipe.evaluate.also=["foo"]', "no protocol called 'foo'"),
        ("recipe.evaluate.split=foo", "foo"),
        ("recipe.latency.height=33", "change latency.height"),
        ("method.weights.center=-100", "weight of 'center' must be >= 0 and finite, not -100"),
    ],
)
def test_what_would_stop_a_cell_behind_training_stops_it_before(smoke_cell, here, setting, message):
    run, _ = here
    with pytest.raises(ValueError, match=message):
        run.run(override(replace(smoke_cell, method="fixed"), [*QUICK, setting]))
    assert not list(run.runs.glob("*/last.pt"))
    assert not list(run.runs.glob("*/curve.csv"))


def test_a_bad_label_of_the_evaluation_stops_a_cell_before_training(smoke_cell, here, tmp_path):
    run, _ = here
    root = shutil.copytree(run.root, tmp_path / "data")
    label = sorted((root / "gtFine" / "val").rglob("*_instanceIds.png"))[-1]
    cv2.imwrite(str(label), cv2.imread(str(label))[::2])
    with pytest.raises(ValueError, match=label.name):
        replace(run, root=root).run(override(smoke_cell, QUICK))
    assert not list(run.runs.glob("*/last.pt"))


def test_a_rehearsal_changes_no_number(smoke_cell, here, smoke_root, tmp_path, monkeypatch):
    run, _ = here
    cell = override(smoke_cell, QUICK)
    run.run(cell)
    rehearsed = store.run_dir(cell, run.runs)
    real = loop.train
    monkeypatch.setattr(
        "mtl_bench.bench.run.train", lambda *args, rehearse, **more: real(*args, **more)
    )
    replace(run, runs=tmp_path / "without").run(cell)
    plain = store.run_dir(cell, tmp_path / "without")
    states = [torch.load(path / "last.pt", weights_only=True) for path in (rehearsed, plain)]
    assert all(
        torch.equal(states[0]["model"][k], states[1]["model"][k]) for k in states[0]["model"]
    )
    assert torch.equal(states[0]["rng"], states[1]["rng"])
    metrics = [json.loads((path / "row.json").read_text())["metric"] for path in (rehearsed, plain)]
    for metric in metrics:
        for key in [key for key in metric if key.startswith("latency.")]:
            del metric[key]
    assert metrics[0] == metrics[1]
