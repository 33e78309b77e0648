"""Panoptic quality against the official evaluator, published values and the rules' corner cases."""

import json
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from cityscapesscripts.evaluation import evalPanopticSemanticLabeling as csEval
from cityscapesscripts.preparation.createPanopticImgs import convert2panoptic

from mtl_bench.core.labels import class_of_instance_id
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.evaluate.delta import delta_flat, delta_task
from mtl_bench.tasks.panoptic import PanopticMetric
from mtl_bench.tasks.panoptic.files import write_panoptic
from mtl_bench.tasks.panoptic.metrics import (
    VOID,
    PanopticQuality,
    Segments,
    SemanticIoU,
    Tally,
    match,
    segments,
)

PUBLISHED = Path(__file__).parents[3] / "shared/data/deeplab2_testdata/evaluation"


def random_truth(rng, height=48, width=96):
    """Overlapping boxes of every kind of id: stuff, instances, crowds, void, ego vehicle."""
    ids = np.full((height, width), 7, np.int32)
    for _ in range(rng.integers(10, 30)):
        label = rng.choice([0, 1, 4, 8, 11, 17, 21, 23, 24, 24, 26, 26, 26, 29, 33])
        if label >= 24:
            number = rng.integers(-1, 6)  # -1: a crowd
            label = label if number < 0 else label * 1000 + number
        y, x = rng.integers(0, height - 4), rng.integers(0, width - 4)
        ids[y : y + rng.integers(3, 20), x : x + rng.integers(3, 40)] = label
    return ids


def damaged(rng, ids):
    """A prediction: the truth shifted, renumbered, with holes and inventions; 0 where ignored."""
    predicted = np.roll(ids, rng.integers(-3, 4, 2), (0, 1))
    for value in np.unique(predicted):
        if rng.random() < 0.15:
            predicted[predicted == value] = rng.choice([0, 7, 26, 26017, 24003])
    y, x = rng.integers(0, 30), rng.integers(0, 60)
    predicted[y : y + 12, x : x + 25] = rng.choice([0, 11, 26018, 33001])
    label = np.where(predicted < 1000, predicted, predicted // 1000)
    evaluated = [item.label_id for item in CITYSCAPES19.labels]
    return np.where(np.isin(label, evaluated), predicted, 0)


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    """Truth in Cityscapes' layout through the official converter, predictions through ours."""
    root = tmp_path_factory.mktemp("cityscapes")
    rng = np.random.default_rng(3)
    truth = [random_truth(rng) for _ in range(8)]
    predictions = [damaged(rng, ids) for ids in truth]
    predictions[0][:] = 0  # nothing predicted at all
    names = [f"aachen_{index:06d}_000019" for index in range(len(truth))]
    city = root / "gtFine/val/aachen"
    city.mkdir(parents=True)
    for name, ids in zip(names, truth, strict=True):
        cv2.imwrite(str(city / f"{name}_gtFine_instanceIds.png"), ids.astype(np.uint16))
    convert2panoptic(str(root / "gtFine"), setNames=["val"])
    results = write_panoptic(root / "results", "val", zip(names, predictions, strict=True))
    return root / "gtFine/cityscapes_panoptic_val.json", results, truth, predictions


def ours(truth, predictions, labels=CITYSCAPES20):
    quality = PanopticQuality(labels)
    for true, predicted in zip(truth, predictions, strict=True):
        quality.update(predicted, true)
    return quality.compute()


def test_equals_the_official_evaluator(split):
    truth_json, results_json, truth, predictions = split
    truth_file, results = json.loads(truth_json.read_text()), json.loads(results_json.read_text())
    by_image = {annotation["image_id"]: annotation for annotation in results["annotations"]}
    pairs = [(item, by_image[item["image_id"]]) for item in truth_file["annotations"]]
    categories = {item["id"]: item for item in truth_file["categories"]}
    statistics = csEval.pq_compute_single_core(
        0, pairs, str(truth_json.with_suffix("")), str(results_json.with_suffix("")), categories
    )
    expected = csEval.average_pq(statistics, categories)

    result = ours(truth, predictions)
    assert 5 < result["pq"] < 95  # the comparison compares something
    for key in ("pq", "sq", "rq"):
        assert result[key] / 100 == pytest.approx(expected["All"][key], abs=1e-9)
    assert result["pq_things"] / 100 == pytest.approx(expected["Things"]["pq"], abs=1e-9)
    assert result["pq_stuff"] / 100 == pytest.approx(expected["Stuff"]["pq"], abs=1e-9)
    for label in CITYSCAPES19.labels:
        counts = statistics[label.label_id]
        if counts.tp + counts.fp + counts.fn:
            mine = result["per_class"][label.name]
            assert (mine["tp"], mine["fp"], mine["fn"]) == (counts.tp, counts.fp, counts.fn)
            official_pq = expected["per_class"][label.label_id]["pq"]
            assert mine["pq"] / 100 == pytest.approx(official_pq, abs=1e-9)
        else:
            assert label.name not in result["per_class"]


def test_the_official_command_reads_our_files(split, tmp_path):
    truth_json, results_json, truth, predictions = split
    command = [sys.executable, "-m", csEval.__name__, "--gt-json-file", truth_json]
    command += ["--prediction-json-file", results_json, "--results_file", tmp_path / "pq.json"]
    subprocess.run(command, check=True, capture_output=True)
    expected = json.loads((tmp_path / "pq.json").read_text())["All"]["pq"]
    assert ours(truth, predictions)["pq"] / 100 == pytest.approx(expected, abs=1e-9)


def test_truth_is_perfect_and_ego_vehicle_is_void():
    ids = np.full((20, 20), 7, np.int32)
    ids[15:] = 1
    spill = np.where(ids == 1, 7, ids)  # a road that runs over the ego vehicle
    assert ours([ids], [ids])["pq"] == 100.0
    assert ours([ids], [spill])["pq"] == 100.0
    assert list(ours([ids], [ids])["per_class"]) == ["road"]
    assert np.isnan(ours([ids], [ids])["pq_things"])


def test_a_prediction_half_on_void_is_wrong_and_more_than_half_is_forgiven():
    true = np.full((10, 10), 7, np.int32)
    true[:, 5:] = 0
    for columns, fp in ((slice(4, 6), 1), (slice(4, 7), 0)):
        predicted = np.where(true == 7, 7, 0)
        predicted[:, columns] = 26001
        result = ours([true], [predicted])
        assert result["per_class"].get("car", {"fp": 0})["fp"] == fp


def by_pixel(predicted_HW, true_HW, labels):
    """The tally of one image by the definition of overlap, pixel for pixel."""
    found = []
    for ids_HW in (predicted_HW, true_HW):
        ids, index_N = np.unique(ids_HW, return_inverse=True)
        slow = segments(ids, labels)
        found.append(Segments(index_N.ravel(), slow.ids, slow.category, slow.crowd))
    return match(*found, np.ones(true_HW.size, np.int64), 255)


@pytest.mark.parametrize("order", ["as drawn", "shuffled", "one value"])
def test_counting_runs_is_counting_pixels(order):
    rng = np.random.default_rng(7)
    true = random_truth(rng)
    predicted = damaged(rng, true)
    if order == "shuffled":  # hardly a run is longer than a pixel
        predicted = rng.permutation(predicted.ravel()).reshape(true.shape)
    elif order == "one value":
        predicted, true = np.full_like(true, 7), np.full_like(true, 26001)
    quality, iou = PanopticQuality(CITYSCAPES20), SemanticIoU(CITYSCAPES20)
    fast, slow = quality.update(predicted, true), by_pixel(predicted, true, CITYSCAPES20)
    assert all(np.array_equal(x, vars(slow)[name]) for name, x in vars(fast).items())

    classes = [class_of_instance_id(CITYSCAPES20)[ids] for ids in (predicted, true)]
    iou.update(*classes)
    expected = np.zeros((256, 256), np.int64)
    np.add.at(expected, (classes[1].ravel(), classes[0].ravel()), 1)
    assert np.array_equal(iou.confusion, expected)


def test_a_frame_takes_less_than_sorting_its_pixels_does():
    """At 1024 x 2048 the sort alone was two thirds of 758 ms."""
    rng = np.random.default_rng(7)
    size = (512, 1024)
    true = cv2.resize(random_truth(rng).astype(np.uint16), size[::-1], interpolation=0)
    true = true.astype(np.int32)
    class_HW = class_of_instance_id(CITYSCAPES20)[true]
    panoptic = np.where(class_HW == 255, -1, class_HW.astype(np.int32) * 1000 + true % 7)
    metric = PanopticMetric(CITYSCAPES20, "val")

    def seconds(call):
        times = []
        for _ in range(5):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
        return min(times)

    result = {"panoptic": panoptic, "class": class_HW}
    whole = seconds(lambda: metric.update({"instance_ids": true}, result))
    assert whole < seconds(lambda: np.unique(true, return_inverse=True)) / 2


# --- published values -----------------------------------------------------------------------------

CLASS_OF_COLOR = {(0, 0, 0): 0, (0, 0, 255): 1, (255, 0, 0): 2, (0, 255, 0): 3}
CLASS_OF_COLOR |= {(255, 0, 255): 4, (0, 255, 255): 5, (255, 255, 0): 6}
TEAM = {0: 0, 198: 2} | dict.fromkeys((47, 97, 133, 150, 174, 215, 244, 255), 1)
CLASS_OF_GRAY = {"bird": {92: 5, 176: 3, 255: 4}, "cat": {0: 0, 255: 6}, "team": TEAM}


def with_divisor(class_HW, instance_HW, divisor):
    """Segments of class * divisor + instance, class 0 being void."""
    ids, index_HW = np.unique(class_HW.astype(int) * divisor + instance_HW, return_inverse=True)
    category = np.where(ids // divisor == 0, VOID, ids // divisor)
    return Segments(index_HW.ravel(), ids, category, np.zeros(len(ids), bool))


def published_image(name, divisor):
    def read(file):
        image = cv2.imread(str(PUBLISHED / file), cv2.IMREAD_COLOR)
        assert image is not None
        return image[..., ::-1]

    suffix = "_instance" if name == "team" else ""
    gray = read(f"{name}_gt{suffix}.png")[..., 0]
    true_class = np.vectorize(CLASS_OF_GRAY[name].get)(gray)
    colors = read(f"{name}_pred_class.png")
    predicted_class = np.zeros(gray.shape, int)
    for color, label in CLASS_OF_COLOR.items():
        predicted_class[(colors == color).all(2)] = label
    instance = cv2.cvtColor(read(f"{name}_pred_instance.png"), cv2.COLOR_RGB2GRAY)
    return with_divisor(predicted_class, instance, divisor), with_divisor(true_class, gray, divisor)


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="a clone without the shared sample data")
@pytest.mark.parametrize(
    ("names", "classes", "divisor", "expected"),
    [
        (["team"], 3, 1000, (0.62156284, 0.64664984, 0.9666667, 4, 0.5, 0)),
        (["bird", "cat", "team"], 7, 256, (0.76855499, 0.7769174, 0.98888892, 2, 1 / 6, 0)),
    ],
    ids=["team", "three"],
)
def test_published_values_of_deeplab2(names, classes, divisor, expected):
    tally = Tally.zero(classes)
    for name in names:
        predicted, true = published_image(name, divisor)
        tally += match(predicted, true, np.ones(len(true.index_R), np.int64), classes)
    present = tally.present
    means = [*tally.quality()[present].mean(0)]
    means += [counts[present].mean() for counts in (tally.tp, tally.fn, tally.fp)]
    assert means == pytest.approx(expected, abs=1e-7)


# --- beside panoptic quality ----------------------------------------------------------------------


def test_semantic_iou_by_hand():
    road, sky, ego = (CITYSCAPES20.index(name) for name in ("road", "sky", "ego vehicle"))
    car = CITYSCAPES20.index("car")
    true = np.array([[road, road, road, road], [sky, sky, 255, ego]], np.uint8)
    predicted = np.array([[road, road, sky, ego], [sky, sky, car, road]])
    iou = SemanticIoU(CITYSCAPES20)
    iou.update(predicted, true)
    result = iou.compute()
    # on void and ego vehicle anything goes; road taken for ego vehicle is a miss of road
    assert result["per_class"]["road"]["iou"] == pytest.approx(100 * 2 / 4)
    assert result["per_class"]["sky"]["iou"] == pytest.approx(100 * 2 / 3)
    assert result["miou"] == pytest.approx(100 * (2 / 4 + 2 / 3) / 2)
    assert set(result["per_class"]) == {"road", "sky"}


def test_the_two_deltas_differ_in_sign_and_in_the_weight_of_a_task():
    higher = {"pq": True, "abs_rel": False, "rmse": False}
    task_of = {"pq": "panoptic", "abs_rel": "depth", "rmse": "depth"}
    baseline = {"pq": 40.0, "abs_rel": 0.2, "rmse": 10.0}
    values = {"pq": 44.0, "abs_rel": 0.21, "rmse": 11.0}  # +10 %, -5 %, -10 %
    assert delta_flat(values, baseline, higher) == pytest.approx(5 / 3)
    assert delta_task(values, baseline, higher, task_of) == pytest.approx((10 - 7.5) / 2)
    assert delta_flat(baseline, baseline, higher) == 0
    with pytest.raises(ValueError, match="baseline of 'pq' is 0"):
        delta_flat(values, {**baseline, "pq": 0.0}, higher)
