"""Gradients of single losses: of the shared parameters, or of what the decoders read.

Each loss is differentiated through its decoder once; from what the decoders read, its gradient
goes on through the encoder. A batch may come in parts, whose mean counts.

Shapes: T losses of the method, K of them in this batch, P numbers in the method's space.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from mtl_bench.losses.terms import gather
from mtl_bench.method import GradientMethod, Method


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
    J_KP: Tensor
    own: list[list[Tensor | None]]  # K x parameters
    trunk: Callable[[Tensor], None] | None  # in the space of the representation: the way on


def task_gradients(
    method: GradientMethod, parts: Sequence[Forward], model: Split, scale: float
) -> Gradients:
    """Each loss's gradient, averaged over the parts of the batch that have the loss."""
    shared, own = trainable(model.shared_parameters()), trainable(model.task_parameters())
    in_z = method.space == "representation"
    blocks: list[Tensor] = []  # each T x numbers; of parameters one, of representations one a part
    own_grads: list[list[Tensor | None]] = [[None] * len(own) for _ in method.terms]
    index_of = {term.name: index for index, term in enumerate(method.terms)}
    count_T = torch.zeros(len(method.terms))
    seen, read = [], []
    for part in parts:
        passed = part()
        seen.append({name: loss.detach() for name, loss in passed.losses.items()})
        mine, z = gather(passed.losses, method.terms), list(passed.representation)
        del passed  # which holds the losses, too
        if in_z:
            read += z
        z_grads_of = _through_decoders(mine, index_of, z, own, own_grads, scale)
        like = z if in_z else shared
        if in_z or not blocks:  # filled row by row: a second copy may cost as much as the network
            new = torch.empty if len(z_grads_of) == len(method.terms) else torch.zeros
            blocks.append(new(len(method.terms), sum(x.numel() for x in like), device=z[0].device))
        for index in list(z_grads_of):
            row, grads = blocks[-1][index], z_grads_of.pop(index)
            if not in_z:
                grads = onward(z, grads, shared, keep=len(z_grads_of) > 0)
            if in_z or count_T[index] == 0:
                flatten(grads, like, out=row)
            else:
                row += flatten(grads, like)
            count_T[index] += 1
    losses = mean_losses(seen)
    loss_K = stack_losses(method, losses)
    J_TP = blocks[0] if len(blocks) == 1 else torch.cat(blocks, 1)
    divisor_T = scale * count_T.clamp(min=1)
    if (divisor_T != 1).any():
        J_TP /= divisor_T.to(J_TP)[:, None]
    here = method.present.tolist()
    return Gradients(
        method.present,
        losses,
        loss_K,
        J_TP if len(here) == len(J_TP) else J_TP[method.present],
        [_divided(own_grads[i], int(count_T[i])) for i in here],
        trunk_backward(read, shared) if in_z else None,
    )


def _through_decoders(
    losses: dict[str, Tensor],
    index_of: Mapping[str, int],
    z: Sequence[Tensor],
    own: Sequence[nn.Parameter],
    own_grads: list[list[Tensor | None]],
    scale: float,
) -> dict[int, Sequence[Tensor | None]]:
    """Gradients of what the decoders read, by loss; those of their parameters join `own_grads`.

    All decoders come before the encoder, whose own passes need memory, too: a loss that is done
    with leaves `losses` and takes its decoder's activations along.
    """
    found: dict[int, Sequence[Tensor | None]] = {}
    for name in list(losses):
        index, loss = index_of[name], losses.pop(name) * scale
        keep = len(losses) > 0  # they may share a decoder
        grads = torch.autograd.grad(loss, [*z, *own], retain_graph=keep, allow_unused=True)
        found[index] = grads[: len(z)]
        own_grads[index] = _sum(own_grads[index], grads[len(z) :])
    return found


def onward(
    z: Sequence[Tensor],
    z_grads: Sequence[Tensor | None],
    shared: Sequence[nn.Parameter],
    keep: bool,
) -> Sequence[Tensor | None]:
    """Gradients of the shared parameters from those of what the decoders read."""
    reached = [(x, g) for x, g in zip(z, z_grads, strict=True) if g is not None]
    if not reached:
        return [None] * len(shared)
    outputs, grads = zip(*reached, strict=True)
    return torch.autograd.grad(outputs, shared, grads, retain_graph=keep, allow_unused=True)


def trunk_backward(z: Sequence[Tensor], shared: Sequence[nn.Parameter]) -> Callable[[Tensor], None]:
    """Takes a direction in the representation on to `.grad` of the shared parameters."""

    def run(direction_P: Tensor) -> None:
        pieces = direction_P.split([x.numel() for x in z])
        z_grads = [piece.view_as(x).to(x) for piece, x in zip(pieces, z, strict=True)]
        for parameter, grad in zip(shared, onward(z, z_grads, shared, False), strict=True):
            parameter.grad = grad

    return run


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


def flatten(
    grads: Sequence[Tensor | None], like: Sequence[Tensor], out: Tensor | None = None
) -> Tensor:
    parts = [torch.zeros_like(p) if g is None else g for g, p in zip(grads, like, strict=True)]
    return torch.cat([part.flatten().float() for part in parts], out=out)


def unflatten_into(direction_P: Tensor, parameters: Sequence[nn.Parameter]) -> None:
    parts = direction_P.split([p.numel() for p in parameters])
    for parameter, part in zip(parameters, parts, strict=True):
        parameter.grad = part.view_as(parameter).to(parameter)


def _divided(grads: list[Tensor | None], count: int) -> list[Tensor | None]:
    return grads if count == 1 else [g if g is None else g / count for g in grads]


def _sum(total: Sequence[Tensor | None], grads: Sequence[Tensor | None]) -> list[Tensor | None]:
    return [
        b if a is None else a if b is None else a + b for a, b in zip(total, grads, strict=True)
    ]
