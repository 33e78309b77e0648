"""Exported graphs: they pass the checker, say what they are, and compute what the network does."""

import json
import sys

import numpy as np
import pytest
import torch
from small_networks import SIZE, images, model

from mtl_bench import export
from mtl_bench.core import config
from mtl_bench.core.config import load_recipe
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.engines.agreement import equal_share

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

EVALUATE = load_recipe("smoke").evaluate
CAMERA = {
    "K": np.array([[[115, 0, 63.5], [0, 115, 31.5], [0, 0, 1]]], np.float32),
    "camera_height_m": np.array([1.4], np.float32),
    "pitch_rad": np.zeros(1, np.float32),
}


def written(tmp_path, post, tasks=config.TASKS, metadata=None):
    net = model("tiny", tasks).net
    path = tmp_path / "out" / "net.onnx"
    return export.export(net, SIZE, path, CITYSCAPES20, EVALUATE, post, metadata)


def names(path):
    graph = onnx.load(str(path)).graph
    return [value.name for value in graph.input], [value.name for value in graph.output]


def run(path, feed):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    outputs = [value.name for value in session.get_outputs()]
    return dict(zip(outputs, session.run(None, feed), strict=True))


def test_the_file_passes_the_checker_and_says_what_it_is(tmp_path):
    (path,) = written(tmp_path, "none", metadata={"cell_id": "0123456789ab"})
    found = onnx.load(str(path))
    onnx.checker.check_model(found, full_check=True)
    about = {prop.key: prop.value for prop in found.metadata_props}
    assert about["cell_id"] == "0123456789ab"
    assert json.loads(about["classes"])[1:3] == ["road", "sidewalk"]
    assert json.loads(about["things"]) == list(CITYSCAPES20.things)
    assert (about["height"], about["width"]) == ("64", "128")
    image = found.graph.input[0]
    assert image.type.tensor_type.elem_type == onnx.TensorProto.UINT8
    assert [d.dim_value for d in image.type.tensor_type.shape.dim] == [1, *SIZE, 3]
    assert [p.name for p in path.parent.iterdir()] == ["net.onnx"]


MAPS = {
    config.TASKS: ["semantic", "center", "offset", "inverse_depth"],
    ("panoptic",): ["semantic", "center", "offset"],
    ("depth",): ["inverse_depth"],
}
RESULTS = {
    config.TASKS: ["panoptic", "depth_m", "points"],
    ("panoptic",): ["panoptic"],
    ("depth",): ["depth_m", "points"],
}


SLOW = [pytest.param(tasks, marks=pytest.mark.slow) for tasks in list(MAPS)[1:]]


@pytest.mark.parametrize("tasks", [config.TASKS, *SLOW])
def test_apart_the_two_files_fit_together(tmp_path, tasks):
    first, second = written(tmp_path, "apart", tasks)
    camera = list(CAMERA) if "depth" in tasks else []
    assert names(first) == (["image"], MAPS[tasks])
    assert names(second) == (MAPS[tasks] + camera, RESULTS[tasks])

    image = images(1)[0]
    maps = run(first, {"image": image.numpy()})
    with torch.no_grad():
        out = model("tiny", tasks).net(image.permute(0, 3, 1, 2).float() / 255)
    if "panoptic" in tasks:
        assert (maps["semantic"] == out.semantic_BCHW.argmax(1).numpy()).mean() > 0.999
        assert np.allclose(maps["center"], out.center_B1HW, atol=1e-5)
        assert np.allclose(maps["offset"], out.offset_B2HW, atol=1e-3)
    if "depth" in tasks:
        assert np.allclose(maps["inverse_depth"], out.inverse_depth[0], rtol=1e-4)
    found = run(second, maps | {name: CAMERA[name] for name in camera})
    assert list(found) == RESULTS[tasks]


@pytest.mark.slow
def test_inside_is_what_torch_computes(tmp_path):
    (path,) = written(tmp_path, "inside")
    assert names(path) == (["image", *CAMERA], RESULTS[config.TASKS])
    net = model("tiny").net
    finish = export._finish(CITYSCAPES20, EVALUATE)
    for image in images(3):
        found = run(path, {"image": image.numpy(), **CAMERA})
        with torch.no_grad():
            out = net(image.permute(0, 3, 1, 2).float() / 255)
            camera = [torch.from_numpy(value) for value in CAMERA.values()]
            maps = (out.semantic_BCHW, out.center_B1HW, out.offset_B2HW, out.inverse_depth[0])
            expected = finish(*maps, *camera)
        assert equal_share(expected["panoptic"], torch.from_numpy(found["panoptic"])) > 0.999
        for name in ("depth_m", "points"):
            same = np.isclose(found[name], expected[name], rtol=1e-3, equal_nan=True)
            assert same.mean() > 0.999


def test_a_missing_package_is_named_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"pip install 'mtl-bench\[onnx\]'"):
        written(tmp_path, "none")


def test_a_failure_leaves_no_file(tmp_path, monkeypatch):
    def broken(*args, **kwargs):
        raise RuntimeError("unsound")

    monkeypatch.setattr(onnx.checker, "check_model", broken)
    with pytest.raises(RuntimeError, match="unsound"):
        written(tmp_path, "none")
    assert list((tmp_path / "out").iterdir()) == []


def test_an_unknown_place_for_the_post_processing(tmp_path):
    with pytest.raises(ValueError, match="'outside' is none of inside, apart, none"):
        written(tmp_path, "outside")
