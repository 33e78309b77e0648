"""Networks of one vector: engines, timing and export of numbers, classes and attributes."""

import functools
import itertools

import pytest
import torch

from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.engine import Setting
from mtl_bench.deploy import engines, export, timer
from mtl_bench.deploy.subject import subject, untrained

CPU = torch.device("cpu")
SMALL = ("recipe.data.train_scenes=8", "recipe.data.val_scenes=4", "recipe.data.test_scenes=4")
NETWORKS = {
    "digits": ("lenet", ("classify:left", "classify:right", "reconstruct:right_picture")),
    "scales": ("mlp", ("regress:y0", "regress:y1")),
    "celeba-cnn9": ("cnn9", ("attributes:Bald", "attributes:Smiling")),
}
SIZES = {"digits": (16, 16), "scales": (2, 2), "celeba-cnn9": (64, 64)}
HERE = [name for name in ("eager", "onnxruntime", "openvino") if not engines.available(name)]


@functools.cache
def network(recipe: str, folder):
    backbone, tasks = NETWORKS[recipe]
    cell, model = untrained(backbone, recipe, tasks, SMALL)
    kind, data, root = dataset_of(cell.recipe), cell.recipe.data, folder / recipe
    if kind.built_in:
        root = kind.render(data)
    else:
        kind.example(root, data)
    return subject(cell, model, (data.height, data.width), root, CPU, trained=False, images=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("vectors")


FAST = {("eager", "digits"), ("onnxruntime", "scales"), ("openvino", "scales")}
PAIRS = [
    pytest.param(*pair, marks=() if pair in FAST else pytest.mark.slow)
    for pair in itertools.product(HERE, NETWORKS)
]


@pytest.mark.parametrize(("name", "recipe"), PAIRS)
def test_an_engine_agrees_with_plain(folder, name, recipe):
    what, setting = network(recipe, folder), Setting(1, *SIZES[recipe], "fp32", CPU, 1)
    with torch.inference_mode():
        found = timer.compare(what, timer.make(what, name, setting), images=2)
    assert found.wrong("fp32") == found.wrong("fp32", trained=False) == ""
    assert 0 <= found.values()["agreement.maps_rms"] < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("name", "recipe"), list(itertools.product(HERE, NETWORKS)))
def test_an_engine_is_timed(folder, name, recipe):
    what = network(recipe, folder)
    row = timer.row(what, name, "fp32", CPU, timer.Plan(passes=2, batch=2, warmup=1))
    assert (row["status"], row["why"]) == ("done", "")
    assert row["metric"]["latency.mean_ms"] > 0


def test_a_wrong_engine_is_caught_though_weights_are_trained(folder):
    from mtl_bench.deploy.agreement import Agreement
    from mtl_bench.deploy.maps import infos

    found = Agreement(infos(network("scales", folder).tasks))
    for number in (3.0, 1e-9, -2.0):  # one of them near 0 says nothing by itself
        maps = {"regress:y0.number": torch.full((1, 1), number), "regress:y1.number": torch.ones(1)}
        found.update(
            (maps, {}), (maps | {"regress:y0.number": torch.full((1, 1), number + 1e-5)}, {})
        )
    assert found.wrong("fp32") == ""
    found.update((maps, {}), ({name: map_ * 1.01 for name, map_ in maps.items()}, {}))
    assert "of their size (limit 0.001)" in found.wrong("fp32")


@pytest.mark.parametrize(
    "recipe", [*("digits", "scales"), pytest.param("celeba-cnn9", marks=pytest.mark.slow)]
)
def test_the_exported_file_computes_what_the_network_does(folder, tmp_path, recipe):
    onnxruntime = pytest.importorskip("onnxruntime")
    what = network(recipe, folder)
    (path,) = export.export(what.net, what.size, tmp_path / "net.onnx", "inside", None)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    image_1HW3 = what.images[0]
    feed = {session.get_inputs()[0].name: image_1HW3.numpy()}
    assert len(session.get_inputs()) == 1  # no camera
    found = dict(zip((o.name for o in session.get_outputs()), session.run(None, feed), strict=True))
    assert len(found) == len(what.tasks)
    plain = timer.make(what, "plain", Setting(1, *what.size, "fp32", CPU, 1))
    with torch.inference_mode():
        results = what.last(1, CPU)(plain.run(plain.transfer(image_1HW3)))
    for task in what.tasks:
        (name,) = task.exported
        expected, own = results[task.name][name], torch.from_numpy(found[f"{name}:{task.field}"])
        torch.testing.assert_close(own.float(), expected.float(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("recipe", ["scales", pytest.param("celeba-cnn9", marks=pytest.mark.slow)])
def test_a_network_of_one_size_has_no_free_one(folder, tmp_path, recipe):
    what = network(recipe, folder)
    size = "x".join(map(str, what.size))
    with pytest.raises(ValueError, match=f"one vector, and is made for {size} alone: leave it"):
        export.export(what.net, what.size, tmp_path / "net.onnx", "none", multiple=1)
    assert list(tmp_path.iterdir()) == []
