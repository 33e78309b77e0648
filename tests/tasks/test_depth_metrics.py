"""Depth errors: values computed with the original evaluation code, masks, crops and counting."""

import numpy as np
import pytest

from mtl_bench.core import config
from mtl_bench.tasks.depth.metrics import (
    NAMES,
    DepthErrors,
    depth_errors,
    evaluation_mask,
    median_scale,
)

EV = config.Evaluate()
TRUE = np.array([[2, 5, 10, 40, 79.9]])
PREDICTED = np.array([[2.2, 4, 12, 30, 90]])


def test_reference_values():
    errors = depth_errors(PREDICTED, TRUE, evaluation_mask(TRUE, EV), EV)
    expected = (0.150250, 0.624025, 4.583667, 0.187019, 0.6, 1, 1)
    assert [errors[name] for name in NAMES] == pytest.approx(expected, abs=1e-6)


def test_reference_values_after_median_scaling():
    mask = evaluation_mask(TRUE, EV)
    ratio = median_scale(PREDICTED, TRUE, mask)
    errors = depth_errors(PREDICTED * ratio, TRUE, mask, EV)
    assert ratio == pytest.approx(0.833333, abs=1e-6)
    assert errors["abs_rel"] == pytest.approx(0.170599, abs=1e-6)
    assert errors["rmse"] == pytest.approx(7.096697, abs=1e-6)


def test_the_mask_is_strict_and_does_not_look_at_the_prediction():
    true = np.array([[0, 0.001, 0.0011, 79.99, 80, 500]])
    assert evaluation_mask(true, EV).tolist() == [[False, False, True, True, False, False]]


def test_garg_crop_of_a_kitti_frame():
    mask = evaluation_mask(np.full((375, 1242), 5.0), config.Evaluate(depth_crop="garg"))
    rows, columns = mask.any(1).nonzero()[0], mask.any(0).nonzero()[0]
    assert (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1) == (153, 371, 44, 1197)
    assert mask.sum() == (371 - 153) * (1197 - 44)


def test_images_weigh_alike_however_many_pixels_they_have():
    errors = DepthErrors(EV)
    errors.update(np.full((10, 10), 11.0), np.full((10, 10), 10.0))  # 100 pixels, 10 % off
    sparse = np.zeros((10, 10))
    sparse[0, 0] = 10.0
    errors.update(np.full((10, 10), 13.0), sparse)  # one pixel, 30 % off
    errors.update(np.full((10, 10), 1.0), np.zeros((10, 10)))  # none
    result = errors.compute()
    assert result["abs_rel"] == pytest.approx(0.2)
    assert result["images"] == 2
    assert errors.without_truth == 1
    assert DepthErrors(EV).compute() == {"images": 0}
