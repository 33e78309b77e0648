"""The timing protocol on a small network whose costs are known by hand."""

import dataclasses
import itertools

import pytest
import torch
from torch import Tensor, nn

from mtl_bench.core import config
from mtl_bench.core.batch import Batch, Camera
from mtl_bench.core.task import tasks_of
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.deploy import roofline, timer
from mtl_bench.deploy.subject import prepare
from mtl_bench.model import Outputs
from mtl_bench.tasks import depth
from mtl_bench.tasks.panoptic import grouping

CLASSES = len(CITYSCAPES20)
HEIGHT, WIDTH = 32, 64
K_33 = torch.tensor([[57.6, 0, 31.5], [0, 57.6, 15.5], [0, 0, 1]])
CAMERA = Camera(K_33[None], torch.tensor([1.4]), torch.tensor([0.02]))
RECIPE = config.Recipe()
TIMING = config.Latency(passes=8, warmup=2)


class FakeNet(nn.Module):
    """One 3x3 convolution without bias; an auxiliary head that evaluation mode does not run."""

    def __init__(self, tasks: tuple[str, ...]) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.tasks = tasks
        self.conv = nn.Conv2d(3, CLASSES + 4, 3, padding=1, bias=False)
        self.auxiliary = nn.Conv2d(3, 1, 1)
        self.seen: list[Tensor] = []

    def forward(self, image_B3HW: Tensor) -> Outputs:
        self.seen.append(image_B3HW)
        maps = self.conv(image_B3HW)
        instances = {
            "semantic": maps[:, :CLASSES],
            "center": maps[:, CLASSES : CLASSES + 1].sigmoid(),
            "offset": maps[:, CLASSES + 1 : CLASSES + 3],
        }
        inverse = {"inverse": maps[:, -1:].sigmoid() * 2}
        if self.training:
            inverse["inverse.1"] = self.auxiliary(image_B3HW)
        found = {"panoptic": instances, "depth": inverse}
        return Outputs({name: found[name] for name in self.tasks})


class FakeModel(nn.Module):
    def __init__(self, tasks: tuple[str, ...] = RECIPE.tasks, labels=CITYSCAPES20) -> None:
        super().__init__()
        self.net = FakeNet(tasks)
        self.tasks = tasks_of(RECIPE, tasks, labels)
        self.pose = nn.Linear(1000, 1000)


def images(count: int, height: int = HEIGHT, width: int = WIDTH) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(3, height, width, generator=generator) for _ in range(count)]


def measure(
    model: nn.Module | None = None,
    timing: config.Latency = TIMING,
    given=None,
    device="cpu",
    **kwargs,
):
    return timer.measure(
        FakeModel() if model is None else model,
        images(4) if given is None else given,
        CAMERA,
        timing,
        device,
        **kwargs,
    )


def test_keys_and_what_was_measured():
    result = measure()
    expected = {"passes": 8, "warmup": 2, "images": 4, "height": HEIGHT, "width": WIDTH}
    assert {key: result[f"latency.{key}"] for key in expected} == expected
    assert result["latency.precision"] == "fp32"
    assert result["latency.threads"] == torch.get_num_threads()
    assert result["latency.device"]
    assert result["latency.clock"] == "time.perf_counter"


def test_stages_add_up_and_percentiles_are_ordered():
    result = measure()
    stages = sum(result[f"latency.{name}_ms"] for name in timer.STAGES)
    assert stages == pytest.approx(result["latency.mean_ms"], rel=1e-9)
    assert result["latency.fps"] == pytest.approx(1000 / result["latency.mean_ms"])
    assert 0 < result["latency.p50_ms"] <= result["latency.p95_ms"] <= result["latency.p99_ms"]


def test_each_time_goes_to_its_stage(monkeypatch):
    """A clock that only the test moves: transfer 1 ms, network 10 ms, post-processing 5 ms."""
    clock = {"s": 0.0}
    monkeypatch.setattr(timer.time, "perf_counter", lambda: clock["s"])

    def costing(ms: float):
        def stage(value):
            clock["s"] += ms / 1000
            return value

        return stage

    stages = [costing(1), costing(10), costing(5)]
    times = timer.time_pass(stages, torch.zeros(1), torch.device("cpu"))
    assert times == pytest.approx([1, 10, 5])


def test_statistics_of_known_times():
    total = [10.0, 10, 10, 10, 10, 10, 15, 15]  # the last quarter is half as slow again
    result = timer.statistics(timer.np.array([[1, t - 3, 2] for t in total]))
    assert result["mean_ms"] == pytest.approx(11.25)
    assert result["fps"] == pytest.approx(1000 / 11.25)
    assert result["p50_ms"] == pytest.approx(10)
    assert result["drift"] == pytest.approx(0.5)
    assert result["std_ms"] == pytest.approx(torch.tensor(total).std().item())
    assert result["transfer_ms"] == pytest.approx(1)
    assert result["network_ms"] == pytest.approx(8.25)


def test_parameters_and_multiply_adds_are_those_of_inference():
    result = measure()
    weights = (CLASSES + 4) * 3 * 9
    assert result["latency.params_m"] == pytest.approx(weights / 1e6)  # no pose, no auxiliary head
    assert result["latency.gmacs"] == pytest.approx(weights * HEIGHT * WIDTH / 1e9)


def test_peak_memory_counts_what_is_alive_at_once():
    """1 MiB in; doubled (2 alive), cut to a quarter (the sum is freed), then 1 MiB more."""

    def first(host: Tensor) -> Tensor:
        return host * 2  # 1 MiB

    def second(value: Tensor) -> Tensor:
        wide = torch.cat([value, value])  # + 2 MiB
        return wide[: len(wide) // 4].clone()  # + 0.5 MiB, at most 3.5; then `wide` goes

    def third(value: Tensor) -> Tensor:
        view = value.view(-1, 2)  # nothing new
        view.add_(1)
        return view

    host = torch.ones(roofline.MIB // 4)
    with torch.no_grad():
        peak, kind = roofline.peak([first, second, third], host, torch.device("cpu"))
    assert peak == int(3.5 * roofline.MIB)
    assert "alive" in kind


def test_peak_includes_weights_and_grows_with_the_image():
    model = FakeModel(("depth",))  # grouping depends on what is seen, depth on the size alone
    small = measure(model)
    large = measure(model, dataclasses.replace(TIMING, height=2 * HEIGHT, width=2 * WIDTH))
    weights_mib = (CLASSES + 4) * 3 * 9 * 4 / roofline.MIB
    maps_mib = (CLASSES + 4) * HEIGHT * WIDTH * 4 / roofline.MIB
    assert small["latency.peak_mib"] > weights_mib + maps_mib
    # four times the maps; the depth's scale looks at a number of pixels that does not grow
    assert large["latency.peak_mib"] > 2 * small["latency.peak_mib"]


def test_distinct_images_reach_the_network_as_they_are():
    model = FakeModel()
    given = images(20)
    measure(model, given=given)
    timed = model.net.seen[-TIMING.passes :]
    for a, b in itertools.combinations(timed, 2):
        assert not torch.equal(a, b)
    expected = (given[TIMING.warmup % TIMING.passes] * 255).round() / 255
    assert torch.allclose(timed[0][0], expected)


@pytest.mark.parametrize("kind", ["uint8", "float", "batch"])
def test_every_form_of_image_is_the_same_image(kind):
    image = (images(1)[0] * 255).round()
    forms = {
        "uint8": image.to(torch.uint8),
        "float": image / 255,
        "batch": Batch(["a"], image[None] / 255, CAMERA),
    }
    model = FakeModel()
    measure(model, given=[forms[kind]])
    assert torch.allclose(model.net.seen[-1][0], image / 255)


def test_another_size_scales_image_and_intrinsics():
    timing = dataclasses.replace(TIMING, height=64, width=96)
    model = FakeModel()
    result = measure(model, timing)
    assert (result["latency.height"], result["latency.width"]) == (64, 96)
    assert model.net.seen[-1].shape == (1, 3, 64, 96)
    _, K_133 = prepare(images(1), K_33, timing, pin=False)
    assert K_133[0, 0].tolist() == pytest.approx([57.6 * 1.5, 0, 47.5])
    assert K_133[0, 1].tolist() == pytest.approx([0, 57.6 * 2, 31.5])


@pytest.mark.parametrize("tasks", [("panoptic",), ("depth",), ("panoptic", "depth")])
def test_only_the_tasks_present_are_finished(tasks, monkeypatch):
    calls = []
    for module, name in ((grouping, "group"), (depth, "dgc_scale")):
        function = getattr(module, name)

        def spy(*args, name=name, function=function, **kwargs):
            calls.append(name)
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, spy)
    result = measure(FakeModel(tasks))
    assert ("group" in calls) == ("panoptic" in tasks)
    assert ("dgc_scale" in calls) == ("depth" in tasks)
    assert result["latency.postprocess_ms"] > 0


@pytest.mark.parametrize("labels", [CITYSCAPES20, CITYSCAPES19], ids=["20 classes", "19 classes"])
def test_depth_is_scaled_from_the_road_and_the_calibrated_pitch(monkeypatch, labels):
    """Of data sets without the ego vehicle, too, whose road is class 0."""
    seen = []
    function = depth.dgc_scale

    def spy(depth_m, K, height, road, pitch_rad_B):
        seen.append((road, pitch_rad_B))
        return function(depth_m, K, height, road, pitch_rad_B=pitch_rad_B)

    monkeypatch.setattr(depth, "dgc_scale", spy)
    model = FakeModel(labels=labels)
    measure(model)
    road_BHW, pitch_rad_B = seen[-1]
    assert pitch_rad_B.tolist() == pytest.approx([0.02])
    with torch.inference_mode():
        logits = model.net.conv(model.net.seen[-1])[:, :CLASSES]
    assert torch.equal(road_BHW, logits.argmax(1) == labels.index("road"))


def test_the_model_keeps_its_mode_and_weights():
    model = FakeModel().train()
    before = model.net.conv.weight.detach().clone()
    measure(model)
    assert model.training
    assert model.net.training
    assert torch.equal(model.net.conv.weight, before)
    assert model.net.conv.weight.grad is None


def test_reduced_precision_runs_the_network_under_autocast():
    model = FakeModel()
    seen = []
    model.net.conv.register_forward_hook(lambda module, args, out: seen.append(out.dtype))
    assert measure(model, precision="bf16")["latency.precision"] == "bf16"
    assert seen[-1] == torch.bfloat16


def test_nothing_to_time_is_an_error():
    with pytest.raises(ValueError, match="no images"):
        measure(given=[])


@pytest.mark.cuda
def test_cuda_events_time_the_same_stages(device):
    result = timer.measure(FakeModel().to(device), images(4), CAMERA, TIMING, device)
    clock = "CUDA events" if device.type == "cuda" else "time.perf_counter"  # in a rehearsal
    assert result["latency.clock"] == clock
    assert result["latency.network_ms"] > 0
    stages = sum(result[f"latency.{name}_ms"] for name in timer.STAGES)
    assert stages == pytest.approx(result["latency.mean_ms"], rel=1e-6)
