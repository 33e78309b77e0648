"""Evaluation, trivial predictors and export, on a tiny tree and models that know the truth."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cityscapesscripts.evaluation import evalPanopticSemanticLabeling as csEval
from cityscapesscripts.preparation.createPanopticImgs import convert2panoptic
from torch import nn

from mtl_bench.core.config import Cell, Data, Evaluate, Loss, Recipe
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20, IGNORE
from mtl_bench.data.loader import eval_batches, open_dataset
from mtl_bench.evaluate.export_predictions import export_predictions, write_panoptic
from mtl_bench.evaluate.trivial import Average, baselines
from mtl_bench.evaluate.walk import evaluate
from mtl_bench.model import Outputs
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.quality import PanopticQuality
from mtl_bench.tasks.panoptic.targets import panoptic_targets

HEIGHT, WIDTH, FRAMES = 64, 128, 5
FOCAL, BASELINE, CAMERA_M = 115.0, 0.5, 1.4
CPU = torch.device("cpu")
CELL = Cell(
    Recipe(
        data=Data(dataset="cityscapes", height=HEIGHT, width=WIDTH),
        loss=Loss(center_sigma=3),
        evaluate=Evaluate(stuff_area=0, nms_kernel=5),
    ),
    backbone="none",
    method="none",
)


def scene(index):
    """Instance ids and disparity of a street: sky, road, ego vehicle, and cars that move."""
    ids = np.full((HEIGHT, WIDTH), 23, np.uint16)
    ids[32:] = 7
    ids[60:] = 1
    rows = (np.arange(HEIGHT)[:, None] - (HEIGHT - 1) / 2).repeat(WIDTH, 1)
    disparity = np.where(ids == 23, 0, rows.clip(1) * BASELINE / CAMERA_M)  # of a flat road
    for number in range(2):
        top, left = 28 + 4 * number, 10 + 12 * index + 40 * number
        box = np.s_[top : top + 12, left : left + 16]
        ids[box] = 26000 + number
        disparity[box] = disparity[top + 11, 0]
    return ids, np.where(disparity > 0, np.round(disparity * 256) + 1, 0).astype(np.uint16)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Frames of one gray level each, by which the models recognise them; train is almost val."""
    root = tmp_path_factory.mktemp("tree")
    camera = {
        "extrinsic": {"baseline": BASELINE, "z": CAMERA_M, "pitch": 0.0},
        "intrinsic": {"fx": FOCAL, "fy": FOCAL, "u0": (WIDTH - 1) / 2, "v0": (HEIGHT - 1) / 2},
    }
    for split in ("train", "val"):
        for index in range(FRAMES):
            ids, disparity = scene(index)
            if split == "train":
                ids[:, -3:] = 0  # never labelled
            write(root, split, index, "leftImg8bit", np.full((*ids.shape, 3), index, np.uint8))
            write(root, split, index, "gtFine", ids, "_gtFine_instanceIds")
            write(root, split, index, "disparity", disparity)
            path = file_of(root, split, index, "camera", "_camera.json")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(camera))
    return root


def file_of(root: Path, split: str, index: int, folder: str, suffix: str) -> Path:
    return root / folder / split / "aachen" / f"aachen_{index:06d}_000019{suffix}"


def write(root, split, index, folder, array, suffix=None):
    path = file_of(root, split, index, folder, f"{suffix or '_' + folder}.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), array)


class Oracle(nn.Module):
    """Outputs made of the truth, at the input's size; depth in a unit of its own."""

    def __init__(self, cell, unit=3.0, change=None):
        super().__init__()
        self.cell, self.unit, self.change = cell, unit, change
        self.weight = nn.Parameter(torch.ones(1))
        self.frozen = nn.BatchNorm2d(1).eval()
        self.net = self.answer

    def answer(self, image_B3HW):
        assert not self.training
        assert torch.is_inference_mode_enabled()
        step = HEIGHT // image_B3HW.shape[2]
        parts = [self.frame(round(image[0, 0, 0].item() * 255), step) for image in image_B3HW]
        outputs = Outputs()
        if "panoptic" in self.cell.tasks:
            names = ("semantic_BCHW", "center_B1HW", "offset_B2HW")
            for name, maps in zip(
                names, zip(*[part[:3] for part in parts], strict=True), strict=True
            ):
                setattr(outputs, name, torch.stack(maps))
        if "depth" in self.cell.tasks:
            outputs.inverse_depth = [torch.stack([part[3] for part in parts])]
        return self.change(outputs) if self.change else outputs

    def frame(self, index, step):
        ids, stored = (array[step // 2 :: step, step // 2 :: step] for array in scene(index))
        targets = panoptic_targets(ids.astype(np.int32), CITYSCAPES20, self.cell.recipe.loss)
        classes = torch.from_numpy(np.where(targets.semantic == IGNORE, 0, targets.semantic))
        logits = nn.functional.one_hot(classes, len(CITYSCAPES20)).permute(2, 0, 1).float()
        depth_m = BASELINE * FOCAL * 256 / np.maximum(stored.astype(np.float32) - 1, 1e-3)
        inverse = torch.from_numpy(self.unit / np.where(stored > 0, depth_m, 1000))
        slope = np.linspace(1, 0.9, targets.center.size).reshape(targets.center.shape)
        center = torch.from_numpy((targets.center * slope).astype(np.float32))[None]  # no ties
        offset = torch.from_numpy(targets.offset)
        return logits, center, offset, inverse[None]


def run(cell, root, **changes):
    return evaluate(Oracle(cell, **changes), cell, root, CPU, batch_size=2)


def test_the_truth_scores_perfectly(root):
    model, calls = Oracle(CELL).train(), []
    model.frozen.eval()
    result = evaluate(
        model, CELL, root, CPU, batch_size=2, progress=lambda *call: calls.append(call)
    )
    metrics = result.metrics
    for name in ("panoptic.pq", "panoptic.pq_things", "panoptic.pq_stuff", "semantic.miou"):
        assert metrics[name] == 100.0
    assert metrics["panoptic.class.car.pq"] == metrics["semantic.class.road.iou"] == 100.0
    assert metrics["depth_median.abs_rel"] == pytest.approx(0, abs=1e-6)
    assert metrics["depth_median.delta1"] == 1.0
    assert metrics["depth_dgc.abs_rel"] == pytest.approx(0, abs=0.01)  # disparity in 1/256 pixel
    assert metrics["dgc.to_median"] == pytest.approx(1, abs=0.01)
    assert metrics["dgc.failed"] == metrics["dgc.fallback"] == 0
    assert metrics["depth_median.images"] == metrics["depth_dgc.images"] == FRAMES
    assert all(np.isfinite(value) for value in metrics.values())

    assert calls == [(2, 5), (4, 5), (5, 5)]
    assert model.training
    assert not model.frozen.training
    assert model.weight.grad is None

    assert result.protocol["frames"] == FRAMES
    assert result.protocol["split"] == "val"
    assert result.protocol["ignored_classes"] == ["ego vehicle"]
    assert result.protocol["depth_range_m"] == [0.001, 80.0]
    json.dumps(result.protocol)


def test_samples_are_spread_over_the_split(root):
    samples = run(CELL, root).samples
    assert samples["names"] == [f"aachen_{i:06d}_000019" for i in (0, 1, 3, 4)]
    assert samples["image"].shape == (4, HEIGHT, WIDTH, 3)
    assert samples["image"][:, 0, 0, 0].tolist() == [0, 1, 3, 4]
    truth = np.where(samples["true_instance_ids"] == 1, 0, samples["true_instance_ids"])
    assert np.array_equal(samples["instance_ids"] > 26000, truth > 25999)
    assert samples["depth_m"].dtype == np.float16
    valid = (samples["true_depth_m"] > 0) & (samples["true_depth_m"] < 60)
    np.testing.assert_allclose(samples["depth_m"][valid], samples["true_depth_m"][valid], rtol=1e-2)


def test_the_worst_and_the_best_frame_are_kept(root):
    numbers = iter(range(FRAMES))

    def spoiled(outputs):
        """Sky all over frame 3, and in the upper half of frame 1."""
        for semantic in outputs.semantic_BCHW:
            rows = {1: HEIGHT // 2, 3: HEIGHT}.get(next(numbers), 0)
            semantic[:, :rows] = 0
            semantic[CITYSCAPES20.index("sky"), :rows] = 9
        return outputs

    samples = run(CELL, root, change=spoiled).samples
    worst, best = samples["extremes.names"]
    assert worst == "aachen_000003_000019"
    assert best not in (worst, "aachen_000001_000019")
    assert 0 < samples["extremes.pq"][0] < samples["extremes.pq"][1] == 100.0
    assert samples["extremes.image"][0, 0, 0, 0] == 3
    for key in ("instance_ids", "true_instance_ids", "depth_m", "true_depth_m"):
        assert samples[f"extremes.{key}"].shape == (2, HEIGHT, WIDTH)


def test_one_task_has_no_numbers_of_the_other(root):
    panoptic = run(replace(CELL, tasks=("panoptic",)), root)
    assert panoptic.metrics["panoptic.pq"] == 100.0
    assert not [key for key in panoptic.metrics if key.startswith(("depth", "dgc"))]
    kept = {"names", "image", "instance_ids", "true_instance_ids"}
    assert set(panoptic.samples) == kept | {f"extremes.{key}" for key in (*kept, "pq")}

    depth = run(replace(CELL, tasks=("depth",)), root)
    assert depth.metrics["dgc.fallback"] == FRAMES  # the road from normals
    assert depth.metrics["depth_dgc.rmse"] == pytest.approx(0, abs=0.5)
    assert not [key for key in depth.metrics if key.startswith(("panoptic", "semantic"))]
    assert set(depth.samples) == {"names", "image", "depth_m", "true_depth_m"}


def test_frames_without_ground_are_counted_not_averaged(root):
    def wall(outputs):
        outputs.inverse_depth[0][0] = 0.1  # the first frame of each batch
        return outputs

    cell = replace(CELL, tasks=("depth",))
    metrics = run(cell, root, change=wall).metrics
    assert metrics["dgc.failed"] == 3
    assert metrics["depth_dgc.images"] == 2
    assert metrics["depth_median.images"] == FRAMES
    assert metrics["depth_dgc.abs_rel"] == pytest.approx(0, abs=0.01)
    assert metrics["depth_median.abs_rel"] > 0.1

    def walls(outputs):
        outputs.inverse_depth[0][:] = 0.1
        return outputs

    metrics = run(cell, root, change=walls).metrics
    assert metrics["dgc.failed"] == FRAMES
    assert metrics["depth_dgc.images"] == 0
    assert "depth_dgc.rmse" not in metrics


def test_smaller_inputs_are_compared_at_the_size_of_the_truth(root):
    data = replace(CELL.recipe.data, height=HEIGHT // 2, width=WIDTH // 2)
    cell = replace(CELL, recipe=replace(CELL.recipe, data=data))
    result = run(cell, root)
    assert result.protocol["input"] == [32, 64]
    assert result.protocol["compared_at"] == [64, 128]
    assert result.samples["image"].shape[1:] == (HEIGHT, WIDTH, 3)
    assert result.metrics["panoptic.class.car.pq"] > 75  # without scaled offsets: below 60
    assert result.metrics["panoptic.class.car.rq"] == 100.0
    assert result.metrics["dgc.to_median"] == pytest.approx(1, abs=0.03)


def test_depth_that_is_not_finite_is_an_error(root):
    def broken(outputs):
        outputs.inverse_depth[0][0, 0, 3, 3] = torch.nan
        return outputs

    with pytest.raises(ValueError, match="not finite in a frame of \\['aachen_000000_000019'"):
        run(CELL, root, change=broken)


# --- trivial predictors ---------------------------------------------------------------------------


def test_baselines_are_averages_of_the_training_split(root, tmp_path):
    metrics = baselines(CELL, root, tmp_path).metrics
    truth = [scene(index)[0] for index in range(FRAMES)]  # train: without the last columns
    classes = np.stack([np.where(ids >= 26000, 26, ids) for ids in truth])
    most = np.zeros((HEIGHT, WIDTH), int)
    for label in (26, 23, 7, 1):  # ties go to the lowest class, which is the last to be written
        best = np.stack([(classes == other).sum(0) for other in (26, 23, 7, 1)]).max(0)
        most[(classes == label).sum(0) == best] = label
    most[:, -3:] = 0
    sky = 100 * (
        ((classes == 23) & (most == 23)).sum()
        / ((classes == 23) | ((most == 23) & (classes != 1))).sum()
    )
    assert metrics["semantic.class.sky.iou"] == pytest.approx(sky)
    assert 0 < metrics["panoptic.pq"] < metrics["panoptic.class.road.pq"] < 100

    depths = []
    for index in range(FRAMES):
        stored = scene(index)[1].astype(np.float32)
        depth = BASELINE * FOCAL * 256 / np.maximum(stored - 1, 1e-9)
        depths.append(np.where((stored > 1) & (depth < 80), depth, 0))
    depths = np.stack(depths)
    mean = depths.sum(0) / np.maximum((depths > 0).sum(0), 1)
    rel = [np.mean(np.abs(mean - d)[d > 0] / d[d > 0]) for d in depths]
    assert metrics["depth_dgc.abs_rel"] == pytest.approx(np.mean(rel), rel=1e-4)
    assert 0 < metrics["depth_median.rmse"] < 20
    assert metrics["dgc.failed"] == 0
    # the same keys as a row's
    assert set(metrics) >= {"panoptic.pq_things", "semantic.miou", "depth_median.delta3"}


def test_averages_of_two_frames_by_hand():
    average = Average(CITYSCAPES19, Evaluate(), (1, 4))
    average.add(torch.tensor([[7, 7, 26001, 1]]), torch.tensor([[10.0, 0, 90, 0]]))
    average.add(torch.tensor([[7, 8, 26, 0]]), torch.tensor([[30.0, 0, 0, 8]]))
    names = [CITYSCAPES19.labels[i].name for i in average.class_HW()[0, :3]]
    assert names == ["road", "road", "car"]
    assert average.class_HW()[0, 3] == IGNORE
    assert average.depth_m_HW()[0, [0, 3]].tolist() == [20.0, 8.0]
    assert average.depth_m_HW()[0, 1:3].tolist() == [20.0, 8.0]  # no valid depth: the nearest


def test_baselines_are_computed_once_per_setting(root, tmp_path):
    calls = []

    def progress(*call):
        calls.append(call)

    first = baselines(CELL, root, tmp_path, progress=progress)
    assert calls[-1] == (2 * FRAMES, 2 * FRAMES)
    count = len(calls)
    again = baselines(replace(CELL, seed=7, backbone="other"), root, tmp_path, progress=progress)
    assert len(calls) == count
    assert (again.metrics, again.protocol) == (first.metrics, first.protocol)
    nearer = replace(CELL.recipe, evaluate=replace(CELL.recipe.evaluate, max_depth_m=20.0))
    other = baselines(replace(CELL, recipe=nearer), root, tmp_path)
    assert other.metrics["depth_median.rmse"] < first.metrics["depth_median.rmse"]
    assert len(list(tmp_path.glob("*.json"))) == len(list(tmp_path.iterdir())) == 2


def test_baselines_of_one_task_need_no_truth_of_the_other(root, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(root, data, ignore=shutil.ignore_patterns("gtFine"))
    both = baselines(CELL, root, tmp_path / "both").metrics
    depth = baselines(replace(CELL, tasks=("depth",)), data, tmp_path / "one").metrics
    assert depth == {key: both[key] for key in depth}
    assert "depth_median.rmse" in depth
    assert not [key for key in depth if key.startswith(("panoptic", "semantic"))]


# --- export ---------------------------------------------------------------------------------------


def test_the_official_evaluator_agrees_on_exported_predictions(root, tmp_path):
    def blur(outputs):
        outputs.semantic_BCHW = outputs.semantic_BCHW.roll((2, 3), (2, 3))
        outputs.center_B1HW[1:, :, :, :64] = 0  # loses a car
        return outputs

    model = Oracle(CELL, change=blur)
    expected = evaluate(model, CELL, root, CPU, batch_size=2).metrics
    results = export_predictions(model, CELL, root, tmp_path / "out", CPU, batch_size=2)
    convert2panoptic(str(root / "gtFine"), str(tmp_path), setNames=["val"])
    official = official_quality(tmp_path / "cityscapes_panoptic_val.json", results)
    assert 0 < official["All"]["pq"] < 1
    for key, part in (("pq", "All"), ("pq_things", "Things"), ("pq_stuff", "Stuff")):
        assert expected[f"panoptic.{key}"] / 100 == pytest.approx(official[part]["pq"], abs=1e-9)


def official_quality(truth_json: Path, results_json: Path):
    """Cityscapes' own evaluation, in this process."""
    truth = json.loads(truth_json.read_text())
    predictions = {p["image_id"]: p for p in json.loads(results_json.read_text())["annotations"]}
    categories = {item["id"]: item for item in truth["categories"]}
    pairs = [(item, predictions[item["image_id"]]) for item in truth["annotations"]]
    folders = str(truth_json.with_suffix("")), str(results_json.with_suffix(""))
    statistics = csEval.pq_compute_single_core(0, pairs, *folders, categories)
    return csEval.average_pq(statistics, categories)


# --- the built-in data ----------------------------------------------------------------------------


def truth_through_grouping(root, cell, damage):
    """(name, predicted ids, true ids) of the split: truth -> targets -> grouping."""
    ev = replace(cell.recipe.evaluate, stuff_area=0)
    dataset = open_dataset(cell, "val", root, training=False)
    for batch in eval_batches(dataset, 1):
        ids = batch.instance_ids_BHW[0].numpy()
        targets = panoptic_targets(ids, CITYSCAPES20, cell.recipe.loss)
        classes = np.where((ids > 23) & (ids < 1000), IGNORE, targets.semantic)  # crowds
        classes = np.roll(classes, damage, 1)
        maps = [torch.from_numpy(x)[None] for x in (classes, targets.center[None], targets.offset)]
        panoptic = postprocess.panoptic(*maps, CITYSCAPES20.things, ev)
        predicted = postprocess.to_instance_ids(panoptic, CITYSCAPES20)[0].numpy()
        yield batch.names[0], predicted, ids


@pytest.mark.parametrize("damage", [0, 2])
def test_the_built_in_truth_is_perfect_and_the_official_evaluator_agrees(
    smoke_root, smoke_cell, tmp_path, damage
):
    frames = list(truth_through_grouping(smoke_root, smoke_cell, damage))
    quality = PanopticQuality(CITYSCAPES20)
    for _, predicted, true in frames:
        quality.update(predicted, true)
    result = quality.compute()["pq"]
    assert result == 100.0 if damage == 0 else 20 < result < 95
    results = write_panoptic(tmp_path, "val", [frame[:2] for frame in frames])
    official = official_quality(smoke_root / "gtFine/cityscapes_panoptic_val.json", results)
    assert result / 100 == pytest.approx(official["All"]["pq"], abs=1e-9)


def test_nothing_panoptic_nothing_to_export(root, tmp_path):
    cell = replace(CELL, tasks=("depth",))
    with pytest.raises(ValueError, match="no panoptic task"):
        export_predictions(Oracle(cell), cell, root, tmp_path, CPU)
