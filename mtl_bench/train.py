"""The training loop, to be read from top to bottom."""

import time
from pathlib import Path

import torch
from torch import Tensor

from mtl_bench import checkpoint, plugins
from mtl_bench.backward import Weighting, backward
from mtl_bench.config import Cell, Optim
from mtl_bench.curve import Curve
from mtl_bench.data.labels import LabelSet
from mtl_bench.data.loader import open_dataset, train_batches
from mtl_bench.engine import Engine, initial_weights, seed_for
from mtl_bench.losses import loss_terms
from mtl_bench.losses.terms import terms_of
from mtl_bench.method import Method
from mtl_bench.model import Model, build_model
from mtl_bench.progress import Interrupted, Progress
from mtl_bench.tracking import Tracker

CHECKPOINT = "last.pt"


def train(
    cell: Cell,
    labels: LabelSet,
    root: Path,
    run_dir: Path,
    engine: Engine,
    progress: Progress,
    tracker: Tracker,
) -> Model:
    """Train a cell to its last step, from its checkpoint where there is one.

    Args:
        root: the data set.
        run_dir: where `last.pt` and `curve.csv` are kept.

    Raises:
        FloatingPointError: a loss term is NaN or infinite.
        Interrupted: a signal asked to stop; the state is saved.
    """
    optim = cell.recipe.optim
    model, method, optimizer = build(cell, labels, engine)
    torch.manual_seed(seed_for(cell.seed, "training"))  # what a plug-in may draw, such as dropout
    path, step = run_dir / CHECKPOINT, 0
    if path.is_file():
        state = checkpoint.read(path)
        step = checkpoint.restore(state, model, method, optimizer, engine.scaler)
        progress.say(f"continuing at step {step} of {optim.steps}")

    dataset = open_dataset(cell, "train", root, training=True)
    batches = train_batches(
        dataset, optim.batch, seed_for(cell.seed, "data"), step, cell.recipe.data.workers
    )
    clipped: list[Tensor] = list(model.parameters())
    model.train()

    def save() -> None:
        curve.flush()  # first: the rows up to a checkpoint's step must never be missing
        checkpoint.save(path, step, model, method, optimizer, engine.scaler)

    with Curve(run_dir / "curve.csv", step) as curve:
        while step < optim.steps:
            step_start = time.perf_counter()
            lr_factor = set_learning_rate(optimizer, optim, step)
            batch = next(batches).to(engine.device, engine.channels_last)
            with engine.autocast():
                outputs = model.net(batch.image_B3HW)
                transforms = None
                if model.pose is not None:
                    transforms = model.pose(batch.image_B3HW, batch.context_BN3HW)
            losses = loss_terms(batch, outputs, transforms, cell.recipe.loss, cell.tasks)
            check_finite(losses, step)
            optimizer.zero_grad(set_to_none=True)
            weighting = backward(method, losses, model, engine.scaler.get_scale())
            grad_norm = engine.apply_gradients(optimizer, clipped, optim.clip)
            step += 1

            row = describe_step(losses, weighting, method)
            row |= {"grad_norm": grad_norm, "lr_factor": lr_factor}
            row["step_ms"] = 1000 * (time.perf_counter() - step_start)
            curve.append({"step": step, **row})
            tracker.log(row, step)
            progress.update("train", step, optim.steps, f"loss {weighting.total:.3f}")
            if step % optim.checkpoint_every == 0 or step == optim.steps or progress.stop_asked:
                save()
            if progress.stop_asked:
                raise Interrupted(f"stopped at step {step} of {optim.steps}, saved in {path}")
    return model


def build(
    cell: Cell, labels: LabelSet, engine: Engine
) -> tuple[Model, Method, torch.optim.Optimizer]:
    """Model, method and optimiser as they are before the first step."""
    optim = cell.recipe.optim
    if optim.batch < 2:
        raise ValueError("optim.batch must be at least 2: batch statistics of 1x1 maps need two")
    with initial_weights(cell.seed):
        model = build_model(cell, labels)
    kind = plugins.load("methods", cell.method)
    method = kind(terms_of(cell.tasks), seed=seed_for(cell.seed, "method"), **cell.method_args)
    engine.place(model)
    method.to(engine.device)
    heads = list(model.head_parameters())
    in_heads = {id(parameter) for parameter in heads}
    rest = [parameter for parameter in model.parameters() if id(parameter) not in in_heads]
    decay = optim.weight_decay
    groups = [
        {"params": rest, "lr": optim.lr, "weight_decay": decay},
        {"params": heads, "lr": optim.lr * optim.head_lr_factor, "weight_decay": decay},
        {"params": list(method.parameters()), "lr": optim.method_lr, "weight_decay": 0.0},
    ]
    groups = [group for group in groups if group["params"]]
    for group in groups:
        group["initial_lr"] = group["lr"]
    return model, method, torch.optim.Adam(groups, fused=True)


def schedule(step: int, optim: Optim) -> float:
    """Learning-rate factor: polynomial decay times a linear warm-up."""
    warm = 1.0
    if step < optim.warmup_steps:
        warm = optim.warmup_factor + (1 - optim.warmup_factor) * step / optim.warmup_steps
    return warm * (1 - step / optim.steps) ** optim.poly_power


def set_learning_rate(optimizer: torch.optim.Optimizer, optim: Optim, step: int) -> float:
    factor = schedule(step, optim)
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor
    return factor


def check_finite(losses: dict[str, Tensor], step: int) -> None:
    for name, loss in losses.items():
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"loss term '{name}' is {loss.item()} at step {step}: lower recipe.optim.lr, "
                f"or set recipe.optim.clip, and look at the batch's data"
            )


def describe_step(
    losses: dict[str, Tensor], weighting: Weighting, method: Method
) -> dict[str, float]:
    """The columns of the curve that say what was minimised and how it was weighted."""
    row = {"total": weighting.total}
    for term, weight in zip(method.terms, weighting.weight_T.tolist(), strict=True):
        row[f"loss.{term.name}"] = losses[term.name].item()
        row[f"weight.{term.name}"] = weight
    return row
