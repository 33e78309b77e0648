"""Exported graphs: they pass the checker, say what they are, and compute what the network does."""

import copy
import json
import sys

import numpy as np
import pytest
import torch
from small_networks import SIZE, images, model

from mtl_bench.core.batch import Camera
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import finish
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.deploy import export
from mtl_bench.deploy.agreement import equal_share
from mtl_bench.deploy.graph import strided
from mtl_bench.deploy.subject import untrained
from mtl_bench.tasks.panoptic import Panoptic

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

TASKS = Recipe.tasks
CAMERA = {
    "K": np.array([[[115, 0, 63.5], [0, 115, 31.5], [0, 0, 1]]], np.float32),
    "camera_height_m": np.array([1.4], np.float32),
    "pitch_rad": np.zeros(1, np.float32),
}


def written(tmp_path, post, tasks=TASKS, metadata=None):
    net = model("tiny", tasks).net
    path = tmp_path / "out" / "net.onnx"
    return export.export(net, SIZE, path, post, metadata)


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
    assert {p.name for p in path.parent.iterdir()} == {"net.json", "net.onnx"}


MAPS = {
    TASKS: ["semantic", "center", "offset", "inverse_depth"],
    ("panoptic",): ["semantic", "center", "offset"],
    ("depth",): ["inverse_depth"],
}
RESULTS = {
    TASKS: ["panoptic", "depth_m", "depth", "scale", "points"],
    ("panoptic",): ["panoptic"],
    ("depth",): ["depth_m", "depth", "scale", "points"],
}


SLOW = [pytest.param(tasks, marks=pytest.mark.slow) for tasks in list(MAPS)[1:]]


@pytest.mark.parametrize("tasks", [TASKS, *SLOW])
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
        own = out.maps["panoptic"]
        assert (maps["semantic"] == own["semantic"].argmax(1).numpy()).mean() > 0.999
        assert np.allclose(maps["center"], own["center"], atol=1e-5)
        assert np.allclose(maps["offset"], own["offset"], atol=1e-3)
    if "depth" in tasks:
        assert np.allclose(maps["inverse_depth"], out.maps["depth"]["inverse"], rtol=1e-4)
    found = run(second, maps | {name: CAMERA[name] for name in camera})
    assert list(found) == RESULTS[tasks]
    described(first.with_suffix(".json"), (first, second))
    if "depth" in tasks:  # a wall of one depth: no ground, so no metres, and the rest as it is
        maps["inverse_depth"][:] = 0.5
        maps |= {"semantic": np.zeros_like(maps["semantic"])} if "panoptic" in tasks else {}
        found = run(second, maps | {name: CAMERA[name] for name in camera})
        assert np.isnan(found["scale"]).all()
        assert np.isnan(found["depth_m"]).all()
        assert (found["depth"] == 2).all()


def described(path, files):
    """Everything that the files have stands in the JSON file with what it is."""
    about = json.loads(path.read_text())
    assert list(about["files"]) == [file.name for file in files]
    for file in files:
        inputs, outputs = names(file)
        own = about["files"][file.name]
        assert (list(own["inputs"]), list(own["outputs"])) == (inputs, outputs)
        assert all(port["what"] for side in own.values() for port in side.values())
    image = about["files"][files[0].name]["inputs"]["image"]
    assert (image["type"], image["axes"]) == ("uint8", [1, *SIZE, 3])
    assert about["classes"][1] == {"index": 1, "name": "road", "label_id": 7, "thing": False}


def test_the_graph_may_have_a_free_height_and_width():
    net = model("tiny").net
    graph = strided(net, (1, *SIZE), multiple=32)
    for size in ((32, 96), (160, 64)):
        image = images(1, size)[0]
        with torch.no_grad():
            inverse = export.FullSize(graph, None)(image)[-1]
            own = net(image.permute(0, 3, 1, 2).float() / 255).maps["depth"]["inverse"]
        assert torch.allclose(inverse, own, rtol=1e-4)


@pytest.mark.slow
def test_height_and_width_may_be_free(tmp_path):
    path = tmp_path / "net.onnx"
    net = model("tiny").net
    export.export(net, SIZE, path, "none", multiple=32)
    about = json.loads(path.with_suffix(".json").read_text())
    assert about["height"] == "multiples of 32"
    assert about["files"]["net.onnx"]["inputs"]["image"]["axes"][1:3] == ["32*height", "32*width"]
    for size in (SIZE, (32, 96), (160, 64)):
        image = images(1, size)[0]
        found = run(path, {"image": image.numpy()})
        with torch.no_grad():
            own = net(image.permute(0, 3, 1, 2).float() / 255).maps
        assert (found["semantic"] == own["panoptic"]["semantic"].argmax(1).numpy()).mean() > 0.999
        assert np.allclose(found["inverse_depth"], own["depth"]["inverse"], rtol=1e-4)


def test_what_is_made_for_one_size_says_so(tmp_path):
    with pytest.raises(ValueError, match="--dynamic goes with --post none"):
        export.export(model("tiny").net, SIZE, tmp_path / "net.onnx", "inside", multiple=32)
    net = copy.deepcopy(model("tiny").net)
    place = torch.zeros(SIZE[0] // 32, SIZE[1] // 32)  # as a learned place of each cell is
    net.backbone.register_forward_hook(lambda *given: given[-1] | {32: given[-1][32] + place})
    with pytest.raises(ValueError, match="made for one size: leave out --dynamic"):
        export.export(net, SIZE, tmp_path / "net.onnx", "none", multiple=32)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("post", ["inside", "apart"])
def test_two_outputs_of_one_name_are_refused(tmp_path, monkeypatch, post):
    monkeypatch.setattr(Panoptic, "exported", ("depth",))
    with pytest.raises(ValueError, match="two outputs of the file are called 'depth': leave out"):
        written(tmp_path, post)
    assert list(tmp_path.iterdir()) == []
    written(tmp_path, "none")  # which has the maps alone


def test_a_result_of_a_map_s_name_cannot_be_apart_from_it(tmp_path):
    net = untrained("tiny", "dense-small", ("normals",))[1].net.eval()
    with pytest.raises(ValueError, match="'normals' would be an input and an output"):
        export.export(net, SIZE, tmp_path / "net.onnx", "apart")
    assert list(tmp_path.iterdir()) == []


def test_the_description_needs_its_name(tmp_path):
    with pytest.raises(ValueError, match="is the name of the file that describes it"):
        export.export(model("tiny").net, SIZE, tmp_path / "net.json", "none")


@pytest.mark.slow
def test_inside_is_what_torch_computes(tmp_path):
    (path,) = written(tmp_path, "inside")
    assert names(path) == (["image", *CAMERA], RESULTS[TASKS])
    whole = model("tiny")
    for image in images(3):
        found = run(path, {"image": image.numpy(), **CAMERA})
        with torch.no_grad():
            out = whole.net(image.permute(0, 3, 1, 2).float() / 255)
            camera = Camera(*(torch.from_numpy(value) for value in CAMERA.values()))
            results = finish(whole.tasks, out.maps, camera)
            points = whole.tasks[1].points(results, camera)
            expected = {"depth_m": results["depth"]["depth_m"], "points": points}
        panoptic = results["panoptic"]["panoptic"]
        assert equal_share(panoptic, torch.from_numpy(found["panoptic"])) > 0.999
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
