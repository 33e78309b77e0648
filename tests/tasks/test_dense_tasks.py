"""Classes, depth and normals: metrics against plain sums over all pixels, losses, no values."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.task import tasks_of
from mtl_bench.tasks import batch_mean

NAMES = ("semantic", "depth_supervised", "normals")
H, W, FRAMES, BATCH = 12, 16, 5, 2


def task_of(name, dataset="synthetic-nyuv2"):
    recipe = load_recipe("dense-smoke")
    recipe = replace(
        recipe,
        data=replace(recipe.data, dataset=dataset),
        optim=replace(recipe.optim, batch=BATCH),
    )
    (task,) = tasks_of(recipe, [name], dataset_of(recipe).labels)
    return task


def draw(seed=0):
    return np.random.default_rng(seed)


def measured(task, truths, results):
    metric = task.metrics()[0]
    for truth, result in zip(truths, results, strict=True):
        metric.update(truth, result)
    return metric.compute()


def test_classes_equal_scikit_learn():
    """Void pixels, and classes that the set lacks."""
    oracle = pytest.importorskip("sklearn.metrics")
    rng, task = draw(), task_of("semantic")
    true = rng.integers(0, 9, (FRAMES, H, W)).astype(np.int32)  # of 13 classes
    found = np.where(rng.random(true.shape) < 0.4, rng.integers(0, 9, true.shape), true)
    true[rng.random(true.shape) < 0.2] = IGNORE
    results = [{"class": frame.astype(np.uint8)} for frame in found]
    got = measured(task, [{"instance_ids": frame} for frame in true], results)
    valid = true != IGNORE
    assert got["segmentation.pixel_acc"] == pytest.approx(
        100 * oracle.accuracy_score(true[valid], found[valid])
    )
    per_class = oracle.jaccard_score(true[valid], found[valid], average=None)
    assert got["segmentation.miou"] == pytest.approx(100 * per_class.mean())
    assert got["segmentation.class.road.iou"] == pytest.approx(100 * per_class[0])
    assert "segmentation.class.motorcycle.iou" not in got


@pytest.mark.parametrize(
    ("dataset", "field"),
    [("synthetic-nyuv2", "depth_m"), ("synthetic-cityscapes-mtan", "inverse_depth")],
)
def test_depth_errors_are_over_all_pixels_of_the_set(dataset, field):
    rng, task = draw(), task_of("depth_supervised", dataset)
    assert task.needs == task.truth == {field}
    true = rng.uniform(0.5, 9, (FRAMES, H, W)).astype(np.float32)
    true[rng.random(true.shape) < 0.4] = 0
    true[1], true[4, 1:] = 0, 0  # a frame without any value, and one of few
    found = rng.uniform(0.5, 9, true.shape).astype(np.float32)
    got = measured(task, [{field: t} for t in true], [{"supervised": f} for f in found])
    valid = true > 0
    absolute = np.abs(found - true)[valid]
    assert got["depth_supervised.abs_err"] == pytest.approx(absolute.mean(), rel=1e-6)
    relative = absolute / true[valid]
    assert got["depth_supervised.rel_err"] == pytest.approx(relative.mean(), rel=1e-6)
    batches = [slice(0, 2), slice(2, 4), slice(4, 5)]
    means = [np.abs(found - true)[b][valid[b]].mean() for b in batches]
    legacy = got[f"depth_supervised.{batch_mean.KEY}.abs_err"]
    assert legacy == pytest.approx(np.mean(means), rel=1e-6)
    assert abs(legacy - absolute.mean()) > 0.01


def normals(rng, shape):
    vector = rng.normal(size=(shape[0], 3, *shape[1:]))
    return (vector / np.linalg.norm(vector, axis=1, keepdims=True)).astype(np.float32)


def test_angles_are_over_all_pixels_of_the_set():
    rng, task = draw(), task_of("normals")
    true = normals(rng, (FRAMES, H, W))
    found = true + 0.4 * normals(rng, (FRAMES, H, W))
    found = (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)
    none = rng.random((FRAMES, H, W)) < 0.3
    true.transpose(0, 2, 3, 1)[none] = 0
    true[0, :, 0, 0] = np.array([1, -1, 0]) / np.sqrt(2)  # a normal whose components sum to 0
    none[0, 0, 0] = False
    got = measured(task, [{"normals": t} for t in true], [{"normals": f} for f in found])
    cosine = np.einsum("nchw,nchw->nhw", true.astype(float), found)
    angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
    assert got["normals.mean"] == pytest.approx(angle[~none].mean(), rel=1e-6)
    assert got["normals.median"] == pytest.approx(np.median(angle[~none]), abs=1e-3)
    for key, limit in (("within_11", 11.25), ("within_22", 22.5), ("within_30", 30)):
        share = (angle[~none] < limit).mean()
        assert got[f"normals.{key}"] == pytest.approx(100 * share)
        assert 0 < share < 1
    medians = [np.median(angle[b][~none[b]]) for b in (slice(0, 2), slice(2, 4), slice(4, 5))]
    assert got[f"normals.{batch_mean.KEY}.median"] == pytest.approx(np.mean(medians))


def truth_of(name, rng):
    if name == "semantic":
        return {"instance_ids": rng.integers(0, 13, (H, W)).astype(np.int32)}
    if name == "normals":
        return {"normals": normals(rng, (1, H, W))[0]}
    return {"depth_m": rng.uniform(0, 9, (H, W)).astype(np.float32)}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("cut", [1, 2, 3])
def test_parts_of_a_split_add_up(name, cut):
    """Also the means over batches, where the cut goes through a batch."""
    rng, task = draw(), task_of(name)
    truths = [truth_of(name, rng) for _ in range(FRAMES)]
    size = (H, W)
    trivial = task.trivial(size)
    for truth in truths:
        trivial.add(truth)
    results = [
        {key: value[i].numpy() for key, value in trivial.result(FRAMES, size).items()}
        for i in range(FRAMES)
    ]
    whole = measured(task, truths, results)
    first, second = task.metrics()[0], task.metrics()[0]
    for i, (truth, result) in enumerate(zip(truths, results, strict=True)):
        (first if i < cut else second).update(truth, result)
    first.add(second.state())
    got = first.compute()
    assert got.keys() == whole.keys()
    for key in got:
        if batch_mean.KEY not in key or cut % BATCH == 0:
            assert got[key] == pytest.approx(whole[key])


@pytest.mark.parametrize("name", NAMES)
def test_nothing_valid_is_no_number(name):
    task = task_of(name)
    truth = {key: np.zeros_like(value) for key, value in truth_of(name, draw()).items()}
    if name == "semantic":
        truth = {"instance_ids": np.full((H, W), IGNORE, np.int32)}
    trivial = task.trivial((H, W))
    trivial.add(truth_of(name, draw()))
    result = {key: value[0].numpy() for key, value in trivial.result(1, (H, W)).items()}
    assert measured(task, [truth], [result]) == {}


@pytest.mark.parametrize("name", NAMES)
def test_losses_leave_out_what_has_no_value(name):
    """The loss is that of the valid pixels alone, and absent where there is none."""
    task, generator = task_of(name), torch.Generator().manual_seed(0)
    channels = {"semantic": 13, "depth_supervised": 1, "normals": 3}[name]
    raw = torch.randn(2, channels, H, W, generator=generator, requires_grad=True)
    rng = draw()
    field = {
        "semantic": torch.from_numpy(rng.integers(0, 13, (2, H, W)).astype(np.uint8)),
        "depth_supervised": torch.from_numpy(rng.uniform(1, 9, (2, H, W)).astype(np.float32)),
        "normals": torch.from_numpy(normals(rng, (2, H, W))),
    }[name]
    key = {"semantic": "class", "depth_supervised": "depth_m", "normals": "normals"}[name]
    nothing = IGNORE if name == "semantic" else 0

    def losses(maps, value):
        images = torch.zeros(2, 3, H, W)
        return task.losses({name: maps}, Batch(["a", "b"], images, fields={key: value}))

    half = field.clone()
    half[..., : W // 2] = nothing
    (cut,) = losses(raw[..., W // 2 :], field[..., W // 2 :]).values()
    (found,) = losses(raw, half).values()
    assert found.item() == pytest.approx(cut.item(), rel=1e-5)
    assert losses(raw, torch.full_like(field, nothing)) == {}


def test_depth_of_a_data_set_without_any_is_one_line():
    recipe = load_recipe("dense-smoke")
    dataset = dataset_of(recipe)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "fields", {"instance_ids": dataset.fields["instance_ids"]})
        with pytest.raises(ValueError, match=r"synthetic-nyuv2 has no depth: it has instance_ids"):
            tasks_of(recipe, ["depth_supervised"], dataset.labels)
