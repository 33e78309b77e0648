"""What is not finite stops the step that made it, under its maker's name, and is never saved."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import typer
from support.training import curve, run

from mtl_bench.cli.app import Group
from mtl_bench.core.device import Compute
from mtl_bench.core.method import GradientMethod, LossMethod
from mtl_bench.train import checkpoint, loop

NAN = float("nan")
LAST = 5  # of the smoke recipe's six steps


class Counted:
    """A method whose answer fails at the last step."""

    calls = 0

    def factor(self):
        self.calls += 1
        return NAN if self.calls == LAST + 1 else 1.0


class NaNWeights(Counted, LossMethod):
    def total(self, step):
        return self.factor() * step.loss_K.sum()


class NaNTotal(Counted, LossMethod):
    def total(self, step):
        return step.loss_K.sum() + self.factor()


class NaNGramianWeights(Counted, GradientMethod):
    def weights(self, G_KK, step):
        return torch.full_like(step.loss_K, self.factor())


class NaNDirection(Counted, GradientMethod):
    needs = "jacobian"

    def direction(self, J_KP, step):
        return self.factor() * J_KP.sum(0), torch.ones_like(step.loss_K)


class NaNParameter(Counted, LossMethod):
    """Its own parameter gets a gradient that is not finite, the losses get one that is."""

    def __init__(self, terms, seed=0):
        super().__init__(terms, seed)
        self.own = torch.nn.Parameter(torch.zeros(()))

    def total(self, step):
        gradient = self.factor()
        self.own.register_hook(lambda grad: grad * gradient)
        return step.loss_K.sum() + self.own


class NaNState(Counted, LossMethod):
    """Learns nonsense after the step; an infinity in its state is no fault."""

    reevaluates = True

    def __init__(self, terms, seed=0):
        super().__init__(terms, seed)
        self.register_buffer("state", torch.zeros(()))
        self.register_buffer("best", torch.tensor(float("inf")))

    def total(self, step):
        return step.loss_K.sum()

    def after_step(self, step, after_K):
        self.state = self.state * self.factor()


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (NaNWeights, "method 'fixed' weighs 'semantic' by nan at step 5"),
        (NaNTotal, "method 'fixed' makes nan of the losses .* at step 5"),
        (NaNGramianWeights, "method 'fixed' weighs 'semantic' by nan at step 5"),
        (NaNDirection, "method 'fixed' leaves a gradient of norm nan at step 5"),
        (NaNParameter, "method 'fixed' leaves a gradient of norm nan at step 5"),
        (NaNState, "'state' of method 'fixed' is not finite after step 6"),
    ],
)
def test_a_method_is_named_and_its_nonsense_not_saved(
    kind, words, monkeypatch, smoke_cell, smoke_root, tmp_path
):
    """At the last step it would make a row; of a step before, every retry would go on."""
    monkeypatch.setattr(loop, "build_method", lambda cell, terms: kind(terms))
    cell = replace(smoke_cell, method="fixed", tasks=("panoptic",))
    with pytest.raises(FloatingPointError, match=words):
        run(cell, smoke_root, tmp_path / "run")
    kept = checkpoint.read(tmp_path / "run" / "last.pt")
    assert kept["step"] == 3
    assert all(v.isfinite().all() for v in kept["model"].values())
    run(cell, smoke_root, tmp_path / "run")  # a retry goes on from what was good


def test_weights_that_the_last_step_blew_up_are_not_saved(
    monkeypatch, smoke_cell, smoke_root, tmp_path, with_optim
):
    real = Compute.apply

    def blown(self, optimizer):
        real(self, optimizer)
        optimizer.param_groups[0]["params"][0].data[0] = NAN

    monkeypatch.setattr(Compute, "apply", blown)
    cell = with_optim(smoke_cell, steps=1)
    with pytest.raises(FloatingPointError, match="of the model is not finite after step 1"):
        run(cell, smoke_root, tmp_path / "run")
    assert not (tmp_path / "run" / "last.pt").exists()


@pytest.fixture
def scaled(monkeypatch):
    """The CPU with the loss scale of fp16."""
    real = torch.amp.GradScaler

    def start_at(scale):
        make = partial(real, init_scale=scale)
        monkeypatch.setattr(torch.amp, "GradScaler", lambda device, enabled: make(device))

    return start_at


def test_fp16_may_overflow_while_its_scale_can_fall(
    scaled, monkeypatch, smoke_cell, smoke_root, tmp_path
):
    """Gradients that are not finite are the scale's fault, and the step is passed over."""
    cell = replace(smoke_cell, method="fixed", tasks=("panoptic",))
    scaled(2.0**125)
    run(cell, smoke_root, tmp_path / "run")
    assert curve(tmp_path / "run")[0]["grad_norm"] in ("inf", "nan")
    assert checkpoint.read(tmp_path / "run" / "last.pt")["scaler"]["scale"] < 2.0**125

    scaled(1.0)
    monkeypatch.setattr(loop, "build_method", lambda cell, terms: NaNDirection(terms))
    with pytest.raises(FloatingPointError, match="leaves a gradient of norm nan at step 5"):
        run(cell, smoke_root, tmp_path / "other")


def test_training_that_blew_up_is_one_line(capsys):
    """A user's learning rate is no bug of ours: no traceback."""
    blown = typer.Typer(cls=Group, pretty_exceptions_enable=False)

    @blown.command()
    def train():
        raise FloatingPointError("method 'x' weighs 'y' by nan at step 3")

    @blown.command()
    def other(): ...

    with pytest.raises(SystemExit) as stop:
        blown(["train"])
    assert stop.value.code == 2
    assert capsys.readouterr().err == "mtl-bench: method 'x' weighs 'y' by nan at step 3\n"
