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

from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor

from mtl_bench.core.method import Composed, CrossMethod, GradientMethod, LossMethod, Method
from mtl_bench.core.terms import gather
from mtl_bench.train.by_gradients import cross_backwards, task_backwards
from mtl_bench.train.gradients import (
    Forward,
    Pass,
    Split,
    losses_of,
    mean_losses,
    onward,
    stack_losses,
    trainable,
)
from mtl_bench.train.weighting import Weighting, cosines_of, differentiate, names_of, weighting

__all__ = ["Forward", "Pass", "Weighting", "backward", "losses_now"]


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
    first, second = (
        (method.loss, method.gradient) if isinstance(method, Composed) else (None, method)
    )
    assert isinstance(second, GradientMethod)
    if isinstance(second, CrossMethod):
        return cross_backwards(first, second, batches, model, scale, cosines)
    return task_backwards(first, second, batches, model, scale, lr, cosines)


def losses_now(parts: Sequence[Forward], model: Split) -> dict[str, Tensor]:
    """A batch's loss terms under the present parameters; leaves no trace in the model."""
    return mean_losses(losses_of(parts, model))


# --- loss-value methods ---------------------------------------------------------------------------


def _one_backward(
    method: LossMethod, parts: Sequence[Forward], model: Split, scale: float, cosines: bool
) -> Weighting:
    """The weights are the derivatives of the method's scalar.

    They may depend on all losses, so a batch in parts is run twice: for its losses, and for its
    gradients once the weights are known.
    """
    single = parts[0]() if len(parts) == 1 else None
    seen = [single.losses] if single else losses_of(parts, model)
    losses = mean_losses(seen)
    loss_K = stack_losses(method, losses)
    total, scaled_K = differentiate(method, loss_K, scale)
    cosine_of: dict[str, float] = {}
    scaled = dict(zip(names_of(method), scaled_K, strict=True))
    count = Counter(name for losses in seen for name in gather(losses, method.terms))
    for number, part in enumerate(parts):
        passed = single or part()
        if cosines and number == 0:
            cosine_of = _cosines_of(method, passed, model)
        mine = gather(passed.losses, method.terms)
        grads = [scaled[name] / count[name] for name in mine]
        torch.autograd.backward(list(mine.values()), grads)
    return weighting(method, losses, loss_K, scaled_K / scale, cosine_of, total)


def _cosines_of(method: LossMethod, passed: Pass, model: Split) -> dict[str, float]:
    shared, z = trainable(model.shared_parameters()), list(passed.representation)
    mine = gather(passed.losses, method.terms)
    rows = []
    for value in mine.values():
        z_grads = torch.autograd.grad(value, z, retain_graph=True, allow_unused=True)
        rows.append(onward(z, z_grads, shared, True))
    return cosines_of(list(mine), rows)
