"""The nearest of many centers, against a plain table of distances in float32."""

import numpy as np
import pytest
import torch

from mtl_bench.tasks.panoptic import grouping

SIZE = (96, 200)


def reference(point_2N, image_N, centers, count_B):
    """Every distance, in the arithmetic of one pixel after the other; argmin takes the first."""
    result = np.zeros(len(image_N), np.int64)
    for n, image in enumerate(image_N):
        center_K2 = centers[image][: count_B[image]]
        if len(center_K2):
            dy = point_2N[0, n] - center_K2[:, 0]
            dx = point_2N[1, n] - center_K2[:, 1]
            result[n] = np.argmin(dy * dy + dx * dx)
    return result


def check(point_2N, centers_BK2, count_B, image_N=None, size=SIZE):
    point_2N, centers_BK2 = (np.asarray(x, np.float32) for x in (point_2N, centers_BK2))
    image_N = np.zeros(point_2N.shape[1], np.int64) if image_N is None else image_N
    got = grouping.nearest(
        *(torch.from_numpy(np.ascontiguousarray(x)) for x in (point_2N, image_N, centers_BK2)),
        torch.tensor(count_B),
        size,
    ).numpy()
    has_center = np.asarray(count_B)[image_N] > 0
    expected = reference(point_2N, image_N, centers_BK2, count_B)
    np.testing.assert_array_equal(got[has_center], expected[has_center])
    assert ((got >= 0) & (got < centers_BK2.shape[1])).all()


def centers_in(rng, count, size=SIZE):
    """Distinct pixels in reading order."""
    pixel = np.sort(rng.choice(size[0] * size[1], count, replace=False))
    return np.stack([pixel // size[1], pixel % size[1]], 1)


@pytest.mark.parametrize("count", [1, 2, 5, 60, 200])
@pytest.mark.parametrize("spread", [1, 30, 1e4, 1e7, 1e12])
def test_points_anywhere(count, spread):
    rng = np.random.default_rng(count)
    point = rng.normal(0, spread, (2, 3000)) + np.array([[48], [100]])
    check(point, centers_in(rng, count)[None], [count])


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_points_full_of_ties(scale):
    """Points on a lattice between centers on a lattice: every second point is a tie."""
    rng = np.random.default_rng(scale)
    y, x = np.mgrid[0:96:8, 0:200:8]
    lattice = np.stack([y.ravel(), x.ravel()], 1)
    point = rng.integers(-100, 300, (2, 6000)) / scale
    check(point, lattice[None], [len(lattice)])
    check(point, centers_in(rng, 150)[None], [150])


@pytest.mark.parametrize("outlier", [False, True])
def test_centers_in_one_place(outlier):
    """A plateau of the heat map: neighbouring pixels, all of them centers."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[40:50, 90:110]
    plateau = np.stack([y.ravel(), x.ravel()], 1)
    if outlier:
        plateau[0] = 2, 3
    for point in (
        rng.uniform(35, 115, (2, 2000)),
        rng.uniform(-500, 700, (2, 2000)),
        rng.integers(80, 230, (2, 2000)) / 2,
    ):
        check(point, plateau[None], [len(plateau)])


def test_equal_centers_give_the_first():
    twice = np.repeat(np.array([[10, 20], [50, 150], [80, 30]]), 3, axis=0)
    check(np.random.default_rng(0).uniform(-50, 250, (2, 1000)), twice[None], [9])


def test_images_have_their_own_centers():
    rng = np.random.default_rng(1)
    count_B = [7, 0, 3, 1]
    centers = np.full((4, 7, 2), np.inf)
    for image, count in enumerate(count_B):
        centers[image, :count] = centers_in(rng, count)
    image_N = np.sort(rng.integers(0, 4, 4000))
    check(rng.uniform(-20, 210, (2, 4000)), centers, count_B, image_N)


def test_nothing_to_do():
    check(np.zeros((2, 0)), np.full((1, 1, 2), np.inf), [0])
    check(np.zeros((2, 0)), centers_in(np.random.default_rng(0), 5)[None], [5])
    check(np.ones((2, 4)), np.full((2, 3, 2), np.inf), [0, 0])


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 1), (1024, 2048), (4000, 30)])
def test_sizes(size):
    rng = np.random.default_rng(2)
    count = min(20, size[0] * size[1])
    point = rng.uniform(-0.2, 1.2, (2, 3000)) * np.array(size)[:, None]
    check(point, centers_in(rng, count, size)[None], [count], size=size)


def test_what_is_not_finite_harms_no_other_point():
    point = np.full((2, 5), 30.0)
    point[0, 1], point[1, 2], point[0, 3] = np.nan, np.inf, -np.inf
    check(point, centers_in(np.random.default_rng(3), 9)[None], [9])


def test_lists_are_short():
    """The point of it all: most points have one candidate, whatever the number of centers."""
    rng = np.random.default_rng(4)
    centers_1K2 = torch.from_numpy(centers_in(rng, 200, (1024, 2048))[None].astype(np.float32))
    is_center = torch.ones(1, 200, 1, dtype=torch.bool)
    levels = grouping._levels(centers_1K2, is_center, (1024, 2048))
    _, length_M, _ = grouping._candidates(centers_1K2, torch.tensor([200]), levels)
    in_image = torch.from_numpy(rng.uniform(0, 1, (2, 10000)).astype(np.float32))
    in_image *= torch.tensor([[1024.0], [2048.0]])
    length_N = length_M[grouping._cells(in_image, levels)]
    assert length_N.float().mean() < 2.5
    assert length_N.max() < 12
