"""An evaluation, and pseudo labels, of several ranks are those of one process to the last bit."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.ranks import started

from mtl_bench.bench.check.side_by_side import side_by_side
from mtl_bench.bench.check.tasks import TASK_CHECKS
from mtl_bench.core import plugins
from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, load_recipe, override
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import Compute
from mtl_bench.core.ranks import ALONE
from mtl_bench.core.task import Metric
from mtl_bench.data.loader import eval_batches, eval_rounds
from mtl_bench.data.samples import NO_CAMERA
from mtl_bench.evaluate.labels import label
from mtl_bench.evaluate.walk import Candidates, Gallery, evaluate, evaluate_together, evaluating
from mtl_bench.tasks.panoptic import pseudo_labels
from mtl_bench.train.loop import build

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def pair() -> Iterator:
    with started(2) as asked:
        yield asked


def model_of(cell: Cell):
    """With the weights that it is born with."""
    return build(cell, Compute(CPU))[0]


def rendered(cell: Cell):
    return dataset_of(cell.recipe).render(cell.recipe.data, quiet=True)


def told(evaluation) -> str:
    """Everything of it, to the last bit."""
    samples = {
        key: [value.dtype.str, value.tolist()] if isinstance(value, np.ndarray) else value
        for key, value in evaluation.samples.items()
    }
    return json.dumps([evaluation.metrics, evaluation.protocol, samples])


# --- evaluation -----------------------------------------------------------------------------------


def evaluated(ranks, cell, root, batch_size) -> str:
    calls = []
    found = evaluate_together(
        *(model_of(cell), cell, root, CPU, ranks, batch_size), lambda *call: calls.append(call)
    )
    return told(found) if ranks.first else json.dumps([len(calls), found.metrics])


def street(*settings: str) -> Cell:
    """Panoptic segmentation and depth; four frames are evaluated."""
    return override(Cell(load_recipe("smoke"), "tiny", "fixed"), settings)


def dense(*settings: str) -> Cell:
    """Classes, depth and normals, also by the means of batches; five frames are evaluated."""
    cell = Cell(load_recipe("dense-smoke"), "tiny", "fixed")
    return override(cell, ["recipe.data.test_scenes=5", *settings])


def eigen() -> Cell:
    """Depth by three protocols, two of them with a walk of their own."""
    return Cell(load_recipe("kitti-smoke"), "tiny", "fixed")


@pytest.mark.parametrize(
    ("cell", "batch_size"),
    [
        (street(), 2),
        (street(), 8),  # fewer batches than ranks
        (street("recipe.evaluate.flip=true"), 1),
        (dense(), 2),  # three batches for two ranks
        (dense("recipe.optim.batch=2"), 4),
        (dense(), 8),
        (eigen(), 1),
    ],
    ids=["street", "one batch", "flip", "dense", "batch means", "one dense batch", "eigen"],
)
def test_two_ranks_measure_what_one_does(cell, batch_size, pair):
    torch.set_num_threads(1)
    root = rendered(cell)
    first, second = pair(evaluated, cell, root, batch_size)
    alone = evaluate(model_of(cell), cell, root, CPU, batch_size=batch_size)
    assert len(alone.metrics) > 8
    assert first == told(alone)
    assert json.loads(second)[1] == {}


def test_three_ranks_and_tasks_of_ones_own(monkeypatch):
    """As threads: four frames, so that the last round has one."""
    torch.set_num_threads(1)
    monkeypatch.setenv("MTL_BENCH_PLUGINS", str(Path(__file__).parents[1] / "plugins"))
    cell = street('tasks=["slopes", "depth_silog"]')
    root, models = rendered(cell), [model_of(cell) for _ in range(3)]
    expected = evaluate(models[0], cell, root, CPU, batch_size=1)
    assert {"slopes.mean_angle", "depth.silog"} <= expected.metrics.keys()

    def work(ranks):
        return evaluate_together(models[ranks.rank], cell, root, CPU, ranks, 1)

    assert told(side_by_side(3, work)[0]) == told(expected)


def test_a_split_without_truth_is_not_measured(pair):
    cell = street("recipe.evaluate.split=none")
    first, _ = pair(evaluated, cell, rendered(cell), 2)
    assert json.loads(first)[0] == {}


def test_what_a_rank_finds_wrong_is_said():
    torch.set_num_threads(1)
    cell = street()
    root, models = rendered(cell), [model_of(cell) for _ in range(2)]
    with torch.no_grad():
        next(models[1].net.parameters()).fill_(torch.nan)

    def work(ranks):
        evaluate_together(models[ranks.rank], cell, root, CPU, ranks, 1)

    with pytest.raises(ValueError, match="not finite in a frame of"):
        side_by_side(2, work)


# --- batches --------------------------------------------------------------------------------------


class Sized:
    """Frames whose truths have these heights."""

    def __init__(self, heights):
        self.heights, self.read = heights, []

    def __len__(self):
        return len(self.heights)

    def sample(self, index, generator):
        self.read.append(index)
        truth = torch.full((self.heights[index], 2), index)
        return Batch([str(index)], torch.zeros(3, 1, 1), NO_CAMERA, {"truth": truth})


@pytest.mark.parametrize(
    "heights",
    [[4] * 12, [4] * 7, [4], [4, 4, 5, 5, 5, 5, 5, 4, 4], [4, 5] * 4, [4] * 5 + [5] * 6, []],
    ids=str,
)
@pytest.mark.parametrize("size", [1, 2, 3])
def test_rounds_hold_the_batches_of_one_process_in_order(heights, size):
    expected = [batch.names for batch in eval_batches(Sized(heights), 3)]

    def rounds(ranks):
        own = Sized(heights)
        return [
            [(first, batch.names) for first, batch in of_round]
            for of_round in eval_rounds(own, 3, ranks)
        ], own.read

    found = [rounds(ALONE)] if size == 1 else side_by_side(size, rounds)
    shared = zip(*(of_rank for of_rank, _ in found), strict=True)
    batches = [batch for of_round in shared for of_rank in of_round for batch in of_rank]
    assert [names for _, names in batches] == expected
    assert all(str(first) == names[0] for first, names in batches)
    reads = list(itertools.chain(*(read for _, read in found)))
    if len(set(heights)) < 2:
        assert sorted(reads) == list(range(len(heights)))  # each frame once


def test_candidates_hold_what_a_gallery_shows():
    draw = np.random.default_rng(0)
    for count, size in itertools.product((1, 2, 3, 7, 30), (2, 3)):
        scores = draw.integers(0, 4, count).astype(float)  # with ties
        scores[draw.random(count) < 0.2] = np.nan
        frames = [
            {"names": f"{i}", "map": np.full((2, 2), i), "score": score}
            for i, score in enumerate(scores.tolist())
        ]
        whole, merged = Gallery(count), Gallery(count)
        chosen = [Candidates(count) for _ in range(size)]
        sent = 0
        for index, frame in enumerate(frames):
            whole.add(frame)
            takes = chosen[index % size].takes(index, frame)
            merged.add(frame if takes else {})
            sent += takes
        assert repr(merged.samples()) == repr(whole.samples())
        assert count < 30 or sent < count


# --- metrics of others ----------------------------------------------------------------------------


def test_a_metric_whose_state_loses_bits_fails_the_check(monkeypatch):
    kind = plugins.load("tasks", "semantic")
    real = kind.metrics

    class Halved(Metric):
        """Adds up in another way than its state does."""

        def __init__(self, inner):
            self.inner, self.sum = inner, 0.1

        def update(self, truth, result):
            self.sum += 0.2
            return self.inner.update(truth, result)

        def state(self):
            return {**self.inner.state(), "sum": np.array(self.sum)}

        def add(self, state):
            self.inner.add(state)
            self.sum += float(state["sum"])

        def compute(self):
            return {**self.inner.compute(), "segmentation.sum": self.sum}

    monkeypatch.setattr(kind, "metrics", lambda self, split=None: [Halved(real(self, split)[0])])
    with pytest.raises(ValueError, match="frame by frame"):
        TASK_CHECKS["metrics have its columns"](kind)


# --- pseudo labels --------------------------------------------------------------------------------


def labelled(ranks, cell, root, out, pixels=pseudo_labels.PIXELS) -> list[tuple[int, int]]:
    """What is told of the progress; batches are of so many pixels."""
    model, calls = model_of(cell), []
    frames = dataset_of(cell.recipe).frames_to_label(root, out, "train", cell.recipe)
    task = next(task for task in model.tasks if task.makes_labels)
    with evaluating(model), pytest.MonkeyPatch.context() as patch:
        patch.setattr(pseudo_labels, "PIXELS", pixels)
        label(task, model, frames, CPU, ranks, lambda *call: calls.append(call))
    return calls


def contents(folder) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize("frames", [1, 3, 100])
def test_labels_of_two_ranks_are_those_of_one(frames, pair, smoke_root, tmp_path):
    """With so many frames a batch, which are predicted together."""
    torch.set_num_threads(1)
    cell, pixels = street("recipe.pseudo.min_confidence=0.05"), frames * 32 * 64
    (*_, last) = labelled(ALONE, cell, smoke_root, tmp_path / "one", pixels)
    told = pair(labelled, cell, smoke_root, tmp_path / "two", pixels)
    expected = contents(tmp_path / "one")
    assert len(expected) == 1 + 2 * last[1]
    assert contents(tmp_path / "two") == expected
    for calls in told:
        assert (calls[0], calls[-1]) == ((0, last[1]), last)
        assert [done for done, _ in calls] == sorted(done for done, _ in calls)


@pytest.mark.parametrize("kept", [0, 1, 7])
def test_labels_that_are_there_stay_and_the_rest_is_shared(kept, pair, smoke_root, tmp_path):
    torch.set_num_threads(1)
    cell = street()
    labelled(ALONE, cell, smoke_root, tmp_path / "one")
    expected = contents(tmp_path / "one")
    frames = dataset_of(cell.recipe).frames_to_label(
        smoke_root, tmp_path / "one", "train", cell.recipe
    )
    gone = frames.names[kept::2]
    for path in (tmp_path / "one").rglob("*_gtFine_instanceIds.png"):
        if any(name in path.name for name in gone):
            path.unlink()
    first, _ = pair(labelled, cell, smoke_root, tmp_path / "one")
    assert contents(tmp_path / "one") == expected
    assert first[0][0] == len(frames.names) - len(gone)


def test_labels_of_another_model_are_one_error(smoke_root, tmp_path):
    cell = street()
    labelled(ALONE, cell, smoke_root, tmp_path / "labels")
    other = replace(cell, seed=1)
    with pytest.raises(ValueError, match="made with other weights"):
        side_by_side(2, lambda ranks: labelled(ranks, other, smoke_root, tmp_path / "labels"))


def test_frames_count_as_labelled_but_for_a_share():
    from mtl_bench.evaluate.labels import Share

    frames = SimpleNamespace(names=["a", "b", "c"], out=None, folder=None, done=lambda: {"a"})
    assert Share(frames, ["b"]).done() == {"a", "c"}
