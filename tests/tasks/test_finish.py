"""From outputs to panoptic ids, metres and points: eagerly, in ONNX Runtime and in OpenVINO."""

import math

import numpy as np
import pytest
import torch

from mtl_bench.core import config, geometry
from mtl_bench.core.batch import Camera
from mtl_bench.core.task import finish as finish_tasks
from mtl_bench.core.task import tasks_of
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.tasks.depth import scale
from mtl_bench.tasks.depth.scale import dgc_scale
from mtl_bench.tasks.panoptic import grouping

THINGS = CITYSCAPES20.things
ROAD, SKY, EGO = (CITYSCAPES20.index(name) for name in ("road", "sky", "ego vehicle"))
HEIGHT, WIDTH = 48, 96
SETTINGS = config.Evaluate(stuff_area=60, nms_kernel=5, top_k=40)
NAMES = ("semantic", "center", "offset", "inverse", "K", "camera_height", "pitch")


class Finish(torch.nn.Module):
    """What tasks make of maps, and points; a task whose maps are None is not there."""

    def forward(self, semantic, center, offset, inverse, K, camera_height, pitch):
        maps = {}
        if semantic is not None:
            maps["panoptic"] = {"semantic": semantic, "center": center, "offset": offset}
        if inverse is not None:
            maps["depth"] = {"inverse": inverse}
        tasks = tasks_of(config.Recipe(evaluate=SETTINGS), maps, CITYSCAPES20)
        camera = Camera(K, camera_height, pitch)
        done = finish_tasks(tasks, maps, camera)
        found = {}
        if semantic is not None:
            found["panoptic"] = done["panoptic"]["panoptic"]
        if inverse is not None:
            found["depth_m"] = done["depth"]["depth_m"]
            found["points"] = tasks[-1].points(done, camera)
        return found


def finish() -> Finish:
    return Finish().eval()


@pytest.mark.parametrize("slope", [0.0, 4.0])
def test_depth_starts_as_a_ground_that_comes_nearer_by_the_slope(slope):
    network = config.Network(depth_slope=slope)
    (depth,) = tasks_of(config.Recipe(network=network), ["depth"], CITYSCAPES20)
    inverse = depth.activate({"inverse": torch.zeros(1, 1, 4, 3)})["inverse"]
    logits = (inverse * network.min_depth).logit()
    rows = torch.tensor([-0.375, -0.125, 0.125, 0.375])  # the middles of four of them
    torch.testing.assert_close(logits, slope * rows[:, None].expand(1, 1, 4, 3))


def inputs(seed: int, case: str = "plain") -> tuple[torch.Tensor, ...]:
    """Blobs of all classes over a noisy road; heat and offsets of any kind."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    coarse = noise(1, len(CITYSCAPES20), 6, 12)
    logits = torch.nn.functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bilinear")
    logits[:, ROAD, HEIGHT // 2 :] += 1.0
    heat = noise(1, 1, HEIGHT, WIDTH).sigmoid()
    offset = 6 * noise(1, 2, HEIGHT, WIDTH)
    if case == "ties":
        heat, offset = (heat * 4).round() / 4, offset.round() / 2
    elif case == "far":
        offset *= 10.0 ** torch.arange(HEIGHT).remainder(9)[:, None]
    elif case == "no centers":
        heat *= 0.1
    elif case == "no things":
        logits[:, list(THINGS)] -= 100.0
    elif case == "no road":
        logits[:, ROAD] -= 100.0
    focal = 1.1 * WIDTH
    down = (torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH) - HEIGHT / 2) / focal
    inverse = (down / 0.7).clamp(min=0.01)[None, None]
    if case not in ("no road", "wall"):
        inverse = inverse * (1 + 0.05 * noise(1, 1, HEIGHT, WIDTH))
    if case == "wall":
        logits[:, ROAD] -= 100.0
        inverse = torch.full_like(inverse, 0.1)
    K = torch.tensor([[[focal, 0, WIDTH / 2 - 3], [0, focal, HEIGHT / 2 + 1], [0, 0, 1]]])
    return logits, heat, offset, inverse, K, torch.tensor([1.4]), torch.tensor([0.01])


CASES = ("plain", "ties", "far", "no centers", "no things", "no road", "wall")


@pytest.mark.parametrize("case", CASES)
def test_it_is_the_functions_one_after_the_other(case):
    logits, heat, offset, inverse, K, camera_height, pitch = given = inputs(0, case)
    result = finish()(*given)
    panoptic = grouping.panoptic(logits, heat, offset, THINGS, SETTINGS)
    assert result["panoptic"].dtype == torch.int32
    assert torch.equal(result["panoptic"].long(), panoptic)

    depth = geometry.depth_from_inverse(inverse)
    classes = logits.argmax(1)
    factor, source = dgc_scale(depth, K, camera_height, classes == ROAD, pitch_rad_B=pitch)
    assert source.item() == {"no road": scale.NORMALS, "wall": scale.FAILED}.get(case, scale.ROAD)
    depth_m = depth * factor[:, None, None, None]
    torch.testing.assert_close(result["depth_m"], depth_m, equal_nan=True, rtol=0, atol=0)

    points = geometry.back_project(depth_m, K)
    points[((classes == EGO) | (classes == SKY))[:, None].expand_as(points)] = math.nan
    torch.testing.assert_close(result["points"], points, equal_nan=True)
    assert result["points"].isnan().all() == (case == "wall")


def test_classes_do_for_logits():
    logits, *rest = inputs(1)
    expected = finish()(logits, *rest)
    for classes in (logits.argmax(1), logits.argmax(1).int()):
        result = finish()(classes, *rest)
        assert all(torch.equal(result[k].nan_to_num(), expected[k].nan_to_num()) for k in expected)


def test_each_task_alone():
    given = inputs(2)
    both = finish()(*given)
    alone = finish()(*given[:3], *[None] * 4)
    assert set(alone) == {"panoptic"}
    assert torch.equal(alone["panoptic"], both["panoptic"])
    depth = finish()(None, None, None, *given[3:])
    assert set(depth) == {"depth_m", "points"}
    assert depth["points"].isfinite().all()
    level = finish()(None, None, None, *given[3:6], torch.zeros(1))
    assert not torch.equal(level["depth_m"], depth["depth_m"])


# --- exported -------------------------------------------------------------------------------------


def export(path, given):
    """Inputs that are None are not inputs of the graph."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxscript")
    names = [name for name, value in zip(NAMES, given, strict=True) if value is not None]
    torch.onnx.export(
        finish(),
        given,
        path,
        dynamo=True,
        opset_version=18,
        input_names=names,
        verbose=False,
        external_data=False,
    )
    onnx.checker.check_model(onnx.load(path), full_check=True)
    return path


def onnxruntime_session(path):
    ort = pytest.importorskip("onnxruntime")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]
    return lambda given: session.run(None, dict(zip(names, given, strict=True)))


def openvino_model(path):
    openvino = pytest.importorskip("openvino")
    options = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    compiled = openvino.Core().compile_model(path, "CPU", options)
    return lambda given: list(compiled(list(given)).values())


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    return export(tmp_path_factory.mktemp("graph") / "both.onnx", inputs(0))


def same(run, given):
    expected = finish()(*given)
    results = run([value.numpy() for value in given if value is not None])
    for (name, value), result in zip(expected.items(), results, strict=True):
        if name == "panoptic":
            assert result.dtype == np.int32
            np.testing.assert_array_equal(result, value.numpy())
        else:
            np.testing.assert_allclose(result, value.numpy(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("open_graph", [onnxruntime_session, openvino_model])
def test_a_graph_gives_what_eager_gives(graph, open_graph):
    run = open_graph(graph)
    for case in CASES:
        for seed in range(3):
            same(run, inputs(seed, case))


@pytest.mark.parametrize("task", [pytest.param("panoptic", marks=pytest.mark.slow), "depth"])
def test_a_graph_of_one_task(tmp_path, task):
    def of_task(case):
        given = inputs(0, case)
        keep = range(3) if task == "panoptic" else range(3, 7)
        return tuple(value if i in keep else None for i, value in enumerate(given))

    path = export(tmp_path / "one.onnx", of_task("plain"))
    for open_graph in (onnxruntime_session, openvino_model):
        run = open_graph(path)
        for case in CASES:
            same(run, of_task(case))
