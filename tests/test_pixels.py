"""What numpy and OpenCV do on the CPU against what torch does elsewhere, and against loops."""

import cv2
import pytest
import torch

from mtl_bench.tasks.panoptic import pixels

SIZES = [(1, 1, 1), (1, 9, 1), (3, 1, 7), (2, 23, 17)]


@pytest.fixture(params=SIZES, ids=str)
def values(request):
    generator = torch.Generator().manual_seed(0)
    values = torch.randint(0, 256, request.param, dtype=torch.uint8, generator=generator)
    return torch.where(values > 240, values, values % 5)  # some few, and the highest


def by_torch(monkeypatch, call):
    with monkeypatch.context() as patch:
        patch.setattr(pixels, "_by_torch", lambda map_: True)
        return call()


def test_where(values, monkeypatch):
    mask = values == 3
    found = pixels.where(mask)
    assert found.dtype == torch.int64
    assert found.tolist() == [i for i, true in enumerate(mask.flatten().tolist()) if true]
    assert torch.equal(found, by_torch(monkeypatch, lambda: pixels.where(mask)))


def test_equal(values, monkeypatch):
    found = pixels.equal(values, 251)
    assert found.dtype == torch.bool
    assert found.tolist() == [[[v == 251 for v in row] for row in i] for i in values.tolist()]
    assert torch.equal(found, by_torch(monkeypatch, lambda: pixels.equal(values, 251)))


def test_areas(values, monkeypatch):
    found = pixels.areas(values)
    assert found.dtype == torch.int64
    expected = [[image.count(v) for v in range(256)] for image in values.flatten(1).tolist()]
    assert found.tolist() == expected
    assert torch.equal(found, by_torch(monkeypatch, lambda: pixels.areas(values)))


def test_look_up(values, monkeypatch):
    generator = torch.Generator().manual_seed(1)
    table = torch.randint(-(2**30), 2**30, (len(values), 256), generator=generator).int()
    found = pixels.look_up(table, values)
    assert found.dtype == torch.int32
    assert found.shape == values.shape
    for image, row, result in zip(values, table.tolist(), found.flatten(1).tolist(), strict=True):
        assert result == [row[value] for value in image.flatten().tolist()]
    assert torch.equal(found, by_torch(monkeypatch, lambda: pixels.look_up(table, values)))


@pytest.mark.parametrize("kernel", [1, 3, 7])
@pytest.mark.parametrize("strip", [1, 2, 64])
@pytest.mark.parametrize("plateaus", [True, False])
def test_peaks(values, monkeypatch, kernel, strip, plateaus):
    monkeypatch.setattr(pixels, "STRIP", strip)
    generator = torch.Generator().manual_seed(2)
    heat = torch.randn(values[:, None].shape, generator=generator) - 0.5
    heat = heat.round() if plateaus else heat
    expected = torch.zeros_like(heat, dtype=torch.bool)
    reach = kernel // 2
    for image, _, y, x in (heat > -0.6).nonzero().tolist():
        rows, columns = (slice(max(at - reach, 0), at + reach + 1) for at in (y, x))
        expected[image, 0, y, x] = heat[image, 0, y, x] == heat[image, 0, rows, columns].max()
    assert torch.equal(pixels.peaks(heat, kernel, -0.6), expected)
    by_pooling = by_torch(monkeypatch, lambda: pixels.peaks(heat, kernel, -0.6))
    assert torch.equal(by_pooling, expected)


def test_a_threshold_is_compared_in_float32():
    heat = torch.tensor([[[[0.3]]]])  # as float64 it is above 0.3
    assert not pixels.peaks(heat, 3, 0.3).any()


def test_threads_are_torchs():
    for threads in (1, 2):
        torch.set_num_threads(threads)
        pixels.areas(torch.zeros(1, 4, 4, dtype=torch.uint8))
        assert cv2.getNumThreads() == threads


def test_maps_that_need_gradients_are_read_as_well():
    heat = torch.rand(1, 1, 5, 6, requires_grad=True)
    assert pixels.peaks(heat, 3, 0.0).any()
