"""Grouping against a plain reference with loops, and the depth scale on planes of known height."""

import importlib.util
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from mtl_bench.core import config
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import tasks_of
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.tasks import pixels
from mtl_bench.tasks.depth import scale as depth_scale
from mtl_bench.tasks.depth.scale import dgc_scale
from mtl_bench.tasks.panoptic import grouping
from mtl_bench.tasks.panoptic.metrics import PanopticQuality
from mtl_bench.tasks.panoptic.targets import panoptic_targets

THINGS = CITYSCAPES20.things
ROAD, SKY, PERSON, CAR = (CITYSCAPES20.index(name) for name in ("road", "sky", "person", "car"))


def settings(**changes) -> config.Evaluate:
    return config.Evaluate(**{"stuff_area": 0, "nms_kernel": 3, **changes})


def reference(class_HW, heat_HW, offset_2HW, things, ev):
    """The rules, pixel by pixel."""
    height, width = class_HW.shape
    reach = ev.nms_kernel // 2
    peaks = []
    for y in range(height):
        for x in range(width):
            window = heat_HW[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            if heat_HW[y, x] > np.float32(ev.center_threshold) and heat_HW[y, x] == window.max():
                peaks.append((y, x))
    highest = sorted(peaks, key=lambda p: (-heat_HW[p], p))[: ev.top_k]
    centers = sorted(highest)

    result = np.empty((height, width), np.int64)
    members = {}
    for y in range(height):
        for x in range(width):
            result[y, x] = -1 if class_HW[y, x] == IGNORE else class_HW[y, x] * 1000
            if class_HW[y, x] in things and centers:
                at_y = np.float32(y) + offset_2HW[0, y, x]
                at_x = np.float32(x) + offset_2HW[1, y, x]
                distances = [(at_y - cy) ** 2 + (at_x - cx) ** 2 for cy, cx in centers]
                members.setdefault(int(np.argmin(distances)), []).append((y, x))
    for index, members_of in members.items():
        votes = Counter(class_HW[pixel] for pixel in members_of)
        winner = min(votes, key=lambda c: (-votes[c], c))
        for pixel in members_of:
            result[pixel] = winner * 1000 + index + 1
    for label in range(len(CITYSCAPES20)):
        area = (class_HW == label).sum()
        if label not in things and area < ev.stuff_area:
            result[class_HW == label] = -1
    return result


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "ev",
    [
        settings(),
        settings(center_threshold=0.8, nms_kernel=5, stuff_area=12),
        settings(top_k=3),
        settings(center_threshold=1.0),  # strict: no centers, although heat reaches 1
    ],
    ids=["plain", "filters", "top_k", "no_centers"],
)
def test_equals_the_rules_on_random_maps_full_of_ties(seed, ev):
    rng = np.random.default_rng(seed)
    shape = (3, 15, 18)
    classes = rng.choice([ROAD, SKY, PERSON, CAR, THINGS[-1], IGNORE], size=shape).astype(np.int64)
    classes[2][np.isin(classes[2], THINGS)] = ROAD  # an image without things
    heat = (rng.integers(0, 5, shape) / 4).astype(np.float32)  # plateaus, equal peaks
    heat[0] *= seed % 2  # half of the time an image without centers beside others that have some
    offset = rng.integers(-4, 5, (3, 2, 15, 18)).astype(np.float32) / 2  # equal distances
    result = grouping.panoptic(
        torch.from_numpy(classes),
        torch.from_numpy(heat)[:, None],
        torch.from_numpy(offset),
        THINGS,
        ev,
    )
    expected = [reference(*image, THINGS, ev) for image in zip(classes, heat, offset, strict=True)]
    np.testing.assert_array_equal(result.numpy(), np.stack(expected))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (2, 3)])
@pytest.mark.parametrize("kernel", [1, 3, 7])
def test_images_smaller_than_the_window(size, kernel):
    rng = np.random.default_rng(kernel)
    for _ in range(10):
        classes = rng.choice([ROAD, CAR, PERSON, IGNORE], size=(2, *size)).astype(np.int64)
        heat = (rng.integers(0, 4, (2, *size)) / 3).astype(np.float32)
        offset = rng.normal(0, 2, (2, 2, *size)).astype(np.float32)
        ev = settings(nms_kernel=kernel)
        result = grouping.panoptic(
            torch.from_numpy(classes),
            torch.from_numpy(heat)[:, None],
            torch.from_numpy(offset),
            THINGS,
            ev,
        )
        images = zip(classes, heat, offset, strict=True)
        expected = [reference(*image, THINGS, ev) for image in images]
        np.testing.assert_array_equal(result.numpy(), np.stack(expected))


def test_nothing_but_void():
    nothing = torch.zeros(2, 2, 6, 6)
    classes = torch.full((2, 6, 6), IGNORE)
    result = grouping.panoptic(classes, nothing[:, :1] + 1, nothing, THINGS, settings())
    assert (result == grouping.VOID).all()


def test_a_batch_is_its_images():
    generator = torch.Generator().manual_seed(0)
    classes = torch.randint(0, len(CITYSCAPES20), (5, 20, 30), generator=generator)
    heat = torch.rand(5, 1, 20, 30, generator=generator)
    heat[2] = 0.1
    offset = 3 * torch.randn(5, 2, 20, 30, generator=generator)
    ev = settings(top_k=6, stuff_area=30)
    batch = grouping.panoptic(classes, heat, offset, THINGS, ev)
    for i in range(5):
        maps = (classes[i : i + 1], heat[i : i + 1], offset[i : i + 1])
        assert torch.equal(grouping.panoptic(*maps, THINGS, ev), batch[i : i + 1])


def test_the_stuff_filter_of_an_exported_graph_is_the_same():
    generator = torch.Generator().manual_seed(0)
    classes = torch.randint(0, len(CITYSCAPES20), (3, 9, 14), generator=generator)
    classes[0, 0] = IGNORE
    counted = grouping._stuff(grouping.classes(classes), THINGS, 6)
    assert torch.equal(counted, grouping._stuff_by_class(classes.int(), THINGS, 6))
    assert {0, 1000, grouping.VOID} < set(counted.unique().tolist())


def test_members_may_be_any_classes():
    classes = torch.arange(256)
    for chosen in ((0,), (255,), (3, 1, 2, 9), (0, 1, 254, 255), THINGS):
        for dtype in (torch.uint8, torch.int32, torch.int64):
            found = pixels.member(classes.to(dtype), chosen)
            assert found.nonzero()[:, 0].tolist() == sorted(chosen)


def load_benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "postprocess.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_postprocess", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # then the process' own time is taken: the machine may be busy
    yield
    torch.set_num_threads(threads)


def test_200_instances_take_no_twice_the_time_of_5_and_little_memory(one_thread):
    benchmark = load_benchmark()
    few, many = (benchmark.scene(count) for count in (5, 200))
    with torch.inference_mode():
        assert benchmark.whole(*many)["panoptic"].unique().numel() > 150
        times = [
            [benchmark.milliseconds(lambda s=scene: benchmark.whole(*s)) for scene in (few, many)]
            for _ in range(5)
        ]
        best_few, best_many = (min(column) for column in zip(*times, strict=True))
        assert best_many < 2 * best_few
        parts = benchmark.steps(many, config.Evaluate())
        nearest, table = (
            min(benchmark.milliseconds(parts[name]) for _ in range(3))
            for name in ("- nearest", "(table)")
        )
        assert nearest < 0.5 * table
        assert benchmark.peak_mib(lambda: benchmark.whole(*many)) < 200


def test_logits_are_the_same_as_their_classes():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, len(CITYSCAPES20), 9, 11, generator=generator)
    heat = torch.rand(2, 1, 9, 11, generator=generator)
    offset = torch.randn(2, 2, 9, 11, generator=generator)
    results = [
        grouping.panoptic(semantic, heat, offset, THINGS, settings())
        for semantic in (logits, logits.argmax(1))
    ]
    assert torch.equal(*results)


def test_the_least_areas_are_kept():
    classes = torch.full((1, 6, 6), ROAD)
    classes[0, 0, :4] = SKY
    nothing = torch.zeros(1, 2, 6, 6)
    for least, expected in ((4, SKY * 1000), (5, -1)):
        ev = settings(stuff_area=least)
        result = grouping.panoptic(classes, nothing[:, :1], nothing, THINGS, ev)
        assert result[0, 0, 0] == expected
        assert result[0, 5, 5] == ROAD * 1000


def test_equal_neighbours_are_both_centers():
    heat = torch.zeros(1, 1, 12, 20)
    heat[0, 0, 4, 3:5] = 1.0
    heat[0, 0, 5, 6] = 0.9  # lower, and in their window
    heat[0, 0, 10, 18] = 0.9
    centers, count = grouping.find_centers(heat, settings(nms_kernel=5))
    assert count.tolist() == [3]
    assert centers.tolist() == [[[4, 3], [4, 4], [10, 18]]]


def test_instance_ids_are_cityscapes_own():
    panoptic = torch.tensor(
        [[[-1, ROAD * 1000, 0, CAR * 1000 + 7, CAR * 1000, PERSON * 1000 + 200]]]
    )
    ids = grouping.to_instance_ids(panoptic, CITYSCAPES20)
    assert ids.dtype == torch.int32
    assert ids.tolist() == [[[0, 7, 0, 26007, 26, 24200]]]


def test_truth_to_targets_to_grouping_is_perfect():
    ids = np.full((96, 160), 7, np.int32)
    ids[:30] = 23
    ids[90:] = 1  # ego vehicle
    for number, (y, x, label) in enumerate(
        [(20, 10, 24), (20, 40, 24), (50, 20, 26), (45, 90, 26), (60, 130, 33), (35, 135, 28)]
    ):
        ids[y : y + 14, x : x + 21] = label * 1000 + number
    ids[70:80, 60:80] = 26  # a crowd: has no center, so grouping gives it to a neighbour
    targets = panoptic_targets(ids, CITYSCAPES20, config.Loss(center_sigma=4))
    panoptic = grouping.panoptic(
        torch.from_numpy(targets.semantic)[None],
        torch.from_numpy(targets.center)[None, None],
        torch.from_numpy(targets.offset)[None],
        THINGS,
        settings(nms_kernel=7),
    )
    quality = PanopticQuality(CITYSCAPES20)
    predicted = grouping.to_instance_ids(panoptic, CITYSCAPES20)[0].numpy()
    predicted[ids == 26] = 0
    quality.update(predicted, ids)
    result = quality.compute()
    assert result["pq"] == result["sq"] == result["rq"] == 100.0
    assert set(result["per_class"]) == {"road", "sky", "person", "car", "bus", "bicycle"}


def test_resize_scales_offsets_and_keeps_linear_inverse_depth():
    panoptic, depth = tasks_of(Recipe(), ("panoptic", "depth"), CITYSCAPES20)
    rows = torch.linspace(0.1, 1.0, 8)[:, None].expand(8, 16)[None, None]
    maps = {"offset": torch.full((1, 2, 8, 16), 3.0), "center": rows}
    larger = panoptic.resized(maps, (16, 48))
    assert set(larger) == {"offset", "center"}
    assert torch.allclose(larger["offset"][0, 0], torch.tensor(6.0))
    assert torch.allclose(larger["offset"][0, 1], torch.tensor(9.0))
    column = depth.resized({"inverse": rows}, (16, 48))["inverse"][0, 0, 1:-1, 0]
    assert torch.allclose(column.diff(), torch.tensor(0.9 / 7 / 2), atol=1e-6)


# --- depth scale ----------------------------------------------------------------------------------

FOCAL, HEIGHT, WIDTH = 115.0, 64, 128


def plane(camera_m=1.4, pitch=0.0, height=HEIGHT, width=WIDTH):
    """True depth of a road below a pitched camera, 60 m of sky elsewhere; K; where the road is."""
    focal = FOCAL * width / WIDTH
    K = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    y = torch.arange(height)[:, None].expand(height, width)
    ray_y = (y - K[1, 2]) / focal
    rate = (math.cos(pitch) * ray_y + math.sin(pitch)) / camera_m
    road = rate > 1 / 60
    return torch.where(road, 1 / rate.clamp(min=1e-6), 60.0)[None, None], K[None], road[None]


@pytest.mark.parametrize("pitch", [0.0, 0.05, -0.03, 0.08])
@pytest.mark.parametrize("size", [(64, 128), (400, 900)], ids=["small", "subsampled"])
def test_scale_is_exact_on_a_plane(pitch, size):
    depth, K, road = plane(pitch=pitch, height=size[0], width=size[1])
    scale, source = dgc_scale(
        depth / 3.3, K, torch.tensor([1.4]), road, pitch_rad_B=torch.tensor([pitch])
    )
    assert source.tolist() == [depth_scale.ROAD]
    assert scale.item() == pytest.approx(3.3, rel=1e-4)


def test_a_pitch_that_is_not_told_is_taken_for_none():
    depth, K, road = plane(pitch=0.08)
    unknown, _ = dgc_scale(depth / 2, K, torch.tensor([1.4]), road)
    assert unknown.item() > 2.4


def test_scale_without_a_road_comes_from_horizontal_surfaces():
    depth, K, _ = plane(pitch=0.03)
    depth[..., :, 90:] = 9.0  # a wall that faces the camera
    for road in (None, torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)):
        scale, source = dgc_scale(
            depth / 0.7, K, torch.tensor([1.4]), road, pitch_rad_B=torch.tensor([0.03])
        )
        assert source.tolist() == [depth_scale.NORMALS]
        assert scale.item() == pytest.approx(0.7, rel=1e-4)


def test_each_image_has_its_own_scale_and_a_wall_has_none():
    depth, K, road = plane()
    batch = torch.cat([depth / 2, torch.full_like(depth, 9.0), depth / 4])
    masks = torch.cat([road, torch.zeros_like(road), road])
    heights = torch.tensor([1.4, 1.4, 2.8])
    scale, source = dgc_scale(batch, K.expand(3, 3, 3), heights, masks)
    assert source.tolist() == [depth_scale.ROAD, depth_scale.FAILED, depth_scale.ROAD]
    assert scale[[0, 2]].tolist() == pytest.approx([2.0, 8.0], rel=1e-4)
    assert scale[1].isnan()


def test_noise_and_wrong_road_pixels_move_the_scale_little():
    """Means over 20 draws; normals of neighbouring pixels are off by 13 % and more at 5 % noise."""
    depth, K, road = plane(pitch=0.02)
    depth, K, road = (x.expand(20, *x.shape[1:]) for x in (depth, K, road))
    generator = torch.Generator().manual_seed(0)
    noisy = depth * (1 + 0.1 * torch.randn(depth.shape, generator=generator))
    height = torch.full((20,), 1.4)
    scale, _ = dgc_scale(noisy, K, height, road, pitch_rad_B=torch.full((20,), 0.02))
    assert scale.mean().item() == pytest.approx(1.0, abs=0.02)
    assert scale.std().item() < 0.03

    noisy[..., 40:56, 10:40] *= 0.6  # a car that was taken for road
    scale, _ = dgc_scale(noisy, K, height, road, pitch_rad_B=torch.full((20,), 0.02))
    assert scale.mean().item() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("top_k", [0, 1000, 5000])
def test_more_instances_than_an_id_holds_are_refused(top_k):
    """Car 1000 of an image was the first truck: an id is a class * 1000 + a number."""
    with pytest.raises(ValueError, match=rf"'top_k' must be (>= 1|<= 999), not {top_k}"):
        settings(top_k=top_k)
    tasks_of(Recipe(evaluate=settings(top_k=999)), ("panoptic",), CITYSCAPES20)
