"""A row is timed as it is evaluated: with the ground of its data set, and the calibrated camera."""

from dataclasses import replace

import cityscapes_tree
import kitti_tree
import pytest
import torch
from torch import nn

from mtl_bench.bench import stored
from mtl_bench.bench.stored import time_cell
from mtl_bench.core.batch import collate
from mtl_bench.core.config import Cell, Latency, load_recipe
from mtl_bench.core.device import Compute
from mtl_bench.core.labels import GROUND
from mtl_bench.core.locks import Quiet
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate.walk import predict
from mtl_bench.model import Outputs
from mtl_bench.tasks.depth.scale import ROAD

CPU = torch.device("cpu")


class Net(nn.Module):
    """Road in the lower half, nearer on its right; every other class above, in stripes."""

    def __init__(self, classes: int, road: int) -> None:
        super().__init__()
        self.classes, self.road = classes, road

    def forward(self, image_B3HW):
        count, _, height, width = image_B3HW.shape
        class_HW = (torch.arange(width) % self.classes).expand(height, -1).clone()
        class_HW[height // 2 :] = self.road
        logits = nn.functional.one_hot(class_HW, self.classes).permute(2, 0, 1).float()
        inverse = torch.linspace(0.1, 0.9, height)[:, None] * torch.linspace(1, 3, width)
        nothing = torch.zeros(count, 1, height, width)
        panoptic = {
            "semantic": logits.expand(count, -1, -1, -1),
            "center": nothing,
            "offset": nothing.repeat(1, 2, 1, 1),
        }
        depth = {"inverse": inverse.expand(count, 1, -1, -1)}
        return Outputs({"panoptic": panoptic, "depth": depth})


class Fixed(nn.Module):
    """A model of that net."""

    def __init__(self, cell: Cell) -> None:
        super().__init__()
        self.tasks = tasks_of_cell(cell)
        labels = self.tasks[0].labels
        self.net = Net(len(labels), labels.index("road"))


@pytest.fixture(params=["kitti", "cityscapes"])
def cell_and_root(request, tmp_path):
    recipe = load_recipe("kitti-smoke" if request.param == "kitti" else "smoke")
    tree = kitti_tree if request.param == "kitti" else cityscapes_tree
    data = replace(recipe.data, dataset=request.param, height=tree.HEIGHT, width=tree.WIDTH)
    recipe = replace(recipe, data=data, latency=Latency(passes=2, warmup=0))
    root = tmp_path / request.param
    if request.param == "kitti":
        kitti_tree.write_tree(root)
    else:
        cityscapes_tree.write_tree(root, 2, "val")
    return Cell(recipe, "none", "none"), root


def test_the_depth_scale_is_timed_as_it_is_evaluated(cell_and_root, tmp_path):
    cell, root = cell_and_root
    model = Fixed(cell)
    panoptic, depth = model.tasks
    classes = {"kitti": 19, "cityscapes": 20}[cell.recipe.data.dataset]
    assert len(depth.labels) == classes
    assert depth.labels.of_role(GROUND) == (panoptic.labels.index("road"),)

    seen, finish = [], depth.finish

    def spy(maps, camera, done, size=None):
        found = finish(maps, camera, done, size)
        seen.append((camera, set(done), found))
        return found

    depth.finish = spy
    (tmp_path / "runs").mkdir()
    time_cell(model, cell, root, Compute(CPU), Quiet(tmp_path / "runs"))
    timed = list(seen)
    assert len(timed) >= 2

    split = cell.recipe.evaluate.split
    samples = open_samples(cell.recipe, model.tasks, split, root, training=False)
    batch = collate([samples.sample(0, None)])
    with torch.inference_mode():
        evaluated = predict(model, batch, model.tasks)["depth"]
    assert batch.camera.pitch_rad_B.item() == pytest.approx(0.038 if classes == 20 else 0)
    assert evaluated["source"].tolist() == [ROAD]
    assert evaluated["scale"].isfinite().all()
    for camera, done, found in timed:
        assert done == {"panoptic"}
        for name, value in vars(batch.camera).items():
            assert torch.equal(getattr(camera, name), value), name
        for name, value in evaluated.items():
            assert torch.equal(found[name], value), name


def test_a_cell_is_timed_on_the_threads_that_are_quickest(cell_and_root, tmp_path, monkeypatch):
    cell, root = cell_and_root
    took_ms, timed = {1: 3.0, 2: 2.0, 4: 5.0, 6: 9.0}, []

    def measured(model, images, camera, latency, device, precision):
        threads = torch.get_num_threads()
        timed.append((threads, latency.passes))
        return {"latency.p50_ms": took_ms[threads], "latency.threads": threads}

    before = torch.get_num_threads()
    monkeypatch.setattr(stored, "measure", measured)
    monkeypatch.setattr(stored.provenance, "cores", lambda: 6)
    (tmp_path / "runs").mkdir()
    timing, _ = time_cell(Fixed(cell), cell, root, Compute(CPU), Quiet(tmp_path / "runs"))
    assert timed == [(1, 10), (2, 10), (4, 10), (6, 10), (2, cell.recipe.latency.passes)]
    assert timing == {"latency.p50_ms": 2.0, "latency.threads": 2}
    assert torch.get_num_threads() == before


def test_one_core_is_not_tried():
    assert stored.quickest(1, lambda count: pytest.fail("timed")) == 1
