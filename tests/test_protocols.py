"""Depth protocols: which pixels, which scaling, which passes, and errors that are known by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from mtl_bench.core import config
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.data import synthetic
from mtl_bench.data.batch import Batch
from mtl_bench.data.labels import CITYSCAPES19
from mtl_bench.data.layouts import KITTI
from mtl_bench.data.loader import open_dataset
from mtl_bench.evaluate.collector import FLIP, Collector, DepthScore, Prediction
from mtl_bench.evaluate.walk import evaluate, open_passes, predict
from mtl_bench.model import Outputs
from mtl_bench.tasks.depth import protocols
from mtl_bench.tasks.depth.errors import NAMES, evaluation_mask
from mtl_bench.tasks.depth.protocols import NAMED, Protocol
from mtl_bench.tasks.panoptic import postprocess

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
    score = DepthScore(NAMED[name])
    score.update(predicted, true_m, dgc, postprocess.ROAD)
    return score.metrics()


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
    (main,) = protocols.of_cell(cell)
    assert main == NAMED["full-frame"]
    values = json.loads(config.canonical_json(cell))["recipe"]
    assert not {"protocol", "also", "flip"} & set(values["evaluate"])
    assert "test_scenes" not in values["data"]


def test_what_is_not_as_published_says_so():
    cell = cell_of("kitti", protocol="eigen-improved", also=("eigen-raw",))
    main, raw = protocols.of_cell(cell)
    assert (main.split, main.title) == ("val", "eigen-improved (split val)")
    assert raw == NAMED["eigen-raw"]
    nearer = cell_of("synthetic", depth_crop="garg", max_depth_m=50.0)
    (main,) = protocols.of_cell(nearer, "train")
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
        protocols.of_cell(cell_of(dataset, **settings))


def test_protocols_share_a_pass_where_frames_and_truth_are_the_same():
    cell = cell_of("kitti", split="test", protocol="eigen-improved-crop",
                   also=("eigen-raw", "eigen-improved"))  # fmt: skip
    names = [[p.name for p in group] for group in protocols.passes(protocols.of_cell(cell))]
    assert names == [["eigen-improved-crop", "eigen-improved"], ["eigen-raw"]]
    alone = replace(cell, tasks=("panoptic",))
    assert [p.name for p in protocols.of_cell(alone)] == ["eigen-improved-crop"]


def test_shipped_recipes_measure_what_is_published():
    for name in config.recipe_names():
        for protocol in protocols.of_cell(Cell(load_recipe(name), "none", "none")):
            assert protocol.changed == ()


# --- frames ---------------------------------------------------------------------------------------


class Seer(nn.Module):
    """Knows every frame's depth by its image; sees road everywhere below the middle."""

    def __init__(self, datasets, unit=1.0):
        super().__init__()
        self.unit, self.calls, self.known = unit, 0, {}
        for dataset in datasets:
            for index in range(len(dataset)):
                sample = dataset.sample(index, None)
                self.known.setdefault(sample.image_B3HW.numpy().tobytes(), sample.depth_m_BHW)
        self.net = self.answer

    def answer(self, image_B3HW):
        self.calls += len(image_B3HW)
        depth = torch.stack([self.known[image.numpy().tobytes()] for image in image_B3HW])
        inverse = torch.where(depth > 0, self.unit / depth.clamp(min=0.1), self.unit / 1000)
        return Outputs(inverse_depth=[inverse[:, None]])


@pytest.fixture(scope="module")
def kitti_root(tmp_path_factory):
    out = tmp_path_factory.mktemp("kitti") / "set"
    return synthetic.write(out, 32, 96, 1, 1, 17, processes=1, progress=False, layout=KITTI)


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
    model = Seer([only.dataset for only in open_passes(cell, root)], unit=7.0)
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
    main, raw = open_passes(cell, kitti_root)
    model, calls = Seer([raw.dataset, main.dataset]), []
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
    alone = evaluate(model, replace(cell, recipe=replace(cell.recipe, evaluate=replace(
        cell.recipe.evaluate, also=()))), kitti_root, CPU)  # fmt: skip
    assert alone.metrics == {k: v for k, v in metrics.items() if not k.startswith("eigen")}


def test_a_split_of_choice_holds_for_every_protocol(kitti_root):
    cell = cell_of("synthetic-kitti", protocol="eigen-improved", split="test", also=("eigen-raw",))
    passes = open_passes(sized(cell, 32, 96), kitti_root, "val")
    assert [only.measured[0].split for only in passes] == ["val", "val"]
    assert len(passes[0].dataset) == 1


def frame(size, true_m=10.0, ids=None):
    image = torch.zeros(1, 3, *size)
    return Batch(
        names=["frame"],
        image_B3HW=image,
        K_B33=torch.eye(3)[None],
        camera_height_m_B=torch.ones(1),
        camera_pitch_rad_B=torch.zeros(1),
        instance_ids_BHW=None if ids is None else torch.full((1, *size), ids),
        depth_m_BHW=torch.full((1, *size), true_m),
    )


def prediction_of(size, depth=5.0, **panoptic):
    return Prediction(
        depth_B1HW=torch.full((1, 1, *size), depth),
        dgc_scale_B=torch.ones(1),
        dgc_source_B=torch.tensor([postprocess.ROAD]),
        **panoptic,
    )


def test_frames_without_truth_are_counted_not_averaged():
    cell = cell_of("synthetic-kitti", protocol="eigen-improved", split="test", also=("eigen-raw",))
    main, raw = protocols.of_cell(cell)
    collector = Collector(cell, CITYSCAPES19, 3, [main, raw])
    for true_m in (10.0, 0.0, 90.0):
        collector.update(frame((8, 12), true_m), prediction_of((8, 12)))
    metrics = collector.result("test", CPU).metrics
    for prefix in ("", "eigen-raw."):
        assert metrics[f"{prefix}depth.without_truth"] == 2
        assert metrics[f"{prefix}depth_median.images"] == 1
    assert metrics["depth_dgc.abs_rel"] == 0.5


def test_frames_of_several_sizes():
    """KITTI's days: compared at each one's own size, pictured at the first's."""
    cell = cell_of("kitti", protocol="eigen-improved", split="test")
    collector = Collector(cell, CITYSCAPES19, 2)
    for size in ((8, 12), (7, 13)):
        collector.update(frame(size), prediction_of(size))
    result = collector.result("test", CPU)
    assert result.protocol["compared_at"] == [[8, 12], [7, 13]]
    assert result.samples["depth_m"].shape == (2, 8, 12)
    assert result.metrics["depth_dgc.rmse"] == 5.0


def test_no_panoptic_truth_no_panoptic_metrics():
    cell = cell_of("kitti", tasks=("panoptic", "depth"), protocol="eigen-improved", split="test")
    size = (8, 12)
    seen = {
        "class_BHW": torch.zeros((1, *size), dtype=torch.long),
        "instance_ids_BHW": torch.full((1, *size), 7, dtype=torch.int32),
    }
    for ids, said in ((None, "none in this split: no panoptic metrics"), (7, "1 of 1 frames")):
        collector = Collector(cell, CITYSCAPES19, 1)
        collector.update(frame(size, ids=ids), prediction_of(size, **seen))
        result = collector.result("test", CPU)
        assert result.protocol["panoptic_truth"] == said
        assert ("panoptic.pq" in result.metrics) == (ids is not None)
        assert "depth_median.rmse" in result.metrics
        assert "instance_ids" in result.samples


# --- flip -----------------------------------------------------------------------------------------


class Leaning(nn.Module):
    """Inverse depth that grows to the right, whatever it is shown; its classes follow the image."""

    def __init__(self, width):
        super().__init__()
        self.ramp = torch.linspace(0.1, 0.3, width)
        self.net = self.answer

    def answer(self, image_B3HW):
        semantic = torch.cat([image_B3HW, 1 - image_B3HW[:, :1]], 1)
        inverse = self.ramp.expand(len(image_B3HW), 1, image_B3HW.shape[2], -1)
        center = torch.zeros_like(inverse)
        return Outputs(semantic, center, center.repeat(1, 2, 1, 1), [inverse])


def test_flip_averages_the_inverse_depth_and_nothing_else():
    both = ("panoptic", "depth")
    image = torch.rand(1, 3, 8, 12, generator=torch.Generator().manual_seed(0))
    batch = replace(frame((8, 12)), image_B3HW=image)
    results = {}
    for flip in (False, True):
        cell = cell_of("kitti", tasks=both, protocol="eigen-raw", split="test", flip=flip)
        results[flip] = predict(Leaning(12), batch, cell, CITYSCAPES19, (8, 12))
        collector = Collector(cell, CITYSCAPES19, 1)
        collector.update(batch, results[flip])
        said = collector.result("test", CPU).protocol["depth_flip"]
        assert said == (FLIP if flip else "none")
    assert results[False].depth_B1HW[0, 0, 0, 0] == pytest.approx(10)
    assert torch.allclose(results[True].depth_B1HW, torch.tensor(5.0))
    assert torch.equal(results[True].instance_ids_BHW, results[False].instance_ids_BHW)
    assert torch.equal(results[True].class_BHW, results[False].class_BHW)


def test_flip_of_a_cell_without_depth_is_nothing():
    cell = cell_of("synthetic", tasks=("panoptic",), flip=True)
    predict(Leaning(12), frame((8, 12)), cell, CITYSCAPES19, (8, 12))


def test_records_are_plain():
    for protocol in NAMED.values():
        assert json.loads(json.dumps(protocol.record())) == protocol.record()
        assert isinstance(protocol, Protocol)


def test_the_main_dataset_has_the_main_truth(kitti_root):
    cell = sized(cell_of("synthetic-kitti", protocol="eigen-raw", split="test"), 32, 96)
    (only,) = open_passes(cell, kitti_root)
    depth = only.dataset.sample(0, None).depth_m_BHW
    dense = open_dataset(cell, "test", kitti_root, training=False, truth="improved")
    assert (
        0.2
        < (depth > 0).float().mean()
        < 0.9 * (dense.sample(0, None).depth_m_BHW > 0).float().mean()
    )
