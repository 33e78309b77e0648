"""The one place where loss terms and a method become gradients.

After `backward`, every parameter's `.grad` holds what the optimiser should see, and the method's
own parameters have theirs. Works under autocast; `scale` is the loss scale of fp16 training and is
invisible to the method.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from mtl_bench.method import GradientMethod, LossMethod, Method

# T loss terms, P shared parameters


class Split(Protocol):
    """A model that says which parameters all tasks train and which only one of them."""

    def shared_parameters(self) -> Iterator[nn.Parameter]: ...
    def task_parameters(self) -> Iterator[nn.Parameter]: ...


@dataclass(frozen=True)
class Weighting:
    """What the method decided, for the log."""

    total: float  # the scalar minimised; for gradient methods the weighted sum of the losses
    weight_T: Tensor  # derivative of the update with respect to each loss


def backward(
    method: Method, losses: Mapping[str, Tensor], model: Split, scale: float = 1.0
) -> Weighting:
    """Fill `.grad` of the model's and the method's parameters.

    Args:
        losses: every term of the method, unweighted.
        scale: factor on all gradients.
    """
    terms = [losses[term.name] for term in method.terms]
    loss_T = torch.stack([term.detach().float() for term in terms])
    if isinstance(method, LossMethod):
        return _one_backward(method, terms, loss_T, scale)
    assert isinstance(method, GradientMethod)
    return _term_backwards(method, terms, loss_T, model, scale)


def _one_backward(
    method: LossMethod, terms: Sequence[Tensor], loss_T: Tensor, scale: float
) -> Weighting:
    leaf_T = loss_T.requires_grad_()
    total = method.total(leaf_T)
    (total * scale).backward()
    assert leaf_T.grad is not None
    torch.autograd.backward(terms, list(leaf_T.grad))
    return Weighting(total.item(), leaf_T.grad / scale)


def _term_backwards(
    method: GradientMethod, terms: Sequence[Tensor], loss_T: Tensor, model: Split, scale: float
) -> Weighting:
    shared = [p for p in model.shared_parameters() if p.requires_grad]
    own = [p for p in model.task_parameters() if p.requires_grad]
    rows, own_grads = [], []
    for index, term in enumerate(terms):
        grads = torch.autograd.grad(
            term * scale, [*shared, *own], retain_graph=index + 1 < len(terms), allow_unused=True
        )
        rows.append(_flatten(grads[: len(shared)], shared) / scale)
        own_grads.append(grads[len(shared) :])
    J_TP = torch.stack(rows)
    if not torch.isfinite(J_TP).all():  # an overflow of fp16: no state may learn from it
        direction_P, weight_T = J_TP.sum(0), torch.ones_like(loss_T)
    else:
        direction_P, weight_T = method.direction(J_TP, loss_T)
    _unflatten_into(direction_P * scale, shared)
    for weight, grads in zip(weight_T, own_grads, strict=True):
        for parameter, grad in zip(own, grads, strict=True):
            if grad is not None:
                grad = grad * weight.to(grad) if method.weighted_heads else grad
                parameter.grad = grad if parameter.grad is None else parameter.grad + grad
    return Weighting(float(weight_T.to(loss_T) @ loss_T), weight_T.detach())


def _flatten(grads: Sequence[Tensor | None], like: Sequence[Tensor]) -> Tensor:
    parts = [torch.zeros_like(p) if g is None else g for g, p in zip(grads, like, strict=True)]
    return torch.cat([part.flatten().float() for part in parts])


def _unflatten_into(direction_P: Tensor, parameters: Sequence[nn.Parameter]) -> None:
    parts = direction_P.split([p.numel() for p in parameters])
    for parameter, part in zip(parameters, parts, strict=True):
        parameter.grad = part.view_as(parameter).to(parameter)
