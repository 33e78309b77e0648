"""A term whose pixels are none is absent, as one without labels is: nobody takes it for solved."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from support.terms import TERMS, WHOLE_TASKS
from support.training import curve, run

from mtl_bench.bench.check.methods import Quadratics
from mtl_bench.bench.check.tasks import TASK_CHECKS
from mtl_bench.core import plugins
from mtl_bench.core.labels import OUTSIDE
from mtl_bench.core.method import LossMethod
from mtl_bench.core.terms import gather
from mtl_bench.data.samples import Samples
from mtl_bench.train.backward import UnlabelledError, backward, reevaluate

NAMES = [term.name for term in TERMS]


class Squares(LossMethod):
    def total(self, step):
        return step.loss_K.square().sum()


def without(*absent):
    return tuple(term for term in TERMS if term.name not in absent)


def test_a_task_is_the_sum_of_the_terms_that_are_there():
    losses = {name: torch.tensor(float(i)) for i, name in enumerate(NAMES, 1)}
    del losses["offset"]
    mine = gather(losses, WHOLE_TASKS)
    assert mine["panoptic"].item() == pytest.approx(1 + 200 * 2)
    assert list(gather({"photometric": losses["photometric"]}, WHOLE_TASKS)) == ["depth"]


@pytest.mark.parametrize("name", ["famo", "uncertainty_soft", "gls", "mgda"])
def test_a_batch_without_an_instance_weighs_the_rest_as_if_offset_were_unknown(name):
    """With an offset loss of 0 these weighed everything else by about 1e-8."""
    kind = plugins.load("methods", name)
    toy, other = Quadratics(TERMS), Quadratics(TERMS)
    toy.terms = other.terms = without("offset")
    found = backward(kind(TERMS), [[toy.forward]], toy).weights
    expected = backward(kind(without("offset")), [[other.forward]], other).weights
    assert "offset" not in found
    assert max(found.values()) > 0.01
    if name != "uncertainty_soft":  # whose weights start at 1 / T
        assert found == pytest.approx(expected)


@pytest.mark.parametrize("terms", [TERMS, WHOLE_TASKS])
def test_parts_with_other_terms_give_the_gradient_of_what_the_method_saw(terms):
    """The first part has no offset: order and means stay those of the method."""
    toy, step = Quadratics(TERMS), {}
    sees = Squares(terms)
    sees.total = lambda given: (step.update(seen=given), given.loss_K.square().sum())[1]

    def part(present):
        toy.terms = present
        return toy.forward()

    parts = [partial(part, without("offset")), partial(part, TERMS)]
    weighting = backward(sees, [parts], toy)
    assert list(weighting.weights) == [term.name for term in terms]
    first, second = (gather(one().losses, terms) for one in parts)
    means = torch.stack(
        [torch.stack([x[t.name] for x in (first, second) if t.name in x]).mean() for t in terms]
    )
    torch.testing.assert_close(step["seen"].loss_K, means.detach())
    expected = torch.autograd.grad(means.square().sum(), toy.shared)[0]
    torch.testing.assert_close(toy.shared.grad, expected)


def test_a_method_that_looks_again_hears_of_the_terms_that_are_left():
    heard = {}

    class Hears(Squares):
        reevaluates = True

        def after_step(self, step, after_K):
            heard.update(step=step, after=after_K)

    toy, method = Quadratics(TERMS), Hears(TERMS)
    weighting = backward(method, [[toy.forward]], toy)
    toy.terms = without("photometric")
    reevaluate(method, weighting.step, [toy.forward], toy)
    assert heard["step"].present.tolist() == [0, 1, 2, 4]
    assert len(heard["step"].loss_K) == len(heard["after"]) == 4
    toy.terms = ()
    reevaluate(method, weighting.step, [toy.forward], toy)  # nothing is left: nothing is heard
    assert len(heard["after"]) == 4


@pytest.mark.parametrize("name", ["modo", "auto_lambda"])
def test_a_method_of_several_batches_takes_other_terms_in_each(name):
    toy = Quadratics(TERMS)
    method = plugins.load("methods", name)(TERMS)

    def part(*absent):
        toy.terms = without(*absent)
        return toy.forward()

    batches = [partial(part), partial(part, "offset"), partial(part, "photometric")]
    weighting = backward(method, [[one] for one in batches[: method.batches]], toy, lr=0.1)
    assert all(value == value for value in weighting.weights.values())
    before = toy.shared.detach().clone()
    batches = [partial(part), partial(part, *NAMES), partial(part)]
    with pytest.raises(UnlabelledError):
        backward(method, [[one] for one in batches[: method.batches]], toy, lr=0.1)
    assert torch.equal(toy.shared, before)  # also where the method had looked ahead


# --- tasks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panoptic", "depth"])
def test_a_sample_of_padding_has_no_terms(name):
    assert TASK_CHECKS["no pixels, no terms"](plugins.load("tasks", name)) is None


def test_a_task_whose_empty_mean_is_zero_fails_the_check(monkeypatch):
    kind = plugins.load("tasks", "panoptic")
    real = kind.losses

    def zero(self, maps, batch):
        nothing = maps["semantic"].sum() * 0
        return {term.name: nothing for term in self.terms} | real(self, maps, batch)

    monkeypatch.setattr(kind, "losses", zero)
    with pytest.raises(ValueError, match="without a valid pixel has the terms semantic, center"):
        TASK_CHECKS["no pixels, no terms"](kind)


# --- the loop -------------------------------------------------------------------------------------


def void(monkeypatch, when):
    """Samples of these numbers have no label at all."""
    real, count = Samples._augmented, iter(range(10**6))

    def augmented(self, name, frame, generator):
        if when(next(count)):
            ids = torch.full_like(frame.fields["instance_ids"], OUTSIDE)
            frame = replace(frame, fields={**frame.fields, "instance_ids": ids})
        return real(self, name, frame, generator)

    monkeypatch.setattr(Samples, "_augmented", augmented)


def test_a_batch_without_a_label_is_passed_over(monkeypatch, smoke_cell, smoke_root, tmp_path):
    cell = replace(smoke_cell, tasks=("panoptic",), method="famo")
    size = cell.recipe.optim.batch
    void(monkeypatch, lambda number: number // size == 2)
    run(cell, smoke_root, tmp_path / "run")
    rows = curve(tmp_path / "run")
    assert [row["loss.semantic"] == "" for row in rows] == [i == 2 for i in range(len(rows))]
    assert rows[2]["grad_norm"] == "0"


def test_a_first_batch_without_a_label_is_an_error(monkeypatch, smoke_cell, smoke_root, tmp_path):
    void(monkeypatch, lambda number: True)
    with pytest.raises(ValueError, match="without labels for any of the cell's tasks"):
        run(replace(smoke_cell, tasks=("panoptic",)), smoke_root, tmp_path / "run")
