import time

import numpy as np
import pytest

from mtl_bench.core import config
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20, IGNORE
from mtl_bench.tasks.panoptic.targets import OUTSIDE, class_of_instance_id, panoptic_targets

LOSS = config.Loss()


def reference_scene():
    """Road, void on top, a person, a car and a crowd of cars."""
    ids = np.full((64, 96), 7, np.int32)
    ids[:10] = 0
    ids[20:31, 10:17] = 24001
    ids[28:60, 40:90] = 26000
    ids[15:22, 60:80] = 26
    return ids


def test_reference_values():
    targets = panoptic_targets(reference_scene(), CITYSCAPES20, LOSS)
    assert targets.center.sum() == pytest.approx(781.24335, abs=1e-3)
    assert targets.center_weight.sum() == 5044
    assert targets.offset_weight.sum() == 1677
    assert targets.semantic_weight.sum() == 9498
    assert targets.offset[:, 20, 10].tolist() == [5, 3]
    assert targets.offset[:, 28, 40].tolist() == [15.5, 24.5]


def test_heat_map_values_and_window():
    targets = panoptic_targets(reference_scene(), CITYSCAPES20, LOSS)
    assert targets.center[25, 13] == 1
    assert targets.center[44, 64] == 1  # 43.5 and 64.5, half to even
    assert targets.center[33, 13] == pytest.approx(0.60653, abs=1e-5)
    assert targets.center[49, 13] == pytest.approx(0.011109, abs=1e-6)
    assert targets.center[50, 13] == pytest.approx(0.0075757, abs=1e-6)
    assert targets.center[51, 13] == 0


def test_crowd_has_a_class_and_nothing_else():
    targets = panoptic_targets(reference_scene(), CITYSCAPES20, LOSS)
    crowd = np.s_[15:22, 60:80]
    assert (targets.semantic[crowd] == CITYSCAPES20.index("car")).all()
    assert (targets.semantic_weight[crowd] == 1).all()
    assert (targets.center_weight[crowd] == 0).all()
    assert (targets.offset_weight[crowd] == 0).all()
    assert (targets.offset[:, 15:22, 60:80] == 0).all()


def test_void_and_padding():
    ids = np.full((8, 9), 7, np.int32)
    ids[0] = 4  # static: a known label without a class
    ids[1] = 29003  # a caravan: an instance without a class
    ids[:, 8] = OUTSIDE
    targets = panoptic_targets(ids, CITYSCAPES20, LOSS)
    assert (targets.semantic[:2] == IGNORE).all()
    assert (targets.semantic[:, 8] == IGNORE).all()
    assert (targets.semantic_weight[:, :8] == 1).all()
    assert (targets.semantic_weight[:, 8] == 0).all()
    assert targets.center_weight.sum() == 6 * 8
    assert targets.center.max() == 0


def test_small_means_strictly_fewer_pixels():
    ids = np.full((20, 20), 7, np.int32)
    ids[:10, :10] = 24000
    for area, weight in ((100, 1), (101, 5)):
        loss = config.Loss(small_area=area, small_weight=5.0)
        targets = panoptic_targets(ids, CITYSCAPES20, loss)
        assert (targets.semantic_weight[:10, :10] == weight).all()
        assert targets.semantic_weight.sum() == 300 + 100 * weight


def test_overlapping_gaussians_take_the_maximum_and_stay_in_the_frame():
    ids = np.full((12, 30), 7, np.int32)
    ids[0, 0] = 24000
    ids[11, 4] = 24001
    targets = panoptic_targets(ids, CITYSCAPES20, config.Loss(center_sigma=2.0))
    y, x = np.mgrid[:12, :30]
    expected = np.zeros((12, 30))
    for cy, cx in ((0, 0), (11, 4)):
        square = (y - cy) ** 2 + (x - cx) ** 2
        inside = (abs(y - cy) <= 7) & (abs(x - cx) <= 7)
        expected = np.maximum(expected, np.where(inside, np.exp(-square / 8), 0))
    np.testing.assert_allclose(targets.center, expected, atol=1e-7)


def test_every_offset_ends_in_the_center_of_its_instance():
    ids = np.random.default_rng(0).choice([7, 24000, 26003, 33], (16, 24)).astype(np.int32)
    targets = panoptic_targets(ids, CITYSCAPES20, LOSS)
    y, x = np.mgrid[:16, :24]
    for instance in (24000, 26003):
        mask = ids == instance
        assert np.ptp((y + targets.offset[0])[mask]) < 1e-5
        assert (x + targets.offset[1])[mask].mean() == pytest.approx(x[mask].mean())


def test_class_table():
    table = class_of_instance_id(CITYSCAPES19)
    assert table[7] == table[7000] == 0
    assert table[26] == table[26000] == table[26999] == CITYSCAPES19.index("car")
    assert (table[[0, 1, 500, 999, 29, 29001, 34000, 65535]] == IGNORE).all()
    assert class_of_instance_id(CITYSCAPES20)[1] == 0  # ego vehicle


def test_fast_enough_for_training():
    ids = np.repeat(np.repeat(np.arange(24000, 24032).reshape(4, 8), 16, 0), 16, 1)
    ids = ids.astype(np.int32)
    panoptic_targets(ids, CITYSCAPES20, LOSS)
    best = np.inf
    for _ in range(20):
        start = time.perf_counter()
        panoptic_targets(ids, CITYSCAPES20, LOSS)
        best = min(best, time.perf_counter() - start)
    assert best < 5e-3  # about 0.5 ms on an idle core, 32 instances in 64x128


def test_many_segments_are_drawn_as_few_are(monkeypatch):
    random = np.random.default_rng(1)
    many = random.choice(np.arange(24000, 24400), (30, 40)).astype(np.int32)
    assert len(np.unique(many)) > 256  # more than a byte tells apart
    few = random.choice([7, 26, 24000, 26003, OUTSIDE], (30, 40)).astype(np.int32)
    expected = panoptic_targets(few, CITYSCAPES20, LOSS)
    monkeypatch.setattr("mtl_bench.tasks.panoptic.targets._BYTE", 0)
    for name, values in vars(panoptic_targets(few, CITYSCAPES20, LOSS)).items():
        assert np.array_equal(values, getattr(expected, name)), name
    targets = panoptic_targets(many, CITYSCAPES20, LOSS)
    y, x = np.mgrid[:30, :40]
    for instance in np.unique(many)[:20]:
        inside = many == instance
        assert (y + targets.offset[0])[inside].mean() == pytest.approx(y[inside].mean(), abs=1e-4)
        assert (x + targets.offset[1])[inside].mean() == pytest.approx(x[inside].mean(), abs=1e-4)
