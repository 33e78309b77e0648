import multiprocessing
import os
import signal
import time
from itertools import islice

import cv2
import numpy as np
import pytest
import torch
from cityscapes_tree import HEIGHT, WIDTH, assert_same, file, open_tree, write_tree

from mtl_bench.core import config
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import loader
from mtl_bench.data.loader import eval_batches, train_batches
from mtl_bench.data.samples import Samples, open_samples


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_tree(tmp_path_factory.mktemp("data"), frames=7)


def take(dataset, count, **settings):
    return list(islice(train_batches(dataset, **{"batch_size": 3, "seed": 5, **settings}), count))


def test_batches_are_stacked(tree):
    (batch,) = take(open_tree(tree), 1)
    assert len(batch.names) == 3
    assert batch.image_B3HW.shape == (3, 3, HEIGHT, WIDTH)
    assert batch.camera.K_B33.shape == (3, 3, 3)
    assert batch.camera.height_m_B.shape == (3,)
    assert batch.fields["neighbours"].shape == (3, 2, 3, HEIGHT, WIDTH)
    assert batch.fields["clean_neighbours"].shape == (3, 2, 3, HEIGHT, WIDTH)
    assert batch.fields["reprojection_mask"].shape == (3, HEIGHT, WIDTH)
    assert batch.fields["reprojection_mask"].dtype == torch.bool
    assert batch.fields["semantic"].dtype == torch.int64
    assert batch.fields["center"].shape == (3, 1, HEIGHT, WIDTH)
    assert batch.fields["offset"].shape == (3, 2, HEIGHT, WIDTH)
    assert batch.image_B3HW.is_contiguous()


def test_a_batch_splits_into_consecutive_parts(tree):
    (batch,) = take(open_tree(tree), 1, batch_size=6)
    for size in (1, 2, 3, 6):
        parts = batch.split(size)
        assert [len(part.names) for part in parts] == [size] * (6 // size)
        assert [name for part in parts for name in part.names] == batch.names
        for name, whole in batch.tensors().items():
            assert torch.equal(torch.cat([part.tensors()[name] for part in parts]), whole), name
    assert "depth_m" not in batch.split(2)[1].fields
    for size in (4, 0, 7, -2):
        with pytest.raises(ValueError, match=rf"micro_batch = {size} does not divide a batch of 6"):
            batch.split(size)


def test_any_step_can_be_the_first(tree):
    dataset = open_tree(tree)
    batches = take(dataset, 6)
    for start in range(6):
        (again,) = take(open_tree(tree), 1, start_step=start)
        assert_same(batches[start], again)
    for one, two in zip(batches[2:], take(dataset, 4, start_step=2), strict=True):
        assert_same(one, two)


def test_epochs_are_permutations_and_differ(tree):
    names = [name for batch in take(open_tree(tree), 20) for name in batch.names]
    epochs = [names[start : start + 6] for start in range(0, 60, 6)]  # the seventh is dropped
    assert all(len(set(epoch)) == 6 for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 5
    assert len(set(names)) == 7


def test_seed_and_step_change_the_augmentation(tree):
    dataset = open_tree(tree)
    one, two = take(dataset, 1), take(dataset, 1, seed=6)
    assert one[0].names != two[0].names or not torch.equal(one[0].image_B3HW, two[0].image_B3HW)
    single = take(dataset, 30, batch_size=1)
    same = [batch.image_B3HW for batch in single if batch.names == single[0].names]
    assert len(same) > 1
    assert not torch.equal(same[0], same[1])


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_give_the_same_batches(tree, workers):
    settings = config.Augment(scales=(0.75, 1.0, 1.5), crop=(20, 30))
    dataset = open_tree(tree, augment=settings)
    here = take(dataset, 5, start_step=1)
    there = take(dataset, 5, start_step=1, workers=workers)
    for one, two in zip(here, there, strict=True):
        assert_same(one, two)


@pytest.mark.parametrize("workers", [0, 1])
def test_the_global_random_state_is_left_alone(tree, workers):
    before = torch.get_rng_state()
    take(open_tree(tree), 3, workers=workers)
    assert torch.equal(before, torch.get_rng_state())


def test_thread_count_changes_nothing(tmp_path):
    size = (200, 400)  # large enough for torch to split its loops
    write_tree(tmp_path, 2, size=size)
    settings = config.Augment(scales=(0.75, 1.25), crop=(180, 420))
    data = config.Data(height=size[0], width=size[1])
    dataset = open_tree(tmp_path, augment=settings, data=data)
    before = torch.get_num_threads()
    try:
        batches = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            batches.append(take(dataset, 4, batch_size=2))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(*batches, strict=True):
        assert_same(one, two)


def test_a_worker_of_a_process_that_used_opencvs_threads_starts():
    """As the video stage's does, after pseudo labels: it hung for good."""
    picture = np.zeros((2048, 4096, 3), np.uint8)
    cv2.resize(picture, (1000, 1000), interpolation=cv2.INTER_AREA)
    time.sleep(0.5)  # until the threads are asleep
    worker = multiprocessing.get_context("fork").Process(target=loader._one_thread, args=(0,))
    worker.start()
    worker.join(20)
    code = worker.exitcode
    worker.kill()
    assert code == 0


@pytest.mark.parametrize("workers", [0, 1])
def test_a_broken_file_is_one_line_from_any_process(tmp_path, workers):
    root = write_tree(tmp_path, 2)
    path = file(root, "leftImg8bit", "aachen_000000_000019", "leftImg8bit.png")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=f"^{path}: truncated PNG") as error:
        take(open_tree(root), 1, batch_size=2, workers=workers)
    assert "\n" not in str(error.value)


def test_workers_hand_over_shared_memory_sample_by_sample(tree):
    (batch,) = take(open_tree(tree), 1, workers=1)
    for value in batch.tensors().values():
        assert value.is_shared()
        assert value.is_contiguous()


def test_a_worker_that_the_system_ends_is_one_line(tree, monkeypatch):
    dataset = open_tree(tree)
    monkeypatch.setattr(Samples, "sample", lambda *given: os.kill(os.getpid(), signal.SIGKILL))
    message = r"process was ended .*lower recipe\.data\.workers"
    with pytest.raises(ValueError, match=message) as error:
        take(dataset, 1, workers=1)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_worker_leaves_a_queues_signals_to_the_main_process(tree, number):
    """Slurm sends them to every process of a cell, which is to save what it has."""
    before = set(multiprocessing.active_children())
    batches = train_batches(open_tree(tree), batch_size=3, seed=5, workers=2)
    next(batches)
    workers = set(multiprocessing.active_children()) - before
    assert len(workers) == 2
    for worker in workers:
        os.kill(worker.pid, number)
    assert len(list(islice(batches, 4))) == 4
    batches.close()


def test_a_bug_in_a_worker_keeps_its_traceback(tree, monkeypatch):
    def fail(*given):
        raise RuntimeError("a bug")

    dataset = open_tree(tree)
    monkeypatch.setattr(Samples, "sample", fail)
    with pytest.raises(RuntimeError, match="in fail"):
        take(dataset, 1, workers=1)


def test_evaluation_goes_through_the_split_in_order(tree):
    dataset = open_tree(tree, augment=None)
    batches = list(eval_batches(dataset, 3))
    assert [len(batch.names) for batch in batches] == [3, 3, 1]
    assert [name for batch in batches for name in batch.names] == dataset.names
    assert batches[2].fields["instance_ids"].shape == (1, HEIGHT, WIDTH)
    assert batches[0].fields["depth_m"].shape == (3, HEIGHT, WIDTH)
    for one, two in zip(batches, eval_batches(dataset, 3), strict=True):
        assert_same(one, two)


def cell(**changes):
    data = config.Data(height=HEIGHT, width=WIDTH, dataset=changes.pop("dataset", "cityscapes"))
    recipe = config.Recipe(data=data, loss=config.Loss(center_sigma=2.0))
    return config.Cell(recipe, backbone="any", method="any", **changes)


def opened(cell, tree):
    return open_samples(cell.recipe, tasks_of_cell(cell), "train", tree, training=True)


@pytest.mark.parametrize("dataset", ["cityscapes", "synthetic"])
def test_a_cell_opens_what_its_tasks_need(tree, dataset):
    both = opened(cell(dataset=dataset), tree)
    (batch,) = take(both, 1)
    assert "semantic" in batch.fields
    assert "neighbours" in batch.fields
    (batch,) = take(opened(cell(tasks=("panoptic",)), tree), 1)
    assert "neighbours" not in batch.fields
    (batch,) = take(opened(cell(tasks=("depth",)), tree), 1)
    assert "semantic" not in batch.fields


def test_errors(tree):
    with pytest.raises(ValueError, match="did you mean 'cityscapes'"):
        opened(cell(dataset="cityscape"), tree)
    for batch_size in (0, 8):
        with pytest.raises(ValueError, match="from 7 frames; set recipe"):
            train_batches(open_tree(tree), batch_size, seed=0)
