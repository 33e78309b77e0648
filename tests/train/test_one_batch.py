"""With one_batch, several ranks train a whole batch as one process does."""

import contextlib
import itertools
import os
from collections.abc import Iterator
from dataclasses import replace
from unittest import mock

import pytest
import torch
from support.ranks import flat, network_cell, started, stopped, trained, trunk_cell
from support.training import curve, run, scales_root
from timm.layers import BatchNormAct2d
from torch import nn

from mtl_bench.bench.check.side_by_side import side_by_side
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, Optim, load_recipe, override
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import Compute
from mtl_bench.core.ranks import ALONE, check_share
from mtl_bench.train import checkpoint, loop, one_batch
from mtl_bench.train import curve as curve_module
from mtl_bench.train.loop import build

ONE_BATCH = ("recipe.optim.micro_batch=none", "recipe.optim.one_batch=true")
ON_THE_NETWORK = (
    *("fixed_uncertainty", "nash", "graddrop", "mgda_ub"),  # one of each kind
    *("samo+mgda", "uncertainty+pcgrad"),  # evaluated again, composed
)
ON_A_TRUNK = ("uncertainty", "cagrad", "moco", "modo", "fixed+auto_lambda", "uncertainty+mgda_ub")
WRAPPERS = ("cr", "samo")
NEAR = 1e-12
IMPLAUSIBLE = 1e-6  # what a batch in parts differs by, at least


@pytest.fixture(scope="module")
def pair() -> Iterator:
    with started(2) as asked:
        yield asked


# --- in float64 -----------------------------------------------------------------------------------


def lacking(batch, number: int, share: tuple[int, int]):
    """The second batch has labels in its first half alone, the third none of one term."""
    fields, count = batch.fields, len(batch.names)
    late = torch.arange(share[0] * count, (share[0] + 1) * count) >= share[1] * count // 2
    nothing = {"semantic": 255, "offset_weight": 0, "reprojection_mask": 0} if number == 1 else {}
    for name in fields.keys() & nothing.keys():
        fields[name][late] = nothing[name]
    if number == 2 and "center_weight" in fields:
        fields["center_weight"].zero_()
    return batch


SINGLE, DOUBLE = (torch.float32, torch.Tensor.float), (torch.float64, torch.Tensor.double)


@contextlib.contextmanager
def computing_in(dtype: torch.dtype, float_) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with mock.patch.object(torch.Tensor, "float", float_):
            yield
    finally:
        torch.set_default_dtype(before)


@contextlib.contextmanager
def in_float64() -> Iterator[None]:
    """All that a training computes of the samples that it is given, and what it logs."""
    real = loop.train_batches

    def batches(samples, size, seed, first, workers, pinned, share=(0, 1)):
        drawn = real(samples, size, seed, first, workers, pinned, share)
        for number in itertools.count(first):
            with computing_in(*SINGLE):
                batch = next(drawn)
            exact = batch.map(lambda x: x.double() if x.is_floating_point() else x)
            yield lacking(exact, number, share)

    with (
        computing_in(*DOUBLE),
        mock.patch.object(loop, "train_batches", batches),
        mock.patch.object(curve_module, "_text", lambda key, value: repr(value or 0.0)),
    ):
        yield


def exactly(ranks, cell, root, run_dir, options=None, folder="", apart=False) -> None:
    """Train in float64.

    Args:
        folder: of plug-ins.
        apart: each rank's batch norms see its own samples alone.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(in_float64())
        stack.enter_context(mock.patch.dict(os.environ, {plugins.VARIABLE: str(folder)}))
        if apart:
            without = mock.patch.object(one_batch, "Synchronised", contextlib.nullcontext)
            stack.enter_context(without)
            stack.enter_context(mock.patch.object(loop, "check_equal", return_value=None))
        trained(ranks, cell, root, run_dir, options)


def difference(one, other) -> float:
    """The largest of any number of a checkpoint or a curve, relative where numbers are large."""
    first, second = (flat(checkpoint.read(path / "last.pt")) for path in (one, other))
    assert first.keys() == second.keys()
    found = [0.0]
    for key, value in first.items():
        if torch.is_tensor(value) and value.is_floating_point():
            assert value.dtype == torch.float64 or "/optimizer/" in key or not value.numel()
            scale = second[key].abs().max().clamp_min(1)
            found.append(float((value - second[key]).abs().max() / scale))
        elif torch.is_tensor(value):
            assert torch.equal(value, second[key]), key
    rows, others = curve(one), curve(other)
    assert len(rows) == len(others)
    for row, told in zip(rows, others, strict=True):
        assert row.keys() == told.keys()
        for key in row:
            if not key.endswith("_ms"):
                a, b = float(row[key]), float(told[key])
                found.append(abs(a - b) / max(1.0, abs(b)))
    return max(found)


def compare(asked, cell, root, place, *given) -> float:
    torch.set_num_threads(1)
    asked(exactly, cell, root, place / "ranks", *given)
    exactly(ALONE, cell, root, place / "alone", *given)
    return difference(place / "ranks", place / "alone")


@pytest.mark.parametrize("method", ON_THE_NETWORK)
def test_two_ranks_are_one_batch_of_the_network(method, pair, smoke_root, tmp_path):
    cell = network_cell(method, *ONE_BATCH)
    assert compare(pair, cell, smoke_root, tmp_path) < NEAR
    model, _, _ = build(cell, Compute(torch.device("cpu")))
    moved = checkpoint.read(tmp_path / "alone" / "last.pt")["model"]
    assert (
        max(float((moved[k] - v.detach()).abs().max()) for k, v in model.named_parameters()) > 1e-4
    )


@pytest.mark.parametrize("method", ON_A_TRUNK)
def test_two_ranks_are_one_batch_of_a_trunk(method, pair, tmp_path):
    assert compare(pair, trunk_cell(method, *ONE_BATCH), scales_root(), tmp_path) < NEAR


def test_means_of_statistics_are_of_whole_batches(pair, smoke_root, tmp_path):
    cell = network_cell("fixed", *ONE_BATCH, "recipe.optim.statistics_batches=3")
    assert compare(pair, cell, smoke_root, tmp_path) < NEAR


def test_replayed_weights_train_one_batch_too(pair, tmp_path):
    root, origin = scales_root(), trunk_cell("upgrad", *ONE_BATCH)
    exactly(ALONE, origin, root, tmp_path / "record")
    record = {"record": tmp_path / "record" / "curve.csv"}
    assert compare(pair, replace(origin, replay="shuffled"), root, tmp_path, record) < NEAR


@pytest.mark.slow
@pytest.mark.parametrize("method", sorted(set(plugins.files("methods")) - set(WRAPPERS)))
def test_every_method_trains_one_batch(method, pair, smoke_root, tmp_path):
    assert compare(pair, network_cell(method, *ONE_BATCH), smoke_root, tmp_path) < NEAR


@pytest.mark.slow
def test_four_ranks_of_one_sample_each(smoke_root, tmp_path):
    with started(4) as four:
        cell = network_cell("uncertainty+pcgrad", *ONE_BATCH)
        assert compare(four, cell, smoke_root, tmp_path) < NEAR


def test_batch_norms_apart_are_another_training(pair, smoke_root, tmp_path):
    given = (None, "", True)
    found = compare(pair, network_cell("fixed", *ONE_BATCH), smoke_root, tmp_path, *given)
    assert found > IMPLAUSIBLE


def test_a_batch_in_parts_is_another_training(smoke_root, tmp_path):
    torch.set_num_threads(1)
    exactly(ALONE, network_cell("fixed", *ONE_BATCH), smoke_root, tmp_path / "whole")
    exactly(ALONE, network_cell("fixed"), smoke_root, tmp_path / "parts")
    for term in ("semantic", "center", "photometric"):
        parts, whole = (
            float(curve(tmp_path / name)[0][f"loss.{term}"]) for name in ("parts", "whole")
        )
        assert abs(parts - whole) > IMPLAUSIBLE, term


def exactly_stopped(ranks, cell, root, run_dir) -> str:
    with in_float64():
        return stopped(ranks, cell, root, run_dir)


def test_a_run_of_two_ranks_goes_on_with_one(pair, smoke_root, tmp_path):
    torch.set_num_threads(1)
    cell = network_cell("famo", *ONE_BATCH)
    exactly(ALONE, cell, smoke_root, tmp_path / "straight")
    said = pair(exactly_stopped, cell, smoke_root, tmp_path / "stopped")
    assert all(line.startswith("stopped at step 2 of 3") for line in said)
    exactly(ALONE, cell, smoke_root, tmp_path / "stopped")
    assert difference(tmp_path / "stopped", tmp_path / "straight") < NEAR


# --- a user's task --------------------------------------------------------------------------------

TASK = '''
"""Grey values: the hardest pixels of a batch, and how far apart its samples are."""

from mtl_bench.core.task import Task
from mtl_bench.core.terms import Term
from mtl_bench.model.layers import DenseHead


class Greys(Task):
    terms = tuple(Term(name, "greys", "regression", 1.0) for name in ("hardest", "apart"))

    def head(self, inputs, sizes):
        return DenseHead("greys", inputs, sizes, 1)

    def losses(self, maps, batch):
        error_N = (maps["greys"] - batch.image_B3HW.mean(1, keepdim=True)).square().flatten()
        mean_B = maps["greys"].mean((1, 2, 3))
        apart = (mean_B[:, None] - mean_B + 0.1).square().mean()
        return {"hardest": error_N.topk(100).values.mean(), "apart": apart}
'''
WITHOUT_SAMPLES = """
    def activate(self, maps):
        return {"greys": maps["greys"].mean(0, keepdim=True)}
"""


def greys(folder, text: str) -> Cell:
    (folder / "tasks").mkdir()
    (folder / "tasks" / "greys.py").write_text(text)
    return network_cell("nash", *ONE_BATCH, 'tasks=["panoptic", "greys"]')


def test_a_task_that_compares_samples_sees_the_whole_batch(pair, smoke_root, tmp_path):
    cell = greys(tmp_path, TASK)
    assert compare(pair, cell, smoke_root, tmp_path, None, tmp_path) < NEAR


def test_a_map_that_is_not_of_samples_is_one_clear_line(pair, smoke_root, tmp_path):
    cell = greys(tmp_path, TASK + WITHOUT_SAMPLES)
    pair(exactly, cell, smoke_root, tmp_path / "run", None, tmp_path, fails=True)
    for error in pair.errors:
        assert "map 'greys' of task 'greys' is [1, 1, 32, 64]" in error
        assert "\n" not in error


# --- batch norms ----------------------------------------------------------------------------------

NORMS = {
    "plain": lambda: nn.BatchNorm2d(3),
    "without weights": lambda: nn.BatchNorm2d(3, affine=False),
    "of vectors": lambda: nn.Sequential(nn.Flatten(2), nn.BatchNorm1d(3, momentum=0.4)),
    "mean over steps": lambda: nn.BatchNorm2d(3, momentum=None),
    "without statistics": lambda: nn.BatchNorm2d(3, track_running_stats=False),
    "with its activation": lambda: BatchNormAct2d(3, act_layer=nn.LeakyReLU),
    "frozen": lambda: nn.BatchNorm2d(3).eval(),
}


def normalised(norm, ranks, x_B3HW, share, dtype=torch.float64):
    """Two passes, each with two ways back: outputs, gradients (this rank's) and state."""
    draw = torch.Generator().manual_seed(0)  # of its own: ranks are threads here
    net = nn.Sequential(NORMS[norm]()).to(dtype)
    for parameter in net.parameters():
        nn.init.normal_(parameter, generator=draw)
    found = []
    for factor in (1, 3):
        x = (x_B3HW[share] * factor).to(dtype).requires_grad_()
        with one_batch.Synchronised(ranks) if ranks.size > 1 else contextlib.nullcontext():
            y = net(x)
        weight = torch.arange(y.numel() // len(y)).sin().view(y.shape[1:]).to(dtype)
        for loss in ((y * weight).sum(), y.square().mul(weight).sum()):
            grads = torch.autograd.grad(loss, [x, *net.parameters()], retain_graph=True)
            found.append((y.detach(), *grads))
    return found, net.state_dict()


@pytest.mark.parametrize("norm", NORMS)
def test_norms_of_all_ranks_are_those_of_one_batch(norm):
    """Also far from zero, and with more samples on one rank than on the others."""
    draw = torch.Generator().manual_seed(1)
    x = torch.randn(6, 3, 4, 5, generator=draw, dtype=torch.float64)
    x += torch.tensor([0.0, 10.0, -1000.0]).view(3, 1, 1)
    expected, state = normalised(norm, ALONE, x, slice(0, 6))
    shares = [slice(0, 1), slice(1, 4), slice(4, 6)]
    ranks = side_by_side(3, lambda r: normalised(norm, r, x, shares[r.rank]))
    for number, (y, of_x, *of_parameters) in enumerate(expected):
        parts = [found[number] for found, _ in ranks]
        near = {"atol": 1e-10, "rtol": 1e-10}  # of numbers around 1000
        torch.testing.assert_close(torch.cat([part[0] for part in parts]), y, **near)
        torch.testing.assert_close(torch.cat([part[1] for part in parts]), of_x, **near)
        for index, grad in enumerate(of_parameters, 2):
            torch.testing.assert_close(sum(part[index] for part in parts), grad, **near)
    for _, own in ranks:
        torch.testing.assert_close(own, state, atol=NEAR, rtol=NEAR)


def test_half_precision_stays_and_is_normalised_in_float32():
    x = torch.randn(4, 3, 8, 8, generator=torch.Generator().manual_seed(0)).bfloat16()
    shares = [slice(0, 2), slice(2, 4)]

    def found(ranks, share):
        net, own = nn.BatchNorm2d(3), x[share].requires_grad_()
        with one_batch.Synchronised(ranks) if ranks.size > 1 else contextlib.nullcontext():
            y = net(own)
        (grad,) = torch.autograd.grad(y.square().sum(), own)
        return y.detach(), grad

    expected = found(ALONE, slice(0, 4))
    ranks = side_by_side(2, lambda r: found(r, shares[r.rank]))
    for one, parts in zip(expected, zip(*ranks, strict=True), strict=True):
        assert parts[0].dtype == torch.bfloat16
        torch.testing.assert_close(torch.cat(parts), one)


# --- what is drawn, sent and refused --------------------------------------------------------------


def test_a_network_that_drops_goes_on_as_it_would_have(pair, tmp_path):
    recipe = load_recipe("dense-smoke")
    settings = ["recipe.network.decoder=aspp", 'tasks=["semantic"]', "recipe.optim.steps=3"]
    cell = override(Cell(recipe, "tiny", "fixed"), [*settings, *ONE_BATCH])
    root = dataset_of(recipe).render(recipe.data, True)
    for name in ("straight", "stopped"):
        if name == "stopped":
            pair(stopped, cell, root, tmp_path / name)
        pair(trained, cell, root, tmp_path / name)
    first, second = (
        flat(checkpoint.read(tmp_path / name / "last.pt")["model"])
        for name in ("straight", "stopped")
    )
    assert all(torch.equal(value, second[key]) for key, value in first.items())


def sent(ranks, cell, root, run_dir) -> tuple[int, int]:
    """Bytes of all sums over ranks, and of what this rank had joined, in a training."""
    told = {"sum_": 0, "join": 0}

    def counting(name):
        real = getattr(ranks, name)

        def counted(tensor):
            told[name] += tensor.numel() * tensor.element_size()
            return real(tensor)

        return counted

    for name in told:
        setattr(ranks, name, counting(name))
    try:
        trained(ranks, cell, root, run_dir)
    finally:
        for name in told:
            delattr(ranks, name)
    return told["sum_"], told["join"]


@pytest.mark.parametrize(
    ("method", "expected", "passes"),
    [
        ("fixed", lambda P, Q, K: 4 * (P + Q), 1),
        ("pcgrad", lambda P, Q, K: 4 * (K * P + Q), 1),
        ("mgda_ub", lambda P, Q, K: 8 * K * K + 4 * (P + Q), 1),
        ("modo", lambda P, Q, K: 4 * (2 * K * P + P + Q), 1),
        ("famo", lambda P, Q, K: 4 * (P + Q), 2),
    ],
)
def test_bytes_of_a_step_are_the_formulas(method, expected, passes, pair, tmp_path):
    """Of a batch: its share of the image and fields once, and of the maps at every pass."""
    cell = trunk_cell(method, *ONE_BATCH, "recipe.optim.steps=1", "recipe.optim.cosine_every=0")
    model, built, _ = build(cell, Compute(torch.device("cpu")))
    P = sum(parameter.numel() for parameter in model.shared_parameters())
    Q = sum(parameter.numel() for parameter in model.task_parameters())
    K, own = len(built.terms), 4
    pixels = 3 * cell.recipe.data.height * cell.recipe.data.width
    for summed, shared in pair(sent, cell, scales_root(), tmp_path / "run"):
        assert summed == expected(P, Q, K)
        fields = 4 * own * (pixels + 11 + K)  # a camera's 11 numbers, a truth a task
        assert shared == built.batches * (fields + passes * 4 * own * K)


def test_bytes_of_a_batch_norm_are_the_formulas():
    C = 5

    def counted(ranks):
        told, join, sum_ = [], ranks.join, ranks.sum_
        ranks.join = lambda x: told.append(x.nbytes) or join(x)
        ranks.sum_ = lambda x: told.append(x.nbytes) or sum_(x)
        with one_batch.Synchronised(ranks):
            y = nn.BatchNorm1d(C)(torch.randn(2, C, requires_grad=True))
        y.square().sum().backward()
        return told

    for told in side_by_side(2, counted):
        assert told == [8 * (2 * C + 1), 4 * 2 * C]


def test_parts_and_one_batch_exclude_each_other():
    with pytest.raises(ValueError, match=r"one_batch = true .* micro_batch = 3") as said:
        Optim(batch=12, micro_batch=3, one_batch=True)
    assert "\n" not in str(said.value)


def test_ranks_that_do_not_divide_a_whole_batch_are_one_clear_line():
    for size in (1, 2, 3, 12):
        check_share(Optim(batch=12, one_batch=True), size)
    with pytest.raises(ValueError, match="5 ranks cannot share the 12 samples") as said:
        check_share(Optim(batch=12, one_batch=True), 5)
    assert "\n" not in str(said.value)


def test_only_cells_of_one_batch_have_it_in_their_id():
    cell = Cell(load_recipe("smoke"), "tiny", "fixed")
    assert override(cell, ["recipe.optim.one_batch=false"]).id == cell.id
    assert override(cell, ["recipe.optim.one_batch=true"]).id != cell.id


def test_one_process_trains_it_as_any_whole_batch(tmp_path):
    root, plain = scales_root(), trunk_cell("upgrad", "recipe.optim.micro_batch=none")
    for name, cell in (("plain", plain), ("one", trunk_cell("upgrad", *ONE_BATCH))):
        run(cell, root, tmp_path / name)
    first, second = (
        flat(checkpoint.read(tmp_path / name / "last.pt")["model"]) for name in ("plain", "one")
    )
    assert all(torch.equal(value, second[key]) for key, value in first.items())
