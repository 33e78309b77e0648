"""Depth protocols: which pixels, which scaling, which passes, and errors that are known by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from mtl_bench.core import config
from mtl_bench.core.batch import Batch, Camera, collate
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import scenes as synthetic
from mtl_bench.data.kitti import Kitti
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate import walk as walks
from mtl_bench.evaluate.walk import Walk, evaluate, measure, predict
from mtl_bench.model import Outputs
from mtl_bench.tasks.depth import FLIP, DepthMetric, protocols
from mtl_bench.tasks.depth.metrics import NAMES, evaluation_mask
from mtl_bench.tasks.depth.protocols import NAMED, Protocol
from mtl_bench.tasks.depth.scale import ROAD

CPU = torch.device("cpu")
KITTI_FRAME, CITYSCAPES_FRAME = (375, 1242), (1024, 2048)
PIXELS = {  # rows and columns, as the protocols' sources have them
    "full-frame": (CITYSCAPES_FRAME, (0, 1024, 0, 2048)),
    "manydepth-crop": (CITYSCAPES_FRAME, (256, 768, 192, 1856)),
    "eigen-improved": (KITTI_FRAME, (0, 375, 0, 1242)),
    "eigen-improved-crop": (KITTI_FRAME, (153, 371, 44, 1197)),
    "eigen-raw": (KITTI_FRAME, (153, 371, 44, 1197)),
}


def cell_of(dataset, *, tasks=("depth",), **evaluation) -> Cell:
    recipe = load_recipe("smoke")
    recipe = replace(
        recipe,
        data=replace(recipe.data, dataset=dataset),
        evaluate=replace(recipe.evaluate, **evaluation),
    )
    return Cell(recipe, "none", "none", tasks)


# --- pixels and errors ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMED)
def test_exactly_the_documented_pixels_count(name):
    size, (top, bottom, left, right) = PIXELS[name]
    expected = np.zeros(size, bool)
    expected[top:bottom, left:right] = True
    assert (evaluation_mask(np.full(size, 5.0), NAMED[name]) == expected).all()
    assert not evaluation_mask(np.full(size, 80.0), NAMED[name]).any()
    assert not evaluation_mask(np.full(size, 0.001), NAMED[name]).any()


def test_crops_scale_with_the_frame():
    mask = evaluation_mask(np.full((64, 128), 5.0), NAMED["manydepth-crop"])
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (16, 47, 12, 115)


def truth_and_weights(name):
    """Columns of 10, 20 and 40 m in turn, and which share of the counted pixels has which."""
    size, (_, _, left, right) = PIXELS[name]
    true_m = np.zeros(size, np.float32)
    true_m[:] = np.array([10, 20, 40])[np.arange(size[1]) % 3]
    counts = np.bincount(np.arange(left, right) % 3)
    return true_m, counts / counts.sum()


def expected_errors(predicted_3, weights_3):
    """The formulas, over three values."""
    true_3 = np.array([10.0, 20.0, 40.0])
    gap, ratio = predicted_3 - true_3, np.maximum(predicted_3 / true_3, true_3 / predicted_3)
    return {
        "abs_rel": weights_3 @ (np.abs(gap) / true_3),
        "sq_rel": weights_3 @ (gap**2 / true_3),
        "rmse": np.sqrt(weights_3 @ gap**2),
        "rmse_log": np.sqrt(weights_3 @ np.log(predicted_3 / true_3) ** 2),
        "delta1": weights_3 @ (ratio < 1.25),
        "delta2": weights_3 @ (ratio < 1.25**2),
        "delta3": weights_3 @ (ratio < 1.25**3),
    }


def measured(name, predicted, true_m, dgc=1.0):
    metric = DepthMetric(NAMED[name])
    metric.update({"depth_m": true_m}, {"depth": predicted[None], "scale": dgc, "source": ROAD})
    return metric.compute()


def open_walks(cell, root, split=None):
    return walks.open_walks(cell.recipe, tasks_of_cell(cell), root, split)


def spoiled(predicted, name):
    """The same inside the protocol's pixels, nonsense outside."""
    (top, bottom, left, right), other = PIXELS[name][1], np.full_like(predicted, 3.3)
    other[top:bottom, left:right] = predicted[top:bottom, left:right]
    return other


@pytest.mark.parametrize("name", NAMED)
def test_a_scaled_prediction_scores_the_known_error(name):
    """30 % too far after dgc; median scaling takes it back."""
    true_m, weights = truth_and_weights(name)
    metrics = measured(name, spoiled(1.3 / 5 * true_m, name), true_m, dgc=5.0)
    assert metrics["depth_median.abs_rel"] == pytest.approx(0, abs=1e-6)
    assert metrics["depth_median.rmse"] == pytest.approx(0, abs=1e-5)
    assert metrics["depth_median.delta1"] == 1
    if "dgc" not in NAMED[name].scalings:
        assert not [key for key in metrics if "dgc" in key]
        return
    mean, mean_square = weights @ [10, 20, 40], weights @ [100, 400, 1600]
    by_hand = [0.3, 0.09 * mean, 0.3 * np.sqrt(mean_square), np.log(1.3), 0, 1, 1]
    found = [metrics[f"depth_dgc.{error}"] for error in NAMES]
    assert found == pytest.approx(by_hand, rel=1e-6)
    assert metrics["dgc.to_median"] == pytest.approx(1.3, rel=1e-6)


@pytest.mark.parametrize("name", NAMED)
def test_an_affine_prediction_scores_the_known_error(name):
    """0.8 d + 6 m: 14, 22 and 38 m; the median is 22, so 20 / 22 scales it."""
    true_m, weights = truth_and_weights(name)
    metrics = measured(name, spoiled(0.8 * true_m + 6, name), true_m)
    by_hand = {"median": np.array([14, 22, 38]) * 20 / 22, "dgc": np.array([14.0, 22, 38])}
    for scaling in NAMED[name].scalings:
        expected = expected_errors(by_hand[scaling], weights)
        found = {error: metrics[f"depth_{scaling}.{error}"] for error in NAMES}
        assert found == pytest.approx(expected, rel=1e-5)
    assert expected_errors(by_hand["dgc"], weights)["delta1"] < 1


def test_predictions_are_clamped_after_scaling():
    true_m = np.full((4, 4), 40.0)
    metrics = measured("full-frame", np.full((4, 4), 300.0), true_m)
    assert metrics["depth_dgc.rmse"] == 40.0


# --- choice ---------------------------------------------------------------------------------------


def test_a_recipe_without_the_setting_is_measured_as_ever():
    cell = cell_of("synthetic")
    (main,) = protocols.of_recipe(cell.recipe)
    assert main == NAMED["full-frame"]
    values = json.loads(config.canonical_json(cell))["recipe"]
    assert not {"protocol", "also", "flip"} & set(values["evaluate"])
    assert "test_scenes" not in values["data"]


def test_what_is_not_as_published_says_so():
    cell = cell_of("kitti", protocol="eigen-improved", also=("eigen-raw",))
    main, raw = protocols.of_recipe(cell.recipe)
    assert (main.split, main.title) == ("val", "eigen-improved (split val)")
    assert raw == NAMED["eigen-raw"]
    nearer = cell_of("synthetic", depth_crop="garg", max_depth_m=50.0)
    (main,) = protocols.of_recipe(nearer.recipe, "train")
    assert main.title == "full-frame (split train, depth_crop garg, max_depth_m 50.0)"
    assert main.record()["name"] == main.title


@pytest.mark.parametrize(
    ("dataset", "settings", "message"),
    [
        ("kitti", {}, "'full-frame' needs disparity maps, which kitti lacks; .*eigen-improved"),
        ("synthetic", {"protocol": "eigen-raw"}, "velodyne maps, which synthetic lacks"),
        ("synthetic", {"also": ("eigen-raw",)}, "velodyne maps, which synthetic lacks"),
        ("kitti", {"protocol": "eigen-rwa"}, r"'eigen-rwa' \(did you mean 'eigen-raw'\?\)"),
        ("kitti", {"protocol": "eigen-raw", "also": ("eigen-raw",)}, "name each once"),
    ],
)
def test_wrong_choices_are_named(dataset, settings, message):
    with pytest.raises(ValueError, match=message):
        protocols.of_recipe(cell_of(dataset, **settings).recipe)


def test_protocols_share_a_walk_where_frames_and_truth_are_the_same(monkeypatch):
    opened = []
    monkeypatch.setattr(
        walks, "open_samples", lambda recipe, tasks, *where, **truth: opened.append((where, truth))
    )
    cell = cell_of("kitti", split="test", protocol="eigen-improved-crop",
                   also=("eigen-raw", "eigen-improved"))  # fmt: skip
    names = [[m.protocol.name for _, m in walk.measured] for walk in open_walks(cell, "root")]
    assert names == [["eigen-improved-crop", "eigen-improved"], ["eigen-raw"]]
    assert opened == [
        (("test", "root", False), {"truth": "improved"}),
        (("test", "root", False), {"truth": "velodyne"}),
    ]
    (alone,) = open_walks(replace(cell, tasks=("panoptic",)), "root")
    assert (alone.split, len(alone.measured)) == ("test", 1)
    both = open_walks(replace(cell, tasks=("panoptic", "depth")), "root")
    assert [len(walk.measured) for walk in both] == [3, 1]
    needed = [[task.name for task in walk.tasks] for walk in both]
    assert needed == [["panoptic", "depth"], ["depth"]]  # raw points are scaled by medians alone


def test_shipped_recipes_measure_what_is_published():
    recipes = [load_recipe(name) for name in config.recipe_names()]
    measured = [recipe for recipe in recipes if "depth" in recipe.tasks]
    assert len(measured) > 3
    for recipe in measured:
        for protocol in protocols.of_recipe(recipe):
            assert protocol.changed == ()


# --- frames ---------------------------------------------------------------------------------------


class Seer(nn.Module):
    """Knows every frame's depth by its image; sees road everywhere below the middle."""

    def __init__(self, cell, samples_of_walks, unit=1.0):
        super().__init__()
        self.tasks, self.unit, self.calls, self.known = tasks_of_cell(cell), unit, 0, {}
        for samples in samples_of_walks:
            for index in range(len(samples)):
                sample = samples.sample(index, None)
                self.known.setdefault(sample.image_B3HW.numpy().tobytes(), sample.fields["depth_m"])
        self.net = self.answer

    def answer(self, image_B3HW):
        self.calls += len(image_B3HW)
        depth = torch.stack([self.known[image.numpy().tobytes()] for image in image_B3HW])
        inverse = torch.where(depth > 0, self.unit / depth.clamp(min=0.1), self.unit / 1000)
        return Outputs({"depth": {"inverse": inverse[:, None]}})


@pytest.fixture(scope="module")
def kitti_root(tmp_path_factory):
    out = tmp_path_factory.mktemp("kitti") / "set"
    return synthetic.write(out, 32, 96, 1, 1, 17, processes=1, progress=False, layout=Kitti.layout)


@pytest.fixture(scope="module")
def cityscapes_root(tmp_path_factory):
    out = tmp_path_factory.mktemp("cityscapes") / "set"
    return synthetic.write(out, 32, 64, 1, 4, 4, processes=1, progress=False)


def sized(cell, height, width):
    data = replace(cell.recipe.data, height=height, width=width)
    return replace(cell, recipe=replace(cell.recipe, data=data))


@pytest.mark.parametrize("name", NAMED)
def test_a_perfect_predictor_scores_zero(name, kitti_root, cityscapes_root):
    protocol = NAMED[name]
    on_kitti = name.startswith("eigen")
    root = kitti_root if on_kitti else cityscapes_root
    cell = cell_of("synthetic-kitti" if on_kitti else "synthetic",
                   protocol=name, split=protocol.split)  # fmt: skip
    cell = sized(cell, 32, 96 if on_kitti else 64)
    model = Seer(cell, [walk.samples for walk in open_walks(cell, root)], unit=7.0)
    result = evaluate(model, cell, root, CPU)
    assert result.metrics["depth_median.abs_rel"] == pytest.approx(0, abs=1e-6)
    assert result.metrics["depth_median.rmse"] == pytest.approx(0, abs=1e-4)
    assert result.metrics["depth_median.delta1"] == 1
    if "dgc" in protocol.scalings:
        # of the ground by its normals, on grass and sidewalks too
        assert result.metrics["depth_dgc.abs_rel"] < 0.1
    frames = {"eigen-improved": 16, "eigen-improved-crop": 16, "eigen-raw": 17}.get(name, 4)
    about = result.protocol
    assert (about["name"], about["frames"]) == (name, frames)
    assert about["published_frames"] == protocol.frames_published
    assert (about["depth_truth"], about["depth_crop"]) == (protocol.truth, protocol.depth_crop)
    assert "also" not in about


def test_further_protocols_stand_beside_the_main_one(kitti_root):
    cell = cell_of("synthetic-kitti", protocol="eigen-improved", split="test",
                   also=("eigen-improved-crop", "eigen-raw"))  # fmt: skip
    cell = sized(cell, 32, 96)
    main, raw = open_walks(cell, kitti_root)
    model, calls = Seer(cell, [raw.samples, main.samples]), []
    result = evaluate(model, cell, kitti_root, CPU, progress=lambda *call: calls.append(call))
    assert model.calls == 16 + 17
    assert calls[0] == (8, 33)
    assert calls[-1] == (33, 33)
    metrics = result.metrics
    assert metrics["eigen-raw.depth_median.abs_rel"] == pytest.approx(0, abs=1e-6)
    assert metrics["eigen-raw.depth_median.images"] == 17
    assert metrics["depth_median.images"] == metrics["eigen-improved-crop.depth_dgc.images"] == 16
    assert metrics["depth_median.delta1"] < 1  # it knows depth where the scanner shot, only
    assert not [key for key in metrics if key.startswith("eigen-raw") and "dgc" in key]
    also = result.protocol["also"]
    assert set(also) == {"eigen-improved-crop", "eigen-raw"}
    assert also["eigen-raw"]["frames"] == 17
    assert also["eigen-raw"]["published_frames"] == 697
    assert also["eigen-raw"]["depth_scalings"] == ["median"]
    assert len(result.samples["names"]) == 4
    json.dumps(result.protocol)
    fewer = replace(cell.recipe.evaluate, also=())
    alone = replace(cell, recipe=replace(cell.recipe, evaluate=fewer))
    model.tasks = tasks_of_cell(alone)
    assert evaluate(model, alone, kitti_root, CPU).metrics == {
        key: value for key, value in metrics.items() if not key.startswith("eigen")
    }


def test_a_split_of_choice_holds_for_every_protocol(kitti_root):
    cell = cell_of("synthetic-kitti", protocol="eigen-improved", split="test", also=("eigen-raw",))
    found = open_walks(sized(cell, 32, 96), kitti_root, "val")
    assert [walk.split for walk in found] == ["val", "val"]
    assert [metric.split for walk in found for _, metric in walk.measured] == ["val", "val"]
    assert len(found[0].samples) == 1


def frame(size, true_m=10.0, ids=None):
    """One evaluation sample."""
    fields = {"depth_m": torch.full(size, true_m)}
    if ids is not None:
        fields["instance_ids"] = torch.full(size, ids, dtype=torch.int32)
    camera = Camera(torch.eye(3), torch.ones(()), torch.zeros(()))
    return Batch(["frame"], torch.zeros(3, *size), camera, fields)


class Frames:
    """Samples that are given."""

    def __init__(self, *frames):
        self.frames, self.dataset = frames, Kitti

    def __len__(self):
        return len(self.frames)

    def sample(self, index, generator):
        return self.frames[index]


def evaluated(cell, *frames):
    """Road everywhere, at a depth of 5 m."""
    tasks = tasks_of_cell(cell)
    measured = [(task, metric) for task in tasks for metric in task.metrics()]

    def results(batch, asked):
        size = batch.fields["depth_m"].shape[1:]
        count = len(batch.names)
        depth = {
            "depth": torch.full((count, 1, *size), 5.0),
            "scale": torch.ones(count),
            "source": torch.full((count,), ROAD),
        }
        road = torch.zeros((count, *size), dtype=torch.uint8)
        return {"depth": depth, "panoptic": {"class": road, "panoptic": road.int()}}

    walk = Walk(cell.recipe.evaluate.split, tasks, measured, Frames(*frames))
    return measure(cell, [walk], results, CPU)


def test_frames_without_truth_are_counted_not_averaged():
    cell = cell_of("synthetic-kitti", protocol="eigen-improved", split="test", also=("eigen-raw",))
    metrics = evaluated(cell, *(frame((8, 12), true_m) for true_m in (10.0, 0.0, 90.0))).metrics
    for prefix in ("", "eigen-raw."):
        assert metrics[f"{prefix}depth.without_truth"] == 2
        assert metrics[f"{prefix}depth_median.images"] == 1
    assert metrics["depth_dgc.abs_rel"] == 0.5


def test_frames_of_several_sizes():
    """KITTI's days: compared at each one's own size, pictured at the first's."""
    cell = cell_of("kitti", protocol="eigen-improved", split="test")
    result = evaluated(cell, frame((8, 12)), frame((7, 13)))
    assert result.protocol["compared_at"] == [[8, 12], [7, 13]]
    assert result.samples["depth_m"].shape == (2, 8, 12)
    assert result.metrics["depth_dgc.rmse"] == 5.0


def test_no_panoptic_truth_no_panoptic_metrics():
    cell = cell_of("kitti", tasks=("panoptic", "depth"), protocol="eigen-improved", split="test")
    for ids, said in ((None, "none in this split: no panoptic metrics"), (7, "1 of 1 frames")):
        result = evaluated(cell, frame((8, 12), ids=ids))
        assert result.protocol["panoptic_truth"] == said
        assert ("panoptic.pq" in result.metrics) == (ids is not None)
        assert "depth_median.rmse" in result.metrics
        assert "instance_ids" in result.samples


# --- flip -----------------------------------------------------------------------------------------


class Leaning(nn.Module):
    """Inverse depth that grows to the right, whatever it is shown; its classes follow the image."""

    def __init__(self, cell, width):
        super().__init__()
        self.tasks = tasks_of_cell(cell)
        self.ramp = torch.linspace(0.1, 0.3, width)
        self.net = self.answer

    def answer(self, image_B3HW):
        semantic = torch.cat([image_B3HW, 1 - image_B3HW[:, :1]], 1)
        inverse = self.ramp.expand(len(image_B3HW), 1, image_B3HW.shape[2], -1)
        center = torch.zeros_like(inverse)
        offset = center.repeat(1, 2, 1, 1)
        panoptic = {"semantic": semantic, "center": center, "offset": offset}
        return Outputs({"panoptic": panoptic, "depth": {"inverse": inverse}})


def batch_of(image_3HW):
    return collate([replace(frame((8, 12), ids=7), image_B3HW=image_3HW)])


def test_flip_averages_the_inverse_depth_and_nothing_else():
    both = ("panoptic", "depth")
    batch = batch_of(torch.rand(3, 8, 12, generator=torch.Generator().manual_seed(0)))
    results = {}
    for flip in (False, True):
        cell = cell_of("kitti", tasks=both, protocol="eigen-raw", split="test", flip=flip)
        model = Leaning(cell, 12)
        results[flip] = predict(model, batch, model.tasks, (8, 12))
        said = evaluated(cell, frame((8, 12))).protocol["depth_flip"]
        assert said == (FLIP if flip else "none")
    assert results[False]["depth"]["depth"][0, 0, 0, 0] == pytest.approx(10)
    assert torch.allclose(results[True]["depth"]["depth"], torch.tensor(5.0))
    for name in ("class", "panoptic"):
        assert torch.equal(results[True]["panoptic"][name], results[False]["panoptic"][name])


def test_flip_of_a_cell_without_depth_is_nothing():
    cell = cell_of("synthetic", tasks=("panoptic",), flip=True)
    model = Leaning(cell, 12)
    calls = []
    model.net = lambda image: calls.append(1) or model.answer(image)
    predict(model, batch_of(torch.zeros(3, 8, 12)), model.tasks, (8, 12))
    assert len(calls) == 1


def test_records_are_plain():
    for protocol in NAMED.values():
        assert json.loads(json.dumps(protocol.record())) == protocol.record()
        assert isinstance(protocol, Protocol)


def test_the_main_dataset_has_the_main_truth(kitti_root):
    cell = sized(cell_of("synthetic-kitti", protocol="eigen-raw", split="test"), 32, 96)
    (only,) = open_walks(cell, kitti_root)
    depth = only.samples.sample(0, None).fields["depth_m"]
    dense = open_samples(
        cell.recipe, tasks_of_cell(cell), "test", kitti_root, training=False, truth="improved"
    )
    assert (
        0.2
        < (depth > 0).float().mean()
        < 0.9 * (dense.sample(0, None).fields["depth_m"] > 0).float().mean()
    )
