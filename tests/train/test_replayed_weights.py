"""Weights of one run, given to another: which, when, and to what."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from support.terms import TERMS
from support.training import curve, run, scales_cell, scales_root

from mtl_bench.bench.check.methods import Quadratics
from mtl_bench.core import plugins
from mtl_bench.core.config import REPLAYS, Cell, check_cells, load_recipe, override
from mtl_bench.core.method import Step
from mtl_bench.train import checkpoint
from mtl_bench.train.backward import backward
from mtl_bench.train.curve import Curve
from mtl_bench.train.progress import Interrupted, Progress
from mtl_bench.train.replay import GradientReplay, LossReplay, arranged

NAN = math.nan
SERIES_SHT = torch.tensor(  # a batch without the second loss, and one without any
    [[[1.0, 4.0]], [[3.0, NAN]], [[2.0, 8.0]], [[NAN, NAN]], [[6.0, 6.0]]], dtype=torch.float64
)


def values(mode: str) -> list:
    return arranged(SERIES_SHT, mode, seed=0)[:, 0].tolist()


def test_mean_and_final_are_of_the_steps_that_have_the_loss():
    assert values("mean") == [[3.0, 6.0]] * 5
    assert values("final") == [[6.0, 6.0]] * 5
    cut = SERIES_SHT[:2]
    assert arranged(cut, "final", seed=0)[:, 0].tolist() == [[3.0, 4.0]] * 2


def test_shuffled_is_a_permutation_among_steps_with_the_same_losses():
    found = values("shuffled")
    assert sorted(found[i] for i in (0, 2, 4)) == [[1.0, 4.0], [2.0, 8.0], [6.0, 6.0]]
    assert found[1] == [3.0, 6.0]  # its mean, should the batch have the loss after all
    assert found[3] == [3.0, 6.0]
    whole = torch.arange(200.0).reshape(100, 2)[:, None]
    one, same, other = (arranged(whole, "shuffled", seed) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert not torch.equal(one, whole)
    assert torch.equal(one[one[:, 0, 0].argsort()], whole)  # pairs stay together


def test_level_is_the_mean_of_every_step():
    mean = (2.5 + 3 + 5 + 6) / 4
    assert values("level") == [[2.5] * 2, [3.0] * 2, [5.0] * 2, [mean] * 2, [6.0] * 2]


# --- one step -------------------------------------------------------------------------------------


def given(kind, weights_HT):
    method = kind(TERMS)
    method.series_SHT = torch.tensor([weights_HT])
    method.at(0)
    return method


def part(toy, terms):
    toy.terms = terms
    return toy.forward()


def test_what_is_shared_and_what_is_not_have_weights_of_their_own():
    """In two parts, of which the first lacks a loss: as the mean of the parts that have it."""
    weight, head = [1.0, 2.0, 0.5, 0.25, 3.0], [1.0, 1.0, 4.0, 1.0, 0.5]
    toy = Quadratics(TERMS)
    parts = [partial(part, toy, TERMS[:2] + TERMS[3:]), partial(part, toy, TERMS)]
    found = backward(given(GradientReplay, [weight, head]), [parts], toy, scale=8.0, cosines=True)
    assert list(found.weights.values()) == weight
    assert list(found.heads.values()) == head
    assert len(found.cosines) == 6  # of the first part
    toy.terms = TERMS
    losses = toy.forward().losses
    for factors, parameters in ((weight, [toy.shared]), (head, list(toy.own.values()))):
        total = sum(w * loss for w, loss in zip(factors, losses.values(), strict=True))
        for parameter, grad in zip(
            parameters, torch.autograd.grad(total, parameters, retain_graph=True), strict=True
        ):
            torch.testing.assert_close(parameter.grad, 8 * grad)


@pytest.mark.parametrize("name", ["nash", "mgda_ub", "fixed_uncertainty+pcgrad", "uncertainty"])
def test_a_step_is_that_of_the_method_whose_weights_they_are(name):
    from mtl_bench.train.compose import compose

    method, toy, other = compose(name, {}, TERMS, 0), Quadratics(TERMS), Quadratics(TERMS)
    toy.terms = other.terms = TERMS[1:]
    seen = backward(method, [[toy.forward]], toy)
    kind = GradientReplay if seen.heads else LossReplay
    rows = [seen.weights, seen.heads] if seen.heads else [seen.weights]
    replay = given(kind, [[row.get(term.name, 0.0) for term in TERMS] for row in rows])
    again = backward(replay, [[other.forward]], other)
    assert again.weights == seen.weights
    assert again.heads == seen.heads
    for (key, one), two in zip(toy.named_parameters(), other.parameters(), strict=True):
        if one.grad is not None or two.grad is not None:
            torch.testing.assert_close(one.grad, two.grad, msg=key)


def test_a_loss_without_a_weight_is_left_out():
    replay = given(LossReplay, [[1.0, 2.0, 3.0, 4.0, 5.0]])
    step = Step(torch.tensor([10.0, 1.0]), torch.tensor([1, 4]))
    assert replay.total(step) == 25


# --- runs -----------------------------------------------------------------------------------------


def model_of(run_dir):
    return checkpoint.read(run_dir / "last.pt")["model"]


@pytest.mark.parametrize(("method", "mode"), [("uncertainty", "shuffled"), ("nash", "level")])
def test_an_interrupted_replay_ends_bit_for_bit_as_one_that_was_not(method, mode, tmp_path):
    class Asked(Progress):
        def update(self, stage, step, steps, note=""):
            self.stop_asked = step == 2

    origin, root = scales_cell(method), scales_root()
    run(origin, root, tmp_path / "record")
    cell, record = replace(origin, replay=mode), tmp_path / "record" / "curve.csv"
    run(cell, root, tmp_path / "straight", record=record)
    stopped = tmp_path / "stopped"
    stopped.mkdir()
    with pytest.raises(Interrupted, match="stopped at step 2 of 5"):
        run(cell, root, stopped, Asked(stopped, print), record=record)
    run(cell, root, stopped, record=record)
    one, two = model_of(tmp_path / "straight"), model_of(stopped)
    assert all(torch.equal(one[key], two[key]) for key in one)
    keep = [key for key in curve(stopped)[0] if not key.endswith("_ms")]
    rows = [curve(tmp_path / name) for name in ("straight", "stopped")]
    assert [[r[k] for k in keep] for r in rows[0]] == [[r[k] for k in keep] for r in rows[1]]


def test_constant_weights_replayed_are_the_same_training(tmp_path):
    origin, root = scales_cell("fixed"), scales_root()
    run(origin, root, tmp_path / "record")
    for mode in REPLAYS[:3]:
        cell, record = replace(origin, replay=mode), tmp_path / "record" / "curve.csv"
        run(cell, root, tmp_path / mode, record=record)
        one, two = model_of(tmp_path / "record"), model_of(tmp_path / mode)
        assert all(torch.equal(one[key], two[key]) for key in one)


def test_shared_decoders_and_parts_of_a_batch(smoke_cell, smoke_root, tmp_path):
    """Weights that do not change, of a method with others for the decoders."""
    origin = replace(smoke_cell, method="nash", method_args={"every": 100, "max_norm": math.inf})
    origin = override(origin, ["recipe.optim.micro_batch=2", "recipe.optim.steps=3"])
    run(origin, smoke_root, tmp_path / "record")
    cell, record = replace(origin, replay="final"), tmp_path / "record" / "curve.csv"
    run(cell, smoke_root, tmp_path / "again", record=record)
    one, two = (curve(tmp_path / name) for name in ("record", "again"))
    for key in [key for key in one[0] if key.startswith(("loss.", "weight.", "head."))]:
        values = [[float(row[key]) for row in rows] for rows in (one, two)]
        assert values[0] == pytest.approx(values[1], rel=1e-3), key


def test_the_log_keeps_every_digit_of_a_weight(tmp_path):
    weight_ST = torch.rand(50, 2) * 10 ** torch.linspace(-30, 30, 50)[:, None]
    with Curve(tmp_path / "curve.csv") as log:
        for step, (one, two) in enumerate(weight_ST.tolist(), 1):
            log.append({"step": step, "weight.semantic": one, "weight.center": two})
    replay = LossReplay(TERMS[:2])
    replay.take(tmp_path / "curve.csv", 50, "shuffled", 0)
    kept = {tuple(row) for row in replay.series_SHT[:, 0].tolist()}
    assert kept == {tuple(row) for row in weight_ST.tolist()}


def test_a_record_that_is_too_short_or_lacks_a_loss_is_one_line(tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("step,weight.semantic\r\n1,1.0\r\n")
    with pytest.raises(ValueError, match=r"curve.csv has no 'weight.center': train its cell again"):
        LossReplay(TERMS).take(path, 1, "mean", 0)
    with pytest.raises(ValueError, match=r"curve.csv has 1 of 2 steps"):
        LossReplay(TERMS[:1]).take(path, 2, "mean", 0)


# --- cells ----------------------------------------------------------------------------------------


def test_its_parent_is_the_same_cell_without_it():
    cell = Cell(load_recipe("smoke"), "tiny", "nash", replay="mean", seed=3)
    assert cell.parents == (replace(cell, replay=None),)
    assert cell.parents[0] == Cell(load_recipe("smoke"), "tiny", "nash", seed=3)
    assert len({replace(cell, replay=mode).id for mode in (None, *REPLAYS)}) == 5
    assert cell.label == "nash tiny s3 replay mean"
    apart = replace(cell, single_task=True)
    assert [parent.replay for parent in apart.parents] == ["mean", "mean"]


@pytest.mark.parametrize("other", ["video", "continues"])
def test_what_begins_with_another_training_is_not_replayed(other):
    cell = Cell(load_recipe("smoke"), "tiny", "nash", replay="mean")
    values = {"video": True, "continues": replace(cell, replay=None)}
    with pytest.raises(ValueError, match=f"replay and {other} exclude each other"):
        replace(cell, **{other: values[other]})


REFUSED = {"auto_lambda", "db_mtl", "graddrop", "moco", "modo", "samo", "sdmgrad"}


def test_methods_say_whether_their_weights_can_be_trained_with_again():
    for name in plugins.files("methods"):
        cell = Cell(load_recipe("smoke"), "tiny", name, replay="mean")
        check_cells([cell.parents[0]])
        if name in REFUSED:
            why = f"replay=mean: an update of method '{name}' is no sum of one batch's gradients"
            with pytest.raises(ValueError, match=why):
                check_cells([cell])
        else:
            check_cells([cell])
    with pytest.raises(ValueError, match="'graddrop' is no sum"):
        check_cells([Cell(load_recipe("smoke"), "tiny", "uncertainty+graddrop", replay="level")])
