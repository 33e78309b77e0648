"""The training loop, to be read from top to bottom."""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, Optim
from mtl_bench.core.device import Compute, drawing, initial_weights, seed_for
from mtl_bench.core.method import LossMethod, Method, Step
from mtl_bench.core.ranks import ALONE, Ranks, check_share
from mtl_bench.core.task import Task, tasks_of_cell, terms_of
from mtl_bench.core.terms import Term
from mtl_bench.data.loader import train_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.model import Model, build_model
from mtl_bench.train import checkpoint, one_batch
from mtl_bench.train.backward import Forward, Pass, UnlabelledError, Weighting, backward, reevaluate
from mtl_bench.train.compose import compose
from mtl_bench.train.curve import Curve, Unwritten
from mtl_bench.train.progress import Interrupted, Pace, Progress
from mtl_bench.train.replay import Replay, replay_of
from mtl_bench.train.statistics import silence_constants
from mtl_bench.train.together import Together
from mtl_bench.train.tracking import Tracker

CHECKPOINT = "last.pt"
NOTHING = Weighting(0.0, Step(torch.zeros(0), torch.zeros(0, dtype=torch.int64)), {}, {})


def train(
    cell: Cell,
    root: Path,
    run_dir: Path,
    compute: Compute,
    progress: Progress,
    tracker: Tracker,
    *,
    ranks: Ranks = ALONE,
    start: Path | None = None,
    further_labels: Path | None = None,
    record: Path | None = None,
    rehearse: Callable[[Model], None] | None = None,
) -> Model:
    """Train a cell to its last step, from its own checkpoint where there is one.

    On several ranks each calls this, and rank 0 alone writes.

    Args:
        root: the data set.
        ranks: those that share the parts of every batch, or the samples of one whole batch.
        run_dir: where `last.pt` and `curve.csv` are kept.
        start: checkpoint whose model and method a fresh run goes on from; optimiser and learning
            rate begin anew.
        further_labels: folder of labels of further frames to train on.
        record: curve of the run whose weights a replay trains with.
        rehearse: is shown the model before the first step, to raise what would stop it after the
            last.

    Raises:
        FloatingPointError: a loss term, the method's answer or what would be saved is NaN or
            infinite.
        UnlabelledError: the first batch has no pixel of any term; a later one is passed over.
        Interrupted: a signal asked to stop; the state is saved.
    """
    optim = cell.recipe.optim
    check_share(optim, ranks.size)
    model, method, optimizer = build(cell, compute)
    path, step = run_dir / CHECKPOINT, 0
    if isinstance(method, Replay):
        assert record is not None
        assert cell.replay is not None
        method.take(record, optim.steps, cell.replay, seed_for(cell.seed, "replay"))
    begun = ranks.from_first(path.is_file())
    if rehearse is not None and not begun:
        rehearse(model)
    torch.manual_seed(seed_for(cell.seed, "training"))  # what a plug-in may draw, such as dropout
    if begun:
        step = checkpoint.restore(path, cell, model, method, optimizer, compute.scaler)
        progress.say(f"continuing at step {step} of {optim.steps}")
    elif start is not None:
        checkpoint.restore_weights(start, model, method)

    samples = open_samples(
        cell.recipe, model.tasks, "train", root, training=True, further_labels=further_labels
    )
    for task in model.tasks:
        task.begin(samples.dataset)
    data_seed, first = seed_for(cell.seed, "data"), step * method.batches
    workers = cell.recipe.data.workers
    share = ranks.rank, ranks.size
    batches = train_batches(samples, optim.batch, data_seed, first, workers, compute.pinned, share)
    clipped: list[Tensor] = list(model.parameters())
    model.train()

    def save() -> None:
        check_state(model, method, optimizer, cell.method, step)
        check_equal(model, ranks, step)
        if ranks.first:
            curve.flush()  # first: the rows up to a checkpoint's step must never be missing
            checkpoint.save(path, step, model, method, optimizer, compute.scaler, cell)

    def forward(part: Batch, seed: int | None) -> Pass:
        with drawing(seed, compute.device):
            with compute.autocast():
                outputs = model(part)
            return Pass(model.losses(outputs, part), outputs.representation)

    def forward_own(own: Batch, whole: Batch, seed: int, whole_seed: int) -> Pass:
        """Losses of the whole batch, of which this rank's samples went through the network."""
        with drawing(seed, compute.device), one_batch.Synchronised(ranks), compute.autocast():
            outputs = model(own)
        outputs.maps = one_batch.joined(outputs.maps, own, ranks)
        with drawing(whole_seed, compute.device):  # losses that draw: every rank the same
            return Pass(model.losses(outputs, whole), outputs.representation)

    def parts_of(batch: Batch, number: int) -> list[Forward]:
        """This rank's parts. Each of several draws what it draws from a seed of its own."""
        if together.one_batch:
            own = batch.to(compute.device)
            name = f"batch {number}"
            seeds = (
                seed_for(cell.seed, purpose) for purpose in (f"{name} part {ranks.rank}", name)
            )
            return [partial(forward_own, own, one_batch.whole(own, ranks), *seeds)]
        split = batch.split(optim.micro_batch or optim.batch)
        several, before = len(split) * ranks.size > 1, len(split) * ranks.rank
        return [
            partial(
                forward,
                part.to(compute.device),
                seed_for(cell.seed, f"batch {number} part {index}") if several else None,
            )
            for index, part in enumerate(split, before)
        ]

    def settle() -> None:
        """Batch norms' statistics become those of the network as it is after the last step."""
        further = optim.statistics_batches
        if further:
            with torch.no_grad(), together.mean_statistics(model):
                for number in range(further):
                    for part in parts_of(next(batches), step * method.batches + number):
                        part()
                    progress.update("statistics", number + 1, further)
        if silenced := silence_constants(model):
            progress.say(f"channels that were constant in training, and stay so: {silenced}")

    def check(losses: Mapping[str, Tensor]) -> None:
        check_finite(losses, step)

    shared = optim.one_batch and ranks.size > 1
    together = Together(ranks, check, compute.device, shared)
    pace = Pace()
    with Curve(run_dir / "curve.csv", step) if ranks.first else Unwritten() as curve:
        while step < optim.steps:
            step_start = time.perf_counter()
            lr_factor = set_learning_rate(optimizer, optim, step)
            drawn = [next(batches) for _ in range(method.batches)]
            data_ms = 1000 * (time.perf_counter() - step_start)
            parts = [parts_of(batch, step * method.batches + n) for n, batch in enumerate(drawn)]
            optimizer.zero_grad(set_to_none=True)
            weighting, update_norm, grad_norm = NOTHING, 0.0, 0.0
            if isinstance(method, Replay):
                method.at(step)
            try:
                weighting = backward(
                    method,
                    parts,
                    model,
                    scale=compute.scaler.get_scale(),
                    lr=optimizer.param_groups[0]["lr"],
                    cosines=bool(optim.cosine_every) and step % optim.cosine_every == 0,
                    together=together,
                )
            except UnlabelledError:
                if step == 0:  # rather a folder without labels than an unlucky crop
                    raise
            else:
                update_norm = norm_of(model.shared_parameters()) / compute.scaler.get_scale()
                grad_norm = compute.gradient_norm(optimizer, clipped, optim.clip)
                if not compute.skips_overflow:
                    check_weighting(weighting, cell.method, step)
                    norms = (update_norm, grad_norm, norm_of(method.parameters()))
                    check_gradients(norms, cell.method, step)
                compute.apply(optimizer)
                if method.reevaluates:
                    reevaluate(method, weighting.step, parts[0], model, together)
            step += 1

            row = describe_step(weighting, method, model.tasks, bool(optim.cosine_every))
            row |= {"update_norm": update_norm, "grad_norm": grad_norm, "lr_factor": lr_factor}
            row["data_ms"] = data_ms  # the step's share that waited for its batches
            row["step_ms"] = step_ms = 1000 * (time.perf_counter() - step_start)
            curve.append({"step": step, **row})
            tracker.log({key: value for key, value in row.items() if value is not None}, step)
            progress.update("train", step, optim.steps, f"loss {weighting.total:.3f}")
            if slow := pace.note(step_ms, data_ms):
                progress.say(slow)
            stop = ranks.any(progress.stop_asked)
            if step == optim.steps:
                settle()
            if step % optim.checkpoint_every == 0 or step == optim.steps or stop:
                save()
            if stop:
                raise Interrupted(f"stopped at step {step} of {optim.steps}, saved in {path}")
    return model


def build(cell: Cell, compute: Compute) -> tuple[Model, Method, torch.optim.Optimizer]:
    """Model, method and optimiser as they are before the first step."""
    optim = cell.recipe.optim
    tasks = tasks_of_cell(cell)
    with initial_weights(cell.seed):
        model = build_model(cell, tasks)
    method = build_method(cell, terms_of(tasks, cell.granularity))
    compute.place(model)
    method.to(compute.device)
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


def build_method(cell: Cell, terms: Sequence[Term]) -> Method:
    """The cell's method over these terms, or what replays it."""
    method = compose(cell.method, cell.method_args, terms, seed_for(cell.seed, "method"))
    return method if cell.replay is None else replay_of(method)


def schedule(step: int, optim: Optim) -> float:
    """Learning-rate factor: polynomial decay, a linear warm-up and milestones, multiplied."""
    warm = 1.0
    if step < optim.warmup_steps:
        warm = optim.warmup_factor + (1 - optim.warmup_factor) * step / optim.warmup_steps
    passed = sum(step >= milestone for milestone in optim.milestones)
    decay: float = (1 - step / optim.steps) ** optim.poly_power
    found: float = warm * decay * optim.milestone_factor**passed
    return found


def set_learning_rate(optimizer: torch.optim.Optimizer, optim: Optim, step: int) -> float:
    factor = schedule(step, optim)
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor
    return factor


def check_equal(model: nn.Module, ranks: Ranks, step: int) -> None:
    """Raise where the ranks' models differ: what was not made of the same numbers drifts apart."""
    if ranks.size == 1:
        return
    state = model.state_dict()
    sums = [value.double().sum().item() for value in state.values()]
    for rank, others in enumerate(ranks.gather(sums)):
        for key, own, other in zip(state, sums, others, strict=True):
            if own != other:
                raise ValueError(
                    f"'{key}' differs between ranks {ranks.rank} and {rank} after step {step}, by "
                    f"{abs(own - other):.3g} in sum: run them on processors of one kind; or a "
                    f"module changes it in its forward pass, which only batch norms may"
                )


def check_finite(losses: Mapping[str, Tensor], step: int) -> None:
    for name, loss in losses.items():
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"loss term '{name}' is {loss.item()} at step {step}: lower recipe.optim.lr, "
                f"or set recipe.optim.clip, and look at the batch's data"
            )


def check_weighting(weighting: Weighting, method: str, step: int) -> None:
    """Raise where the method's answer to finite losses and gradients is not finite."""
    for term, weight in weighting.weights.items():
        if not math.isfinite(weight):
            raise FloatingPointError(
                f"method '{method}' weighs '{term}' by {weight} at step {step}, of losses "
                f"{weighting.losses}"
            )
    if not math.isfinite(weighting.total):
        raise FloatingPointError(
            f"method '{method}' makes {weighting.total} of the losses {weighting.losses} "
            f"at step {step}"
        )


def check_gradients(norms: Iterable[float], method: str, step: int) -> None:
    for norm in norms:
        if not math.isfinite(norm):
            raise FloatingPointError(
                f"method '{method}' leaves a gradient of norm {norm} at step {step}, of losses and "
                f"weights that are finite: lower recipe.optim.lr, or look at the method's direction"
            )


def check_state(
    model: nn.Module, method: nn.Module, optimizer: torch.optim.Optimizer, name: str, step: int
) -> None:
    """Raise where what a checkpoint would keep is not finite: every retry would begin with it.

    A method may keep an infinity on purpose, such as a best value that was not seen yet.
    """
    moments = {f"{i}.{k}": v for i, s in enumerate(optimizer.state.values()) for k, v in s.items()}
    held = [
        ("the model", model.state_dict(), torch.isfinite),
        (f"method '{name}'", method.state_dict(), lambda value: ~torch.isnan(value)),
        ("the optimiser", moments, torch.isfinite),
    ]
    for owner, state, good in held:
        floats = {k: v for k, v in state.items() if torch.is_tensor(v) and v.is_floating_point()}
        fine = [good(value).all() for value in floats.values()]
        if fine and not torch.stack([one.cpu() for one in fine]).all():
            key = next(key for key, one in zip(floats, fine, strict=True) if not one)
            raise FloatingPointError(
                f"'{key}' of {owner} is not finite after step {step} of method '{name}', so it is "
                f"not saved: lower recipe.optim.lr, or set recipe.optim.clip"
            )


def norm_of(parameters: Iterator[nn.Parameter]) -> float:
    """Norm of their gradients together."""
    grads = [parameter.grad for parameter in parameters if parameter.grad is not None]
    return torch.nn.utils.get_total_norm(grads).item()


def describe_step(
    weighting: Weighting, method: Method, tasks: Sequence[Task], cosines: bool
) -> dict[str, float | None]:
    """What was minimised and how it was weighted; None for what this step does not have."""
    row: dict[str, float | None] = {"total": weighting.total}
    for term in terms_of(tasks):
        row[f"loss.{term.name}"] = weighting.losses.get(term.name)
    names = [term.name for term in method.terms]
    for name in names:
        row[f"weight.{name}"] = weighting.weights.get(name)
    row["weight_sum"] = sum(weighting.weights.values())
    for name in () if isinstance(method, LossMethod) else names:
        row[f"head.{name}"] = weighting.heads.get(name)
    if cosines:
        for first, second in itertools.combinations(names, 2):
            row[f"cosine.{first}.{second}"] = weighting.cosines.get(f"{first}.{second}")
    return row
