"""Gradients of single losses: of the shared parameters, or of what the decoders read.

Each loss is differentiated through its decoder once; from what the decoders read, its gradient
goes on through the encoder. A batch may come in parts, whose mean counts.

Shapes: T losses of the method, K of them in this batch, P numbers in the method's space.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from mtl_bench.core.method import GradientMethod, Method
from mtl_bench.core.terms import gather
from mtl_bench.train.gramian import Gradient, add, divided, flatten


@dataclass(frozen=True)
class Pass:
    """What one forward pass leaves behind."""

    losses: Mapping[str, Tensor]  # unweighted loss terms, less those without labels in the batch
    representation: Sequence[Tensor]  # what decoders read; shared parameters act only through it


Forward = Callable[[], Pass]  # sends one part of a batch through the model


class Split(Protocol):
    """A model that says which parameters all tasks train and which only one of them."""

    def shared_parameters(self) -> Iterator[nn.Parameter]: ...
    def task_parameters(self) -> Iterator[nn.Parameter]: ...
    def modules(self) -> Iterator[nn.Module]: ...


def mean_losses(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Each loss's mean over the parts of a batch that have it, detached."""
    names = dict.fromkeys(name for part in parts for name in part)
    found = {
        name: [part[name].detach().float() for part in parts if name in part] for name in names
    }
    return {name: torch.stack(values).mean(0) for name, values in found.items()}


def losses_of(parts: Sequence[Forward], model: Split) -> list[Mapping[str, Tensor]]:
    """Each part's loss terms under the present parameters; leaves no trace in the model."""
    with torch.no_grad(), frozen_statistics(model):
        return [part().losses for part in parts]


def stack_losses(method: Method, losses: Mapping[str, Tensor]) -> Tensor:
    """The method's losses [K], in its order; tells the method which K of its T they are."""
    mine = gather(losses, method.terms)
    if not mine:
        raise ValueError("a batch without labels for any of the cell's tasks: nothing to train on")
    present = torch.tensor([i for i, term in enumerate(method.terms) if term.name in mine])
    for module in method.modules():
        if isinstance(module, Method):
            module.present = present
    return torch.stack(list(mine.values()))


@dataclass
class Gradients:
    """Of one batch: what a method sees, and what belongs to one task only."""

    present: Tensor  # which losses of the method the K are
    losses: dict[str, Tensor]
    loss_K: Tensor
    rows: list[list[Tensor | None]]  # K x tensors of the method's space; of a matrix, its rows
    J_KP: Tensor | None  # the same as one matrix, where it was asked for
    space: Sequence[Tensor]  # the tensors of the method's space
    own: list[list[Tensor | None]]  # K x parameters
    back: Callable[[Gradient], None]  # puts a direction, as a row has it, into `.grad`


def task_gradients(
    method: GradientMethod,
    parts: Sequence[Forward],
    model: Split,
    scale: float,
    matrix: bool = False,
    own: bool = True,
) -> Gradients:
    """Each loss's gradient, averaged over the parts of the batch that have the loss.

    Args:
        scale: of the losses before they are differentiated; the results are free of it.
        matrix: one matrix in place of rows.
        own: those of the parameters that are not shared, too.
    """
    shared = trainable(model.shared_parameters())
    others = trainable(model.task_parameters()) if own else []
    kept = (_Representations if method.space == "representation" else _Parameters)(
        shared, len(method.terms), matrix
    )
    own_T: list[list[Tensor | None]] = [[None] * len(others) for _ in method.terms]
    index_of = {term.name: index for index, term in enumerate(method.terms)}
    count: Counter[int] = Counter()
    seen = []
    for part in parts:
        passed = part()
        seen.append({name: loss.detach() for name, loss in passed.losses.items()})
        mine, z = gather(passed.losses, method.terms), list(passed.representation)
        del passed  # which holds the losses, too
        z_grads_of = through_decoders(mine, index_of, z, others, own_T, scale)
        count.update(z_grads_of.keys())
        kept.add(z, z_grads_of)
    losses = mean_losses(seen)
    loss_K = stack_losses(method, losses)
    here = method.present.tolist()
    counts = [count[i] for i in here]
    rows, J_KP = kept.found(here, [scale * n for n in counts])
    own_K = [divided(own_T[i], n) for i, n in zip(here, counts, strict=True)]
    return Gradients(method.present, losses, loss_K, rows, J_KP, kept.space, own_K, kept.back)


class _Parameters:
    """Gradients of the shared parameters, added up over the parts."""

    def __init__(self, shared: Sequence[nn.Parameter], losses: int, matrix: bool):
        self.shared = self.space = shared
        self.rows: list[list[Tensor | None]] = [[] for _ in range(losses)]
        self.begun: set[int] = set()
        self.matrix, self.J_TP = matrix, torch.empty(0)

    def add(self, z: Sequence[Tensor], z_grads_of: dict[int, Gradient]) -> None:
        if self.matrix and not self.begun:  # not before: the decoders need memory, too
            P = sum(parameter.numel() for parameter in self.shared)
            self.J_TP = torch.zeros(len(self.rows), P, device=z[0].device)
        for index in list(z_grads_of):
            grads = onward(z, z_grads_of.pop(index), self.shared, keep=len(z_grads_of) > 0)
            first = index not in self.begun
            self.begun.add(index)
            if not self.matrix:
                self.rows[index] = list(grads) if first else add(self.rows[index], grads)
            elif first:  # row by row: a second copy may cost as much as the network
                flatten(grads, self.shared, out=self.J_TP[index])
            else:
                self.J_TP[index] += flatten(grads, self.shared)

    def found(
        self, here: Sequence[int], divisors: Sequence[float]
    ) -> tuple[list[list[Tensor | None]], Tensor | None]:
        if not self.matrix:
            return [divided(self.rows[i], n) for i, n in zip(here, divisors, strict=True)], None
        J_KP = self.J_TP if len(here) == len(self.J_TP) else self.J_TP[list(here)]
        for row, divisor in zip(J_KP, divisors, strict=True):
            if divisor != 1:
                row /= divisor
        return [[row] for row in J_KP], J_KP

    def back(self, direction: Gradient) -> None:
        for parameter, grad in zip(self.shared, direction, strict=True):
            parameter.grad = grad


class _Representations:
    """Gradients of what the decoders read: the parts' tensors stand side by side."""

    def __init__(self, shared: Sequence[nn.Parameter], losses: int, matrix: bool):
        self.shared, self.matrix = shared, matrix
        self.space: list[Tensor] = []
        self.rows: list[list[Tensor | None]] = [[] for _ in range(losses)]

    def add(self, z: Sequence[Tensor], z_grads_of: dict[int, Gradient]) -> None:
        self.space += z
        for index, row in enumerate(self.rows):
            row += z_grads_of.get(index, [None] * len(z))

    def found(
        self, here: Sequence[int], divisors: Sequence[float]
    ) -> tuple[list[list[Tensor | None]], Tensor | None]:
        rows = [divided(self.rows[i], n) for i, n in zip(here, divisors, strict=True)]
        if not self.matrix:
            return rows, None
        J_KP = torch.stack([flatten(row, self.space) for row in rows])
        return [[row] for row in J_KP], J_KP

    def back(self, direction: Gradient) -> None:
        grads = onward(self.space, direction, self.shared, False)
        for parameter, grad in zip(self.shared, grads, strict=True):
            parameter.grad = grad


def through_decoders(
    losses: dict[str, Tensor],
    index_of: Mapping[str, int],
    z: Sequence[Tensor],
    own: Sequence[nn.Parameter],
    own_grads: list[list[Tensor | None]],
    scale: float,
) -> dict[int, Gradient]:
    """Gradients of what the decoders read, by loss; those of their parameters join `own_grads`.

    All decoders come before the encoder, whose own passes need memory, too: a loss that is done
    with leaves `losses` and takes its decoder's activations along.
    """
    found: dict[int, Gradient] = {}
    for name in list(losses):
        index, loss = index_of[name], losses.pop(name) * scale
        keep = len(losses) > 0  # they may share a decoder
        grads = torch.autograd.grad(loss, [*z, *own], retain_graph=keep, allow_unused=True)
        found[index] = grads[: len(z)]
        own_grads[index] = add(own_grads[index], grads[len(z) :])
    return found


def onward(
    z: Sequence[Tensor],
    z_grads: Gradient,
    shared: Sequence[nn.Parameter],
    keep: bool,
) -> Gradient:
    """Gradients of the shared parameters from those of what the decoders read."""
    reached = [(x, g) for x, g in zip(z, z_grads, strict=True) if g is not None]
    if not reached:
        return [None] * len(shared)
    outputs, grads = zip(*reached, strict=True)
    return torch.autograd.grad(outputs, shared, grads, retain_graph=keep, allow_unused=True)


# --- small parts ----------------------------------------------------------------------------------


@contextlib.contextmanager
def frozen_statistics(model: Split) -> Iterator[None]:
    """Training mode whose batch norms leave their running statistics alone."""
    norms = [m for m in model.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
    tracked = [m.track_running_stats for m in norms]
    for norm in norms:
        norm.track_running_stats = False
    try:
        yield
    finally:
        for norm, value in zip(norms, tracked, strict=True):
            norm.track_running_stats = value


def trainable(parameters: Iterator[nn.Parameter]) -> list[nn.Parameter]:
    return [parameter for parameter in parameters if parameter.requires_grad]
