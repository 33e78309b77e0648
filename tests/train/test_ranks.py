"""A cell on several ranks is the cell in as many parts."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import pytest
import torch
from support.ranks import STEPS, flat, network_cell, started, stopped, trained, trunk_cell
from support.terms import TERMS
from support.training import curve, run, scales_root

from mtl_bench.bench.check.methods import METHOD_CHECKS, Quadratics
from mtl_bench.bench.check.side_by_side import side_by_side
from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, Optim, load_recipe, override
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.device import Compute
from mtl_bench.core.method import LossMethod
from mtl_bench.core.ranks import ALONE, check_share
from mtl_bench.train import checkpoint
from mtl_bench.train.backward import backward
from mtl_bench.train.loop import build
from mtl_bench.train.statistics import common_statistics
from mtl_bench.train.together import Together

ON_THE_NETWORK = ("fixed_uncertainty", "cagrad", "graddrop", "mgda_ub")  # one of each kind
COMPOSED = (
    *("fixed_uncertainty+pcgrad", "imtl_l+mgda", "uncertainty+modo", "famo+upgrad"),
    *("fixed+auto_lambda", "uncertainty+mgda_ub", "cr+nash", "samo+mgda"),
)
ON_A_TRUNK = (
    *("fixed", "famo", "uncertainty", "nash", "pcgrad", "upgrad", "modo", "auto_lambda"),
    *("moco", "samo+mgda", "fixed+auto_lambda", "uncertainty+mgda_ub"),
)
WRAPPERS = ("cr", "samo")


@pytest.fixture(scope="module")
def pair() -> Iterator:
    with started(2) as asked:
        yield asked


def told(run_dir) -> list[dict[str, str]]:
    return [
        {key: value for key, value in row.items() if not key.endswith("_ms")}
        for row in curve(run_dir)
    ]


def assert_same(one, other, atol: float | None = None) -> None:
    """Bit for bit but for the statistics of batch norms; or all of it nearly."""
    first, second = (flat(checkpoint.read(path / "last.pt")) for path in (one, other))
    assert first.keys() == second.keys()
    assert any("/optimizer/" in key for key in first)
    for key, value in first.items():
        near = atol or (1e-6 if ".running_" in key else None)
        if near is not None and torch.is_tensor(value) and value.is_floating_point():
            torch.testing.assert_close(value, second[key], atol=near, rtol=near)
        elif torch.is_tensor(value):
            assert torch.equal(value, second[key]), key
        else:
            assert value == second[key], key
    if atol is None:
        assert told(one) == told(other)


def compare(asked, cell, root, place, atol: float | None = None) -> None:
    torch.set_num_threads(1)
    asked(trained, cell, root, place / "ranks")
    run(cell, root, place / "parts")
    assert_same(place / "ranks", place / "parts", atol)


@pytest.mark.parametrize("method", ON_THE_NETWORK)
def test_two_ranks_are_two_parts_of_the_network(method, pair, smoke_root, tmp_path):
    compare(pair, network_cell(method), smoke_root, tmp_path)


@pytest.mark.parametrize("method", ON_A_TRUNK)
def test_two_ranks_are_two_parts_of_a_trunk(method, pair, tmp_path):
    compare(pair, trunk_cell(method), scales_root(), tmp_path)


@pytest.mark.parametrize("method", ["famo", "upgrad"])
def test_replayed_weights_train_two_ranks_too(method, pair, tmp_path):
    torch.set_num_threads(1)
    origin, root = trunk_cell(method), scales_root()
    run(origin, root, tmp_path / "record")
    cell, record = replace(origin, replay="mean"), {"record": tmp_path / "record" / "curve.csv"}
    pair(trained, cell, root, tmp_path / "ranks", record)
    run(cell, root, tmp_path / "parts", **record)
    assert_same(tmp_path / "ranks", tmp_path / "parts")


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [*sorted(set(plugins.files("methods")) - set(WRAPPERS)), *COMPOSED]
)
def test_every_method_is_the_same_on_two_ranks(method, pair, smoke_root, tmp_path):
    compare(pair, network_cell(method), smoke_root, tmp_path)


@pytest.mark.parametrize("method", ["fixed_uncertainty", "upgrad"])
def test_several_parts_a_rank_differ_by_rounding(method, pair, tmp_path):
    cell = trunk_cell(method, "recipe.optim.micro_batch=2")
    compare(pair, cell, scales_root(), tmp_path, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fixed_uncertainty", "graddrop", "mgda_ub", "modo"])
def test_four_ranks_of_the_network_differ_by_rounding(method, smoke_root, tmp_path):
    cell = network_cell(method, "recipe.optim.batch=8", "recipe.optim.clip=none")
    with started(4) as four:
        compare(four, cell, smoke_root, tmp_path, atol=1e-4)


def test_what_a_network_drops_follows_from_the_part(pair, tmp_path):
    recipe = load_recipe("dense-smoke")
    settings = ["recipe.network.decoder=aspp", 'tasks=["semantic"]', "recipe.optim.micro_batch=2"]
    cell = override(Cell(recipe, "tiny", "fixed"), [*STEPS, *settings])
    assert any(
        isinstance(m, torch.nn.Dropout)
        for m in build(cell, Compute(torch.device("cpu")))[0].modules()
    )
    compare(pair, cell, dataset_of(recipe).render(recipe.data, True), tmp_path)


def test_bfloat16_too(pair, tmp_path):
    compare(pair, trunk_cell("pcgrad", "recipe.optim.precision=bf16"), scales_root(), tmp_path)


# --- what every rank agrees on --------------------------------------------------------------------


def long_and_short(ranks, cell) -> list[str]:
    return ranks.gather(f"{ranks.rank}" * (1 + 10000 * ranks.rank))


def test_values_of_any_length_are_gathered_by_rank(pair):
    expected = ["0", "1" * 10001]
    assert pair(long_and_short, trunk_cell("fixed")) == [expected, expected]


def test_a_loss_that_is_not_finite_stops_all_ranks_alike(pair, smoke_root, tmp_path):
    settings = ("recipe.optim.lr=1e30", "recipe.optim.clip=none", "recipe.optim.warmup_steps=0")
    pair(trained, network_cell("fixed", *settings), smoke_root, tmp_path / "run", fails=True)
    one, other = pair.errors
    assert one == other
    assert "FloatingPointError: loss term" in one


def test_a_signal_to_one_rank_stops_all_and_any_number_goes_on(pair, tmp_path):
    torch.set_num_threads(1)
    root = scales_root()
    cell = trunk_cell("fixed_uncertainty", "recipe.optim.steps=4")
    run(cell, root, tmp_path / "straight")
    for name, go_on in (("alone", partial(trained, ALONE)), ("ranks", partial(pair, trained))):
        said = pair(stopped, cell, root, tmp_path / name)
        assert all(line.startswith("stopped at step 2 of 4") for line in said)
        assert len(curve(tmp_path / name)) == 2
        go_on(cell, root, tmp_path / name)
        assert_same(tmp_path / name, tmp_path / "straight")


def test_only_the_first_rank_writes(pair, tmp_path):
    pair(written, trunk_cell("fixed"), scales_root(), tmp_path)
    assert sorted(path.name for path in (tmp_path / "rank0").iterdir()) == [
        *("curve.csv", "last.pt", "progress.json")
    ]
    assert list((tmp_path / "rank1").iterdir()) == []


def written(ranks, cell, root, place) -> None:
    """As if every rank had a disk of its own."""
    trained(ranks, cell, root, place / f"rank{ranks.rank}")


def drifting(ranks, cell, root, run_dir) -> None:
    """A rank whose processor rounds in another way: from some step on its weights are others."""
    from mtl_bench.train import loop

    real = loop.check_equal

    def drifted(model, *given):
        if not ranks.first:
            with torch.no_grad():
                next(model.parameters()).view(-1)[0] += 1e-6
        real(model, *given)

    loop.check_equal = drifted
    try:
        trained(ranks, cell, root, run_dir)
    finally:
        loop.check_equal = real


def test_ranks_that_drift_apart_are_not_saved(pair, tmp_path):
    pair(drifting, trunk_cell("fixed"), scales_root(), tmp_path / "run", fails=True)
    assert all("differs between ranks" in error for error in pair.errors)
    assert not (tmp_path / "run" / "last.pt").exists()


@pytest.mark.parametrize(("batch", "micro", "size"), [(12, 4, 2), (12, None, 2), (12, 3, 8)])
def test_ranks_that_do_not_divide_the_parts_are_one_clear_line(batch, micro, size):
    optim = Optim(batch=batch, micro_batch=micro)
    check_share(optim, 1)
    with pytest.raises(ValueError, match=f"{size} ranks cannot share the .* of a batch") as said:
        check_share(optim, size)
    assert "\n" not in str(said.value)


# --- what is sent ---------------------------------------------------------------------------------


def bytes_of(ranks, cell, root, run_dir) -> list[int]:
    """Bytes of every sum over ranks, of a training of one step."""
    sent, real = [], ranks.sum_

    def counted(tensor):
        sent.append(tensor.numel() * tensor.element_size())
        return real(tensor)

    ranks.sum_ = counted
    try:
        trained(ranks, cell, root, run_dir)
    finally:
        del ranks.sum_
    return sent


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("fixed", lambda P, Q, K: 4 * (P + Q)),
        ("pcgrad", lambda P, Q, K: 4 * (K * P + Q)),
        ("graddrop", lambda P, Q, K: 4 * (K * P + Q)),
        ("mgda_ub", lambda P, Q, K: 8 * K * K + 4 * (P + Q)),
        ("modo", lambda P, Q, K: 4 * (2 * K * P + P + Q)),
        ("auto_lambda", lambda P, Q, K: 4 * (2 * K * P + Q)),
        ("samo+mgda", lambda P, Q, K: 4 * (P + K * P + Q)),
    ],
)
def test_bytes_of_a_step_are_the_formulas(method, expected, pair, tmp_path):
    """P shared and Q other numbers, each of one loss, K losses."""
    cell = trunk_cell(method, "recipe.optim.steps=1", "recipe.optim.cosine_every=0")
    model, built, _ = build(cell, Compute(torch.device("cpu")))
    P = sum(parameter.numel() for parameter in model.shared_parameters())
    Q = sum(parameter.numel() for parameter in model.task_parameters())
    for sent in pair(bytes_of, cell, scales_root(), tmp_path / "run"):
        assert sum(sent) == expected(P, Q, len(built.terms))


# --- batch norms ----------------------------------------------------------------------------------


@pytest.mark.parametrize("parts_each", [1, 3])
def test_merged_statistics_are_those_of_all_parts_in_order(parts_each):
    draw = torch.Generator().manual_seed(0)
    parts = torch.randn(4 * parts_each, 8, 3, generator=draw) + torch.arange(3)
    torch.manual_seed(0)

    def norm():
        return torch.nn.Sequential(torch.nn.BatchNorm1d(3, momentum=0.3)).double()

    def seen(ranks):
        net = norm()
        with common_statistics(net, ranks):
            for part in parts.double().chunk(ranks.size)[ranks.rank]:
                net(part)
        return net.state_dict()

    expected = seen(ALONE)
    for found in side_by_side(4, seen):
        torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-12)


def test_a_batch_norm_without_momentum_is_refused():
    net = torch.nn.BatchNorm1d(3, momentum=None)

    def seen(ranks):
        with common_statistics(net if ranks.first else torch.nn.BatchNorm1d(3), ranks):
            net(torch.ones(2, 3))

    with pytest.raises(ValueError, match="momentum None"):
        side_by_side(2, seen)


def test_means_of_statistics_are_of_all_ranks_parts(pair, smoke_root, tmp_path):
    cell = network_cell("fixed", "recipe.optim.statistics_batches=3")
    compare(pair, cell, smoke_root, tmp_path, atol=1e-5)


# --- losses and gradients that one rank lacks -----------------------------------------------------


@pytest.mark.parametrize("method", ["fixed", "upgrad", "graddrop", "mgda_ub"])
def test_a_term_that_only_one_rank_has_counts_for_all(method):
    """The second part lacks a term, the third two: its mean is over the parts that have it."""

    def grads(numbers, together):
        toy = Quadratics()
        parts = [[partial(toy.forward, number) for number in numbers]]
        weighting = backward(
            plugins.load("methods", method)(toy.terms), parts, toy, together=together
        )
        return weighting.losses, [parameter.grad for parameter in toy.parameters()]

    losses, expected = grads((0, 1, 2), Together())
    for found in side_by_side(3, lambda ranks: grads((ranks.rank,), Together(ranks))):
        assert found[0] == losses
        torch.testing.assert_close(found[1], expected)


def test_no_gradient_anywhere_stays_none():
    class First(LossMethod):
        def total(self, step):
            return step.loss_K[0]

    def grads(ranks):
        toy = Quadratics(TERMS)
        toy.terms = toy.terms[:2]
        unused = toy.own[TERMS[-1].name]
        backward(First(TERMS), [[toy.forward]], toy, together=Together(ranks))
        return unused.grad, toy.own[TERMS[0].name].grad

    for unused, used in side_by_side(2, grads):
        assert unused is None
        assert used is not None


def test_a_method_with_state_of_its_own_kind_fails_the_check():
    class Global(LossMethod):
        """Its state is the class's, which all ranks and runs share."""

        calls = 0

        def total(self, step):
            type(self).calls += 1
            return step.loss_K.sum() * type(self).calls

    with pytest.raises(ValueError, match="differs from one process"):
        METHOD_CHECKS["two ranks are one"](Global)
