"""The one place where losses and a method become gradients.

After `backward`, every parameter's `.grad` holds what the optimiser should see, and the method's
own parameters have theirs. A loss-value method costs one ordinary backward pass. A gradient method
costs one per loss: each goes through its decoder, stops at what the decoders read, and from there
goes on into the encoder. In the space of the representation it does not: one weighted pass does.

Works under autocast; `scale` is the loss scale of fp16 training and is invisible to the method. A
batch may come in parts: a method sees the mean of their losses and gradients, so that parts change
what is in memory and not what a method decides.

Shapes: K losses of this batch, N independent batches, P numbers in the method's space.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from mtl_bench.gradients import (
    Forward,
    Gradients,
    Pass,
    Split,
    flatten,
    frozen_statistics,
    mean_losses,
    onward,
    stack_losses,
    task_gradients,
    trainable,
    unflatten_into,
)
from mtl_bench.losses.terms import gather
from mtl_bench.method import Composed, GradientMethod, LookAheadMethod, LossMethod, Method

__all__ = ["Forward", "Pass", "Weighting", "backward", "losses_now"]


@dataclass(frozen=True)
class Weighting:
    """What the method saw and decided, for the log."""

    total: float  # the scalar minimised; for gradient methods the weighted sum of the losses
    loss_K: Tensor
    losses: dict[str, float]  # the loss terms
    weights: dict[str, float]  # derivative of the update with respect to each loss of the method
    cosines: dict[str, float] = field(default_factory=dict)  # of pairs of task gradients: "a.b"


def backward(
    method: Method,
    batches: Sequence[Sequence[Forward]],
    model: Split,
    *,
    scale: float = 1.0,
    lr: float = 0.0,
    cosines: bool = False,
) -> Weighting:
    """Fill `.grad` of the model's and the method's parameters.

    Args:
        batches: `method.batches` of them, each in one part or more.
        scale: factor on all gradients.
        lr: learning rate of the shared parameters, for methods that look ahead.
        cosines: measure those between the tasks' gradients (loss-value methods: of the first part,
            at the cost of one backward pass per loss).
    """
    if isinstance(method, LossMethod):
        return _one_backward(method, batches[0], model, scale, cosines)
    if isinstance(method, Composed):
        return _task_backwards(method.loss, method.gradient, batches, model, scale, lr, cosines)
    assert isinstance(method, GradientMethod)
    return _task_backwards(None, method, batches, model, scale, lr, cosines)


def losses_now(parts: Sequence[Forward], model: Split) -> dict[str, Tensor]:
    """A batch's loss terms under the present parameters; leaves no trace in the model."""
    return mean_losses(_losses_of(parts, model))


def _losses_of(parts: Sequence[Forward], model: Split) -> list[Mapping[str, Tensor]]:
    with torch.no_grad(), frozen_statistics(model):
        return [part().losses for part in parts]


# --- loss-value methods ---------------------------------------------------------------------------


def _one_backward(
    method: LossMethod, parts: Sequence[Forward], model: Split, scale: float, cosines: bool
) -> Weighting:
    """The weights are the derivatives of the method's scalar.

    They may depend on all losses, so a batch in parts is run twice: for its losses, and for its
    gradients once the weights are known.
    """
    single = parts[0]() if len(parts) == 1 else None
    seen = [single.losses] if single else _losses_of(parts, model)
    losses = mean_losses(seen)
    loss_K = stack_losses(method, losses)
    total, scaled_K = _differentiate(method, loss_K, scale)
    cosine_of: dict[str, float] = {}
    scaled = dict(zip(_names(method), scaled_K, strict=True))
    count = Counter(name for losses in seen for name in gather(losses, method.terms))
    for number, part in enumerate(parts):
        passed = single or part()
        if cosines and number == 0:
            cosine_of = _cosines_of(method, passed, model)
        mine = gather(passed.losses, method.terms)
        grads = [scaled[name] / count[name] for name in mine]
        torch.autograd.backward(list(mine.values()), grads)
    weights = _named(method, scaled_K / scale)
    return Weighting(total, loss_K, _floats(losses), weights, cosine_of)


def _differentiate(method: LossMethod, loss_K: Tensor, scale: float) -> tuple[float, Tensor]:
    """The method's scalar and `scale` times its derivatives; its own parameters get theirs, too."""
    leaf_K = loss_K.clone().requires_grad_()
    total = method.total(leaf_K)
    (total * scale).backward()
    assert leaf_K.grad is not None
    return total.item(), leaf_K.grad


# --- gradient methods -----------------------------------------------------------------------------


def _task_backwards(
    first: LossMethod | None,
    method: GradientMethod,
    batches: Sequence[Sequence[Forward]],
    model: Split,
    scale: float,
    lr: float,
    cosines: bool,
) -> Weighting:
    own = [p for p in model.task_parameters() if p.requires_grad]
    ahead = isinstance(method, LookAheadMethod)
    seen = [
        task_gradients(method, parts, model, scale) for parts in (batches[:1] if ahead else batches)
    ]
    rows = _in_all(method, seen)
    J = _axis([_rows(g.J_KP, index) for g, index in zip(seen, rows, strict=True)])
    loss = _axis([_rows(g.loss_K, index) for g, index in zip(seen, rows, strict=True)])
    loss_K = loss if loss.dim() == 1 else loss.mean(0)
    first_K = torch.ones_like(loss_K)
    if first is not None:
        first.present = method.present
        first_K = _differentiate(first, loss_K, scale)[1] / scale
        J, loss = J * first_K[:, None], loss * first_K
    if not torch.isfinite(J.sum()):  # an overflow of fp16: no state may learn from it
        direction_P, weight_K = J.flatten(0, -2).sum(0), torch.ones_like(loss_K)
    elif isinstance(method, LookAheadMethod):
        look = _look_ahead(method, batches[1], model, first_K, lr)
        direction_P, weight_K = method.direction_ahead(J, loss, look, lr)
    else:
        direction_P, weight_K = method.direction(J, loss)
    if seen[0].trunk is not None:
        seen[0].trunk(direction_P * scale)
    else:
        unflatten_into(direction_P * scale, trainable(model.shared_parameters()))
    head_K = first_K * method.head_weights(weight_K, first_K * loss_K) / len(seen)
    for gradients, index in zip(seen, rows, strict=True):
        _add_own(own, [gradients.own[i] for i in index], head_K)
    weight_K = first_K * weight_K
    return Weighting(
        float(weight_K @ loss_K),
        loss_K,
        _floats(seen[0].losses),
        _named(method, weight_K),
        _cosines(_names(method), J if J.dim() == 2 else J[0]) if cosines else {},
    )


def _in_all(method: GradientMethod, seen: Sequence[Gradients]) -> list[list[int]]:
    """Of each batch, the rows of the losses that all have; the method is told which these are."""
    places = [g.present.tolist() for g in seen]
    common = [term for term in places[0] if all(term in other for other in places)]
    if not common:
        raise ValueError(f"{type(method).__name__} compares batches, and they share no labels")
    method.present = torch.tensor(common)
    return [[other.index(term) for term in common] for other in places]


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
            gradients = task_gradients(method, parts, model, 1.0)
        with torch.no_grad():
            for parameter, value in zip(shared, before, strict=True):
                parameter.copy_(value)
        J_KP = gradients.J_KP * first_T[method.present][:, None]
        method.present = here  # the second batch may have had other labels
        return J_KP.nan_to_num(0.0, 0.0, 0.0)  # an overflow there says nothing

    return look


# --- small parts ----------------------------------------------------------------------------------


def _cosines_of(method: LossMethod, passed: Pass, model: Split) -> dict[str, float]:
    shared, z = trainable(model.shared_parameters()), list(passed.representation)
    mine = gather(passed.losses, method.terms)
    rows = []
    for value in mine.values():
        z_grads = torch.autograd.grad(value, z, retain_graph=True, allow_unused=True)
        rows.append(flatten(onward(z, z_grads, shared, True), shared))
    return _cosines(list(mine), torch.stack(rows))


def _cosines(names: Sequence[str], J_KP: Tensor) -> dict[str, float]:
    """Of every pair; 0 with a gradient that is zero."""
    unit_KP = torch.nn.functional.normalize(J_KP.double(), dim=1)
    cosine_KK = (unit_KP @ unit_KP.T).tolist()
    pairs = itertools.combinations(range(len(names)), 2)
    return {f"{names[i]}.{names[j]}": cosine_KK[i][j] for i, j in pairs}


def _names(method: Method) -> list[str]:
    return [method.terms[index].name for index in method.present.tolist()]


def _named(method: Method, weight_K: Tensor) -> dict[str, float]:
    return dict(zip(_names(method), weight_K.tolist(), strict=True))


def _floats(losses: Mapping[str, Tensor]) -> dict[str, float]:
    return {name: loss.item() for name, loss in losses.items()}


def _rows(x: Tensor, index: Sequence[int]) -> Tensor:
    """Rows of a tensor; itself where that is all of them."""
    return x if len(index) == len(x) else x[index]


def _axis(values: Sequence[Tensor]) -> Tensor:
    """Stacked along a leading axis, which a single one does not get."""
    return values[0] if len(values) == 1 else torch.stack(list(values))


def _add_own(
    own: Sequence[nn.Parameter], grads_K: Sequence[Sequence[Tensor | None]], weight_K: Tensor
) -> None:
    for weight, grads in zip(weight_K, grads_K, strict=True):
        unit = weight == 1  # most often
        for parameter, grad in zip(own, grads, strict=True):
            if grad is not None:
                grad = grad if unit else grad * weight.to(grad)
                parameter.grad = grad if parameter.grad is None else parameter.grad + grad
