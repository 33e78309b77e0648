"""The backward pass of gradient methods: one per loss through what is shared, or fewer.

Each loss goes through its decoder once, stops at what the decoders read, and from there goes on
into the encoder; in the space of the representation it does not, one weighted pass does. A method
that needs no more than inner products of the gradients gets those, and no matrix is made.

Shapes: K losses of this batch, P numbers in the method's space.
"""

from collections import Counter
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from mtl_bench.core.method import CrossMethod, GradientMethod, LookAheadMethod, LossMethod
from mtl_bench.core.terms import gather
from mtl_bench.train.gradients import (
    Forward,
    Split,
    frozen_statistics,
    losses_of,
    mean_losses,
    onward,
    task_gradients,
    through_decoders,
    trainable,
)
from mtl_bench.train.gramian import add, combine, products, unflatten
from mtl_bench.train.weighting import Weighting, cosines_of, differentiate, names_of, weighting


def task_backwards(
    first: LossMethod | None,
    method: GradientMethod,
    batches: Sequence[Sequence[Forward]],
    model: Split,
    scale: float,
    lr: float,
    cosines: bool,
) -> Weighting:
    """Every loss's gradient, then the method's answer."""
    looks = isinstance(method, LookAheadMethod)
    matrix = looks or type(method).direction is not GradientMethod.direction
    seen = task_gradients(method, batches[0], model, scale, matrix)
    loss_K, J_KP = seen.loss_K, seen.J_KP
    first_K = _first_weights(first, method, loss_K, scale)
    measured = cosines_of(names_of(method), seen.rows) if cosines else {}
    if J_KP is None:
        weight_K = _by_gramian(method, products(seen.rows, seen.rows), first_K, loss_K)
        seen.back(combine(first_K * weight_K * scale, seen.rows))
    else:
        if first is not None:
            J_KP *= first_K[:, None]
        look = _look_ahead(method, batches[1], model, first_K, lr) if looks else None
        direction_P, weight_K = _by_matrix(method, J_KP, first_K * loss_K, look, lr)
        seen.back(unflatten(direction_P * scale, seen.space))
    head_K = first_K * method.head_weights(weight_K, first_K * loss_K)
    _add_own(trainable(model.task_parameters()), seen.own, head_K)
    return weighting(method, seen.losses, loss_K, first_K * weight_K, measured)


def cross_backwards(
    first: LossMethod | None,
    method: CrossMethod,
    batches: Sequence[Sequence[Forward]],
    model: Split,
    scale: float,
    cosines: bool,
) -> Weighting:
    """Gradients of two batches for the weights, one weighted pass of a third for the update."""
    seen = [task_gradients(method, parts, model, scale, own=False) for parts in batches[:2]]
    places = [one.present.tolist() for one in seen]
    method.present = _in_both(method, *places)
    index = [[place.index(term) for term in method.present.tolist()] for place in places]
    rows = [[one.rows[i] for i in where] for one, where in zip(seen, index, strict=True)]
    loss_K = (seen[0].loss_K[index[0]] + seen[1].loss_K[index[1]]) / 2
    first_K = _first_weights(first, method, loss_K, scale)
    measured = cosines_of(names_of(method), rows[0]) if cosines else {}
    weight_K = _by_gramian(method, products(*rows), first_K, loss_K)
    head_K = first_K * method.head_weights(weight_K, first_K * loss_K)
    del seen, rows  # as large as the network, many times
    losses = _weighted_pass(method, batches[2], first_K * weight_K, head_K, model, scale)
    return weighting(method, losses, loss_K, first_K * weight_K, measured)


# --- weights and directions -----------------------------------------------------------------------


def _first_weights(
    first: LossMethod | None, method: GradientMethod, loss_K: Tensor, scale: float
) -> Tensor:
    """A composition's loss-value method, asked first; ones without it."""
    if first is None:
        return torch.ones_like(loss_K)
    first.present = method.present
    return differentiate(first, loss_K, scale)[1] / scale


def _by_gramian(method: GradientMethod, G_KK: Tensor, first_K: Tensor, loss_K: Tensor) -> Tensor:
    """The method's weights [K]; ones where fp16 has overflowed: no state may learn from that."""
    if not torch.isfinite(G_KK).all():
        return torch.ones_like(loss_K)
    scale_K = first_K.double().cpu()
    G_KK = G_KK * scale_K * scale_K[:, None]
    return method.weights(G_KK, (first_K * loss_K).double().cpu()).to(loss_K)


def _by_matrix(
    method: GradientMethod,
    J_KP: Tensor,
    loss_K: Tensor,
    look: Callable[[Tensor], Tensor] | None,
    lr: float,
) -> tuple[Tensor, Tensor]:
    """The method's direction [P] and weights [K]; the sum where fp16 has overflowed."""
    if not torch.isfinite(J_KP.sum()):
        return J_KP.sum(0), torch.ones_like(loss_K)
    if look is None:
        return method.direction(J_KP, loss_K)
    assert isinstance(method, LookAheadMethod)
    return method.direction_ahead(J_KP, loss_K, look, lr)


def _in_both(method: CrossMethod, one: Sequence[int], two: Sequence[int]) -> Tensor:
    common = [term for term in one if term in two]
    if not common:
        raise ValueError(f"{type(method).__name__} compares batches, and they share no labels")
    return torch.tensor(common)


def _weighted_pass(
    method: GradientMethod,
    parts: Sequence[Forward],
    weight_K: Tensor,
    head_K: Tensor,
    model: Split,
    scale: float,
) -> dict[str, Tensor]:
    """`.grad` of a batch whose losses count `weight` in what is shared, and `head` in the rest.

    Losses without a weight are left out. A batch in parts is run twice, as each loss is divided by
    the number of parts that have it.
    """
    shared, own = trainable(model.shared_parameters()), trainable(model.task_parameters())
    names = names_of(method)
    single = parts[0]() if len(parts) == 1 else None
    seen = [single.losses] if single else losses_of(parts, model)
    count = Counter(name for losses in seen for name in gather(losses, method.terms))
    factor_K = torch.tensor([scale / max(count[name], 1) for name in names]).to(weight_K)
    losses = mean_losses(seen)
    own_K: list[list[Tensor | None]] = [[None] * len(own) for _ in names]
    total: list[Tensor | None] = [None] * len(shared)
    for part in parts:
        passed, single = single or part(), None
        mine, z = gather(passed.losses, method.terms), list(passed.representation)
        mine = {name: loss for name, loss in mine.items() if name in names}
        del passed
        index_of = {name: index for index, name in enumerate(names)}
        z_grads_of = through_decoders(mine, index_of, z, own, own_K, 1.0)
        here = list(z_grads_of)
        weighted = combine((weight_K * factor_K)[here], [z_grads_of[i] for i in here])
        total = add(total, onward(z, weighted, shared, keep=False))
    for parameter, grad in zip(shared, total, strict=True):
        parameter.grad = grad
    _add_own(own, own_K, head_K * factor_K)
    return losses


def _look_ahead(
    method: GradientMethod, parts: Sequence[Forward], model: Split, first_K: Tensor, lr: float
) -> Callable[[Tensor], Tensor]:
    """Gives the second batch's gradients where a direction would lead, and leads back."""
    here, shared = method.present, trainable(model.shared_parameters())
    first_T = first_K.new_ones(len(method.terms))
    first_T[here] = first_K

    def look(direction_P: Tensor) -> Tensor:
        before = [parameter.detach().clone() for parameter in shared]
        steps = direction_P.split([parameter.numel() for parameter in shared])
        with torch.no_grad():
            for parameter, step in zip(shared, steps, strict=True):
                parameter.sub_(lr * step.view_as(parameter))
        with frozen_statistics(model):
            gradients = task_gradients(method, parts, model, 1.0, matrix=True, own=False)
        with torch.no_grad():
            for parameter, value in zip(shared, before, strict=True):
                parameter.copy_(value)
        assert gradients.J_KP is not None
        J_KP = gradients.J_KP * first_T[method.present][:, None]
        method.present = here  # the second batch may have had other labels
        return J_KP.nan_to_num(0.0, 0.0, 0.0)  # an overflow there says nothing

    return look


def _add_own(
    own: Sequence[nn.Parameter], grads_K: Sequence[Sequence[Tensor | None]], weight_K: Tensor
) -> None:
    for weight, grads in zip(weight_K, grads_K, strict=True):
        unit = weight == 1  # most often
        for parameter, grad in zip(own, grads, strict=True):
            if grad is not None:
                grad = grad if unit else grad * weight.to(grad)
                parameter.grad = grad if parameter.grad is None else parameter.grad + grad
