"""Engines: the same maps as the plain network's, said before a time; and a row whatever happens."""

import importlib.util
import itertools
import math
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from small_networks import SIZE, images, model, subject
from torch import Tensor, nn

from mtl_bench.bench import stored
from mtl_bench.core.engine import Setting
from mtl_bench.core.recipe import Recipe
from mtl_bench.data import scenes as synthetic
from mtl_bench.data.samples import open_samples
from mtl_bench.deploy import agreement, engines, roofline, timer
from mtl_bench.deploy import subject as subjects
from mtl_bench.deploy.graph import NORM, Body, Upsample, fold, strided
from mtl_bench.deploy.maps import Maps, infos

CPU = torch.device("cpu")
TASKS = Recipe.tasks
CLASSES = "panoptic.semantic.class"
MAPS = ("panoptic.semantic", "panoptic.center", "panoptic.offset", "depth.inverse")
PLAN = timer.Plan(passes=4, seconds=None, batch=2, threads=1, compared=2)
Eager = engines.load("eager")
HERE = [n for n in engines.names() if n != "tensorrt" and engines.available(n) is None]


def setting(precision: str = "fp32", batch: int = 1) -> Setting:
    return Setting(batch, *SIZE, precision, CPU, 1)


# --- folding --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "backbone", ["tiny", "resnet18", "mobilenetv3", "mnasnet", "efficientnet_lite0"]
)
def test_folding_leaves_no_norm_and_changes_nothing(backbone):
    body = Body(model(backbone).net)
    x_B3HW = torch.randn(1, 3, *SIZE)
    with torch.no_grad():
        expected = body(x_B3HW)
        folded = fold(body, x_B3HW)
        assert not [node for node in folded.graph.nodes if node.target is NORM]
        for a, b in zip(folded(x_B3HW), expected, strict=True):
            assert (a - b).abs().max() <= 1e-5 * b.abs().max()


def test_folding_takes_a_convolutions_bias_in():
    module = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4)).eval()
    module[1].running_mean.normal_()
    x_B3HW = torch.randn(2, 3, 8, 8)
    assert torch.allclose(fold(module, x_B3HW)(x_B3HW), module(x_B3HW), atol=1e-6)


def test_a_convolution_that_others_read_is_not_folded():
    class Twice(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv, self.norm = nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4)
            self.norm.running_mean.fill_(1)

        def forward(self, x: Tensor) -> Tensor:
            raw = self.conv(x)
            return self.norm(raw) + raw

    module = Twice().eval()
    x_B3HW = torch.randn(1, 3, 8, 8)
    assert torch.allclose(fold(module, x_B3HW)(x_B3HW), module(x_B3HW), atol=1e-6)


def test_a_lower_precision_leaves_the_network_as_it_is():
    net = model().net
    before = {name: value.clone() for name, value in net.state_dict().items()}
    strided(net, (1, *SIZE), torch.bfloat16)
    for name, value in net.state_dict().items():
        assert value.dtype == before[name].dtype
        assert torch.equal(value, before[name]), name


# --- classes of the full size ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("small", "large"),
    [((8, 16), (64, 128)), ((5, 7), (33, 50)), ((2, 2), (9, 2)), ((16, 16), (16, 16))],
)
def test_classes_are_those_of_the_interpolated_logits(small, large):
    torch.manual_seed(0)
    logits_BChw = torch.randn(3, 6, *small)
    upsample = Upsample(small, large, CPU)
    expected = F.interpolate(logits_BChw, large, mode="bilinear", align_corners=True).argmax(1)
    assert torch.equal(upsample.classes(logits_BChw), expected)


def test_a_class_that_is_second_at_all_corners_can_be_first_between():
    logits_1Chw = torch.tensor([[[[9.0, 0], [9, 0]], [[0, 9], [0, 9]], [[6, 6], [6, 6]]]])
    found = Upsample((2, 2), (4, 9), CPU).classes(logits_1Chw)
    assert found[0, 0].tolist() == [0, 0, 0, 2, 2, 2, 1, 1, 1]


def test_chunks_leave_no_trace(monkeypatch):
    torch.manual_seed(0)
    logits_1Chw = torch.randn(1, 20, 8, 16)
    whole = Upsample((8, 16), SIZE, CPU).classes(logits_1Chw)
    monkeypatch.setattr("mtl_bench.deploy.graph.CHUNK", 1)
    assert torch.equal(Upsample((8, 16), SIZE, CPU).classes(logits_1Chw), whole)


# --- engines --------------------------------------------------------------------------------------


AGREE = [(n, TASKS) for n in HERE if n != "compile"]
AGREE += [("plain", ("depth",)), ("eager", ("depth",)), ("eager", ("panoptic",))]


@pytest.mark.parametrize(("name", "tasks"), AGREE)
def test_an_engine_agrees_with_plain(name, tasks):
    what = subject("resnet18" if tasks == TASKS else "tiny", tasks)
    with torch.inference_mode():
        found = timer.compare(what, timer.make(what, name, setting()), images=2)
    assert found.wrong("fp32") == ""
    assert ("agreement.panoptic_equal" in found.values()) == ("panoptic" in tasks)
    assert ("agreement.depth_median_rel" in found.values()) == ("depth" in tasks)


@pytest.mark.slow
@pytest.mark.skipif("compile" not in HERE, reason="no C++ compiler")
def test_compile_agrees_with_plain():
    with torch.inference_mode():
        found = timer.compare(subject(), timer.make(subject(), "compile", setting()), images=2)
    assert found.wrong("fp32") == ""


@pytest.mark.parametrize("name", ["plain", "eager"])
def test_a_batch_is_its_images(name):
    what = subject()
    with torch.inference_mode():
        one, two = (timer.make(what, name, setting(batch=n)) for n in (1, 2))
        batch = two.run(two.transfer(torch.cat(what.images[:2])))
        for number, image in enumerate(what.images[:2]):
            single = one.run(one.transfer(image))
            assert torch.equal(batch[CLASSES][number], single[CLASSES][0])
            assert torch.allclose(
                batch["depth.inverse"][number], single["depth.inverse"][0], atol=1e-4
            )


def test_bf16_is_another_precision():
    what = subject("resnet18")
    with torch.inference_mode():
        found = timer.compare(what, timer.make(what, "eager", setting("bf16")))
    assert found.values()["agreement.logits_max"] > 1e-3


def test_openvino_computes_in_float32_where_fp32_was_asked_for():
    pytest.importorskip("openvino")
    what = subject("resnet18")
    with torch.inference_mode():
        found = timer.compare(what, timer.make(what, "openvino", setting()))
    assert found.values()["agreement.logits_max"] < 1e-3  # bf16, its default on AMX: 0.01


def int8(examples: list[Tensor]) -> agreement.Agreement:
    what = replace(subject("resnet18"), examples=examples)
    with torch.inference_mode():
        return timer.compare(what, timer.make(what, "openvino", setting("int8")))


def test_int8_takes_its_ranges_from_the_examples():
    pytest.importorskip("nncf")
    found = int8(images(3))
    assert found.wrong("int8", trained=False) == ""
    assert found.maps_rms > 1e-3  # float32: 1e-5
    black = int8([torch.zeros_like(image) for image in images(3)])
    assert "of their deviation" in black.wrong("int8", trained=False)


def test_int8_without_a_batch_of_examples_is_refused():
    pytest.importorskip("nncf")
    row = timer.row(subject(), "openvino", "int8", CPU, PLAN)
    assert row["status"] == "failed"
    assert "int8 needs 1 images of the training split or more, and there are 0" in row["why"]


def test_examples_are_of_the_training_split():
    cell, weights = subjects.untrained("tiny", "smoke", TASKS)
    data = cell.recipe.data
    root = synthetic.ensure(data)
    size = data.height, data.width
    what = subjects.subject(cell, weights, size, root, CPU, False, images=2, examples=3)
    train = open_samples(cell.recipe, (), "train", root, training=False)
    assert len(what.examples) == 3
    for number, example_1HW3 in enumerate(what.examples):
        expected_3HW = (train.sample(number, None).image_B3HW * 255).round()
        assert torch.equal(example_1HW3[0].permute(2, 0, 1).float(), expected_3HW.float())


def test_a_precision_that_an_engine_lacks_says_what_it_has():
    with pytest.raises(ValueError, match=r"onnxruntime has no bf16 on cpu: it has fp32 on cpu"):
        engines.check("onnxruntime", "bf16", "cpu")
    with pytest.raises(ValueError, match=r"no engine called 'openvin' \(did you mean 'openvino'"):
        engines.check("openvin", "fp32", "cpu")


# --- agreement ------------------------------------------------------------------------------------


class Wrong(Eager):
    """Fast and wrong: what it says of one map is changed."""

    change = ("depth.inverse", 1.01)

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        maps = super().strided(image)
        name, factor = self.change
        return maps | {name: maps[name] * factor}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("depth.inverse", 1.01), "median relative depth difference 0.0099 .limit 0.001."),
        (("depth.inverse", float("nan")), "depth difference inf"),
        (("panoptic.offset", 1.01), "maps 0.0[0-9]+ of their deviation .limit 0.001."),
        (("panoptic.semantic", float("nan")), "not finite"),
    ],
)
def test_a_wrong_engine_is_caught_and_not_timed(monkeypatch, change, why):
    monkeypatch.setattr(Wrong, "change", change)
    monkeypatch.setattr(engines, "load", lambda name, load=engines.load: _wrong(name, load))
    row = timer.row(subject(), "eager", "fp32", CPU, PLAN)
    assert row["status"] == "wrong"
    assert re.search(why, row["why"]), row["why"]
    assert not [key for key in row["metric"] if key.startswith("latency.")]


def _wrong(name, load):
    return Wrong if name == "eager" else load(name)


def test_instances_are_compared_by_what_they_cover():
    a = torch.tensor([[[1000, 1001, 1001, 2001], [1000, 1002, 1002, 2001]]])
    assert agreement.equal_share(a, a) == 1
    renumbered = a.clone()
    renumbered[a == 1001], renumbered[a == 1002] = 1005, 1001
    assert agreement.equal_share(a, renumbered) == 1
    merged = torch.where(a == 1002, 1001, a)
    assert agreement.equal_share(a, merged) < 1
    other_class = torch.where(a == 2001, 3001, a)
    assert agreement.equal_share(a, other_class) == 0.75


def test_agreement_of_known_differences():
    depth = torch.tensor([[[[1.0, 2], [4, 8]]]])
    panoptic = torch.tensor([[[1000, 1000], [1000, 2000]]])
    maps = torch.tensor([[[[1.0, 2], [4, 8]]]])

    def pass_of(logits: Tensor, panoptic: Tensor, depth: Tensor) -> tuple[Maps, dict[str, Maps]]:
        offset = maps.expand(1, 2, 2, 2)
        found = dict(zip(MAPS, (logits, maps, offset, 1 / depth), strict=True))
        return found, {"panoptic": {"panoptic": panoptic}}

    found = agreement.Agreement(infos(subject().tasks))
    other = depth * torch.tensor([1, 1, 1, 1.5]).view(2, 2)
    found.update(
        pass_of(maps, panoptic, depth), pass_of(maps + 0.5, torch.full_like(panoptic, 1000), other)
    )
    assert found.values() == {
        "agreement.logits_max": 0.5,
        "agreement.panoptic_equal": 0.75,
        "agreement.depth_median_rel": 0,
        "agreement.depth_max_rel": 0.5,
    }
    assert found.wrong("fp32") == "75.00 % equal panoptic pixels (limit 99.9 %)"
    deviations = 0.5 / maps.std()
    expected = f"maps {deviations:.2g} of their deviation (limit 0.001)"
    assert found.wrong("fp32", trained=False) == expected


@pytest.mark.parametrize("precision", agreement.RANDOM)
def test_one_far_value_is_no_wrong_engine_but_many_near_ones_are(precision):
    generator = torch.Generator().manual_seed(0)
    maps = torch.randn(1, 2, 100, 100, generator=generator)

    def judged(other: Tensor) -> str:
        found = agreement.Agreement(infos(subject("tiny", ("panoptic",)).tasks))
        passes = [
            (
                dict(zip(MAPS[:3], (it, it[:, :1], it), strict=True)),
                {"panoptic": {"panoptic": torch.zeros(1, 100, 100)}},
            )
            for it in (maps, other)
        ]
        found.update(*passes)
        return found.wrong(precision, trained=False)

    limit = agreement.RANDOM[precision]
    far = maps.clone()
    far[0, 0, 0, 0] += 50 * limit
    assert judged(far) == ""
    assert judged(maps + 0.5 * limit) == ""
    assert "of their deviation" in judged(maps + 2 * limit)
    far[0, 0, 0, 0] = math.nan
    assert "of their deviation" in judged(far)


# --- rows -----------------------------------------------------------------------------------------

KEYS = (
    *("mean_ms", "std_ms", "p50_ms", "p95_ms", "p99_ms", "fps"),
    *("transfer_ms", "network_ms", "postprocess_ms", "passes", "warmup", "images", "threads"),
    *("device", "precision", "spread", "drift", "noisy", "params_m", "gmacs", "network_mb"),
    *("throughput_fps", "throughput_batch"),
)


def test_a_row_says_everything_and_its_stages_add_up():
    row = timer.row(subject(), "eager", "fp32", CPU, PLAN)
    assert (row["status"], row["why"], row["weights"]) == ("done", "", "random")
    assert (row["height"], row["width"], row["backbone"]) == (*SIZE, "tiny")
    metric = row["metric"]
    assert {f"latency.{key}" for key in KEYS} == {k for k in metric if k.startswith("latency.")}
    assert metric["latency.passes"] == 4
    assert metric["latency.images"] == 3
    assert metric["latency.throughput_batch"] == 2
    assert type(metric["latency.noisy"]) is bool
    stages = [metric[f"latency.{name}_ms"] for name in ("transfer", "network", "postprocess")]
    assert sum(stages) == pytest.approx(metric["latency.mean_ms"], rel=1e-9)
    assert 0 < metric["roofline.share"] < 1
    assert "torch" in row["env"]


def test_an_engine_that_is_not_there_has_a_row_that_says_how_to_install_it(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "openvino" else find(name)
    )
    row = timer.row(subject(), "openvino", "fp32", CPU, PLAN)
    assert row["status"] == "unavailable"
    assert row["why"].endswith("pip install 'mtl-bench[onnx,openvino]'")
    assert row["metric"] == {}


def test_an_engine_that_breaks_has_a_row_that_says_why(monkeypatch):
    def broken(*args):
        raise RuntimeError("no such\nkernel")

    monkeypatch.setattr(Eager, "strided", broken)
    row = timer.row(subject(), "eager", "fp32", CPU, PLAN)
    assert (row["status"], row["why"]) == ("failed", "RuntimeError: no such kernel")


@pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without CUDA")
def test_tensorrt_says_what_it_lacks():
    row = timer.row(subject(), "tensorrt", "fp16", CPU, PLAN)
    assert row["status"] == "unavailable"
    assert "tensorrt" in row["why"] or "CUDA" in row["why"]


# --- the protocol ---------------------------------------------------------------------------------


def clocked(monkeypatch, times_ms: list[float]) -> list:
    """Stages of which only the second takes time: each pass the next of these."""
    clock, queue = {"s": 0.0}, iter(times_ms)
    monkeypatch.setattr(timer.time, "perf_counter", lambda: clock["s"])

    def work(value):
        clock["s"] += next(queue) / 1000
        return value

    return [lambda value: value, work, lambda value: value]


def test_warm_up_ends_when_times_stop_falling(monkeypatch):
    falling = [100.0 - 3 * n for n in range(20)]
    stages = clocked(monkeypatch, falling + [40.0] * 50)
    passes = timer.warm_up(stages, itertools.cycle(images(1)), CPU, None)
    assert 22 <= passes <= 20 + 2 * timer.WINDOW


def test_warm_up_has_a_cap_and_a_share_of_the_time_limit(monkeypatch):
    stages = clocked(monkeypatch, [1000.0 * 0.9**n for n in range(100)])
    assert timer.warm_up(stages, itertools.cycle(images(1)), CPU, None) == timer.WARMUP
    stages = clocked(monkeypatch, [1000.0] * 100)
    assert timer.warm_up(stages, itertools.cycle(images(1)), CPU, 6.5) == 3


def test_the_time_limit_leaves_a_least_number_of_passes(monkeypatch):
    stages = clocked(monkeypatch, [1000.0] * 100)
    plan = timer.Plan(passes=90, seconds=5)
    ms = timer.time_passes(stages, itertools.cycle(images(1)), CPU, plan)
    assert len(ms) == timer.LEAST
    stages = clocked(monkeypatch, [100.0] * 100)
    ms = timer.time_passes(stages, itertools.cycle(images(1)), CPU, plan)
    assert len(ms) == 51  # the one that passes the limit is kept


def test_noise_is_said():
    steady = np.array([[0, 100.0 + n % 3, 0] for n in range(40)])
    assert timer.spread(steady) == {"spread": pytest.approx(0.02, abs=0.01), "noisy": False}
    slower = np.array([[0, 100.0 + n / 4, 0] for n in range(40)])
    assert timer.spread(slower)["noisy"]  # by its drift
    wild = np.array([[0, 100.0 + 50 * (n % 2), 0] for n in range(40)])
    assert timer.spread(wild)["noisy"]  # by its spread


def test_work_of_a_network_is_that_of_its_convolutions(monkeypatch):
    class Net(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv, self.unused = nn.Conv2d(3, 5, 3, padding=1, bias=False), nn.Conv2d(3, 9, 1)

        def forward(self, x: Tensor) -> Tensor:
            return self.conv(x).relu()

    net = Net()
    monkeypatch.setattr(roofline, "Body", lambda net: net)
    with torch.inference_mode():
        found = roofline.work(net, (1, 8, 16), "bf16")
    assert found["params_m"] == pytest.approx(135e-6)
    assert found["gmacs"] == pytest.approx(135 * 128 / 1e9)
    assert found["network_mb"] == pytest.approx(2 * (3 * 128 + 135 + 5 * 128) / 1e6)
    assert roofline.share({"gmacs": 1, "network_mb": 1}, 100, 1, 40) == pytest.approx(0.5)
    assert roofline.share({"gmacs": 0.1, "network_mb": 20}, 100, 1, 40) == pytest.approx(0.5)


def test_the_peak_is_the_fastest_of_products_and_a_convolution(monkeypatch):
    product, convolution = 2 * 2048**3, 2 * 9 * 512 * 512 * 32 * 64
    for seconds, flops in (
        ((1.0, 1.0, 1.0, 0.1, 2.0), 10 * convolution),
        ((1.0, 1.0, 1.0, 1.0, 2.0), product),
        ((1.0, 0.1, 1.0, 1.0, 2.0), 10 * 2 * 1536**3),
    ):
        taken = iter(seconds)
        monkeypatch.setattr(roofline, "_fastest", lambda run, device, taken=taken: next(taken))
        peaks = roofline.peaks(CPU, "fp32")
        assert peaks == pytest.approx((flops / 1e9, 2**26 * 4 / 1e9))


def test_the_peak_in_int8_is_that_of_a_product(monkeypatch):
    monkeypatch.setattr(roofline, "MATMUL", {"cpu": (64,)})

    def once(run, device):
        run()
        return 1.0

    monkeypatch.setattr(roofline, "_fastest", once)
    assert roofline.peaks(CPU, "int8")[0] == pytest.approx(2 * 64**3 / 1e9)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network that has learned something: a sixth of the built-in recipe."""
    runs = tmp_path_factory.mktemp("runs")
    words = ["train", "--backbone", "resnet18", "--method", "fixed", "--runs", runs]
    words += ["--set", "recipe.optim.steps=300"]
    subprocess.run([sys.executable, "-m", "mtl_bench", *map(str, words)], check=True)
    (path,) = runs.glob("*/last.pt")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_trained_weights_over_the_val_split(name, trained):
    """Acceptance: 20 frames of the built-in val split, at the size that the network learned."""
    cell, weights = stored.deployed(trained, None)
    root = synthetic.ensure(cell.recipe.data)
    what = subjects.subject(cell, weights, SIZE, root, CPU, True, images=20)
    with torch.inference_mode():
        result = timer.compare(what, timer.make(what, name, setting()), 20)
    assert result.wrong("fp32") == ""


@pytest.mark.slow
def test_int8_of_trained_weights(trained):
    pytest.importorskip("nncf")
    cell, weights = stored.deployed(trained, None)
    root = synthetic.ensure(cell.recipe.data)
    what = subjects.subject(cell, weights, SIZE, root, CPU, True, images=20, examples=16)
    with torch.inference_mode():
        result = timer.compare(what, timer.make(what, "openvino", setting("int8")), 20)
    assert result.wrong("int8") == ""
