"""The one place where losses and a method become gradients.

After `backward`, every parameter's `.grad` holds what the optimiser should see, and the method's
own parameters have theirs. A loss-value method costs one ordinary backward pass. A gradient method
costs one per loss: each goes through its decoder, stops at what the decoders read, and from there
goes on into the encoder. A method that needs gradients of the representation stops there: one
weighted pass goes on. A method that needs no more than a Gramian gets that, and no matrix is made.

Works under autocast; `scale` is the loss scale of fp16 training and is invisible to the method. A
batch may come in parts: a method sees the mean of their losses and gradients, so that parts change
what is in memory and not what a method decides. Parts may be on several ranks, see `Together`: each
is handed its own, and all decide alike.

Shapes: T losses of the method, K of them in this batch, N independent batches, P shared parameters.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor, nn

from mtl_bench.core.method import (
    Composed,
    CrossMethod,
    GradientMethod,
    LookAheadMethod,
    LossMethod,
    Method,
    PerturbedMethod,
    Step,
)
from mtl_bench.core.terms import gather
from mtl_bench.train.gramian import (
    KINDS,
    Gradients,
    Matrix,
    add,
    combine,
    cosines_of,
    divided,
    onward,
    products,
    unflatten,
)
from mtl_bench.train.perturbed import perturbed
from mtl_bench.train.replay import GradientReplay
from mtl_bench.train.statistics import frozen_statistics
from mtl_bench.train.together import Gradient, Together


@dataclass(frozen=True)
class Pass:
    """What one forward pass leaves behind."""

    losses: Mapping[str, Tensor]  # unweighted loss terms, less those without labels in the batch
    representation: Sequence[Tensor]  # what decoders read; shared parameters act only through it


Forward = Callable[[], Pass]  # sends one part of a batch through the model
ALONE = Together()


class UnlabelledError(ValueError):
    """A batch has no pixel of any term that the method weighs: there is nothing to train on."""


class Split(Protocol):
    """A model that says which parameters all tasks train and which only one of them."""

    def shared_parameters(self) -> Iterator[nn.Parameter]: ...
    def task_parameters(self) -> Iterator[nn.Parameter]: ...
    def modules(self) -> Iterator[nn.Module]: ...


@dataclass(frozen=True)
class Weighting:
    """What the method saw and decided, for the log."""

    total: float  # the scalar minimised; for gradient methods the weighted sum of the losses
    step: Step
    losses: dict[str, float]  # the loss terms
    weights: dict[str, float]  # derivative of the update with respect to each loss of the method
    heads: dict[str, float] = field(default_factory=dict)  # those of what is not shared, if apart
    cosines: dict[str, float] = field(default_factory=dict)  # of pairs of task gradients: "a.b"


def backward(
    method: Method,
    batches: Sequence[Sequence[Forward]],
    model: Split,
    *,
    scale: float = 1.0,
    lr: float = 0.0,
    cosines: bool = False,
    together: Together = ALONE,
) -> Weighting:
    """Fill `.grad` of the model's and the method's parameters.

    Args:
        batches: `method.batches` of them, each in one part or more, those of this rank.
        scale: factor on all gradients.
        lr: learning rate of the shared parameters, for methods that look ahead.
        cosines: measure those between the tasks' gradients (loss-value methods: of the first part,
            at the cost of one backward pass per loss).
        together: the ranks that have the other parts.
    """
    if isinstance(method, LossMethod):
        return _by_losses(method, batches[0], model, scale, cosines, together)
    first, second = (
        (method.loss, method.gradient) if isinstance(method, Composed) else (None, method)
    )
    assert isinstance(second, GradientMethod)
    step = _ByGradients(first, second, model, scale, together)
    if isinstance(second, PerturbedMethod):
        shared = trainable(model.shared_parameters())
        with perturbed(second, batches[0], shared, model, together) as parts:
            return step.on_one_batch([parts], lr, cosines)
    if isinstance(second, GradientReplay):
        return step.by_given_weights(batches[0], second.weights_HT, cosines)
    if isinstance(second, CrossMethod):
        return step.on_three_batches(batches, cosines)
    return step.on_one_batch(batches, lr, cosines)


def reevaluate(
    method: Method,
    step: Step,
    parts: Sequence[Forward],
    model: Split,
    together: Together = ALONE,
) -> None:
    """Tell a method that asks for it what the batch's losses are after its step.

    A step may move a term's last pixel out of view: the method then hears nothing of that term.
    """
    after = _mine(method, losses_of(parts, model, together))
    names = _names_of(method, step)
    kept = [index for index, name in enumerate(names) if name in after]
    if kept:
        still = Step(step.loss_K[kept], step.present[kept])
        method.after_step(still, torch.stack([after[names[index]] for index in kept]))


# --- losses ---------------------------------------------------------------------------------------


def _step_of(method: Method, parts: Sequence[Mapping[str, Tensor]]) -> Step:
    """What the method sees of the loss terms of a batch's parts, in its own order.

    Raises:
        UnlabelledError: there are none.
    """
    mine = _mine(method, parts)
    if not mine:
        raise UnlabelledError("a batch without labels for any of the cell's tasks: no training")
    present = [i for i, term in enumerate(method.terms) if term.name in mine]
    return Step(torch.stack([mine[method.terms[i].name] for i in present]), torch.tensor(present))


def _mine(method: Method, parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The losses that the method weighs: means over the parts that have them."""
    return mean_losses([gather(part, method.terms) for part in parts])


def mean_losses(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Each loss's mean over the parts of a batch that have it, detached."""
    names = dict.fromkeys(name for part in parts for name in part)
    found = {
        name: [part[name].detach().float() for part in parts if name in part] for name in names
    }
    return {name: torch.stack(values).mean(0) for name, values in found.items()}


def losses_of(
    parts: Sequence[Forward], model: Split, together: Together = ALONE
) -> Sequence[Mapping[str, Tensor]]:
    """Every part's loss terms under the present parameters; leaves no trace in the model."""
    with torch.no_grad(), frozen_statistics(model):
        return together.losses([part().losses for part in parts])


def _looked_at(
    method: Method, parts: Sequence[Forward], model: Split, together: Together
) -> tuple[Sequence[Mapping[str, Tensor]], Counter[str], Iterator[Pass]]:
    """All parts' losses, in how many of them the method has each, and then this rank's passes.

    Weights may depend on all losses, so a batch in several parts is run twice: for its losses, and
    for its gradients once the weights are known.
    """
    single = [parts[0]()] if together.have_all(parts) else []
    seen = together.losses([single[0].losses]) if single else losses_of(parts, model, together)
    count = Counter(name for losses in seen for name in gather(losses, method.terms))
    return seen, count, (single.pop() if single else part() for part in parts)


def _trained(passed: Pass) -> list[Tensor]:
    """What decoders read, less what frozen stages gave them."""
    return [x for x in passed.representation if x.requires_grad]


def _names_of(method: Method, step: Step) -> list[str]:
    return [method.terms[index].name for index in step.present.tolist()]


def _weighting(
    method: Method,
    losses: Mapping[str, Tensor],
    step: Step,
    weight_K: Tensor,
    cosines: dict[str, float],
    total: float | None = None,
    head_K: Tensor | None = None,
) -> Weighting:
    """Tensors as the log has them; the total is the weighted sum where it is not said."""
    total = float(weight_K @ step.loss_K) if total is None else total
    floats = {name: loss.item() for name, loss in losses.items()}
    names = _names_of(method, step)
    weights = dict(zip(names, weight_K.tolist(), strict=True))
    heads = {} if head_K is None else dict(zip(names, head_K.tolist(), strict=True))
    return Weighting(total, step, floats, weights, heads, cosines)


# --- loss-value methods ---------------------------------------------------------------------------


def _by_losses(
    method: LossMethod,
    parts: Sequence[Forward],
    model: Split,
    scale: float,
    cosines: bool,
    together: Together,
) -> Weighting:
    """The weights are the derivatives of the method's scalar."""
    seen, count, passes = _looked_at(method, parts, model, together)
    step = _step_of(method, seen)
    total, scaled_K = _differentiate(method, step, scale)
    scaled_K = together.first(scaled_K)
    cosine_of: dict[str, float] = {}
    scaled = dict(zip(_names_of(method, step), scaled_K, strict=True))
    with together.statistics(model):
        for number, passed in enumerate(passes):
            mine = gather(passed.losses, method.terms)
            if not mine:
                continue
            if cosines and number == 0:
                cosine_of = _measured(mine, _trained(passed), model, together)
            grads = [scaled[name] / count[name] for name in mine]
            torch.autograd.backward(list(mine.values()), grads)
    together.grads([*trainable(model.shared_parameters()), *trainable(model.task_parameters())])
    return _weighting(method, mean_losses(seen), step, scaled_K / scale, cosine_of, total)


def _differentiate(method: LossMethod, step: Step, scale: float) -> tuple[float, Tensor]:
    """The method's scalar and `scale` times its derivatives; its own parameters get theirs, too."""
    leaf_K = step.loss_K.clone().requires_grad_()
    total = method.total(replace(step, loss_K=leaf_K))
    (total * scale).backward()
    assert leaf_K.grad is not None
    return total.item(), leaf_K.grad


def _measured(
    losses: Mapping[str, Tensor], z: list[Tensor], model: Split, together: Together
) -> dict[str, float]:
    """Cosines of the losses' gradients, whose graph stays."""
    shared = trainable(model.shared_parameters())
    row_of: dict[str, Gradient] = {}
    for name, loss in losses.items():
        z_grads = torch.autograd.grad(loss, z, retain_graph=True, allow_unused=True)
        row_of[name] = onward(z, z_grads, shared, keep=True)
    if together.one_batch:
        row_of |= together.rows([*row_of], row_of, shared)
    rows = list(row_of.values())
    return cosines_of(list(losses), products(rows, rows))


# --- gradient methods -----------------------------------------------------------------------------


@dataclass
class _Seen:
    """Of one batch: what a method sees, and what belongs to one task only."""

    losses: dict[str, Tensor]
    step: Step
    names: list[str]  # of the step's losses
    rows: list[list[Tensor | None]]  # K gradients
    gradients: Gradients  # where they are from
    own: dict[str, list[Tensor | None]]


class _ByGradients:
    """A gradient method's step, behind a loss-value method where two are composed."""

    def __init__(
        self,
        first: LossMethod | None,
        method: GradientMethod,
        model: Split,
        scale: float,
        together: Together,
    ):
        self.first, self.method, self.model, self.scale = first, method, model, scale
        self.together = together
        self.terms = [term.name for term in method.terms]
        self.shared = trainable(model.shared_parameters())
        self.own = trainable(model.task_parameters())

    def on_one_batch(
        self, batches: Sequence[Sequence[Forward]], lr: float, cosines: bool
    ) -> Weighting:
        """Every loss's gradient, then the method's answer."""
        seen = self._differentiated(batches[0], self.scale, self.own)
        first_K, step = self._first(seen.step)
        measured = {}
        if cosines:
            measured = cosines_of(seen.names, seen.gradients.products(seen.rows))
        if isinstance(seen.gradients, Matrix):
            J_KP = seen.gradients.J_KP
            if self.first is not None:
                J_KP *= first_K[:, None]
            direction_P, weight_K = self._direction(J_KP, first_K, step, batches, lr)
            seen.gradients.back(unflatten(direction_P * self.scale, self.shared))
        else:
            weight_K = self._weights(seen.gradients.products(seen.rows), first_K, step)
            seen.gradients.back(combine(first_K * weight_K * self.scale, seen.rows))
        head_K = first_K * self._head_weights(weight_K, step)
        self._add_own(seen.own, seen.names, head_K)
        weight_K = first_K * weight_K
        return _weighting(self.method, seen.losses, seen.step, weight_K, measured, head_K=head_K)

    def by_given_weights(
        self, parts: Sequence[Forward], weights_2T: Tensor, cosines: bool
    ) -> Weighting:
        """One weighted pass, with weights that are known before: of what is shared, and not."""
        weight_T, head_T = weights_2T
        seen, measured = self._weighted_pass(parts, self.terms, weight_T, head_T, cosines)
        step = _step_of(self.method, seen)
        here, losses = step.present, mean_losses(seen)
        return _weighting(self.method, losses, step, weight_T[here], measured, head_K=head_T[here])

    def on_three_batches(self, batches: Sequence[Sequence[Forward]], cosines: bool) -> Weighting:
        """Gradients of two batches for the weights, one weighted pass of a third for the update.

        Raises:
            UnlabelledError: the two batches have no loss in common.
        """
        seen = [self._differentiated(parts, self.scale, []) for parts in batches[:2]]
        names = [name for name in seen[0].names if name in seen[1].names]
        if not names:
            name = type(self.method).__name__
            raise UnlabelledError(f"{name} compares batches, and they share no labels")
        places = [[one.names.index(name) for name in names] for one in seen]
        rows = [[one.rows[i] for i in place] for one, place in zip(seen, places, strict=True)]
        loss_K, other_K = (one.step.loss_K[place] for one, place in zip(seen, places, strict=True))
        plain = Step((loss_K + other_K) / 2, seen[0].step.present[places[0]])
        first_K, step = self._first(plain)
        measured = cosines_of(names, products(rows[0], rows[0])) if cosines else {}
        weight_K = self._weights(products(*rows), first_K, step)
        head_K = first_K * self._head_weights(weight_K, step)
        del seen, rows  # as large as the network, many times
        weight_K = first_K * weight_K
        losses = mean_losses(self._weighted_pass(batches[2], names, weight_K, head_K)[0])
        return _weighting(self.method, losses, plain, weight_K, measured, head_K=head_K)

    def _first(self, step: Step) -> tuple[Tensor, Step]:
        """A composition's loss-value method is asked first: its weights, and the step by them."""
        if self.first is None:
            return torch.ones_like(step.loss_K), step
        first_K = self.together.first(_differentiate(self.first, step, self.scale)[1] / self.scale)
        return first_K, replace(step, loss_K=first_K * step.loss_K)

    def _weights(self, G_KK: Tensor, first_K: Tensor, step: Step) -> Tensor:
        """The method's weights [K]; ones where fp16 has overflowed, which no state may learn."""
        if not torch.isfinite(G_KK).all():
            return torch.ones_like(step.loss_K)
        scale_K = first_K.double().cpu()
        exact = replace(step, loss_K=step.loss_K.double().cpu())
        weight_K = self.method.weights(G_KK * scale_K * scale_K[:, None], exact)
        return self.together.first(weight_K.to(step.loss_K))

    def _direction(
        self,
        J_KP: Tensor,
        first_K: Tensor,
        step: Step,
        batches: Sequence[Sequence[Forward]],
        lr: float,
    ) -> tuple[Tensor, Tensor]:
        """The method's direction [P] and weights [K]; the sum where fp16 has overflowed."""
        if not torch.isfinite(J_KP.sum()):
            return J_KP.sum(0), torch.ones_like(step.loss_K)
        if not isinstance(self.method, LookAheadMethod):
            return self.method.direction(J_KP, step)
        first_T = first_K.new_ones(len(self.terms))
        first_T[step.present] = first_K

        def ahead(direction_P: Tensor) -> Tensor:
            """The second batch's gradients where a direction leads; the way back is taken, too."""
            before = [parameter.detach().clone() for parameter in self.shared]
            with torch.no_grad():
                for parameter, move in zip(
                    self.shared, unflatten(direction_P, self.shared), strict=True
                ):
                    parameter.sub_(lr * move)
            try:
                with frozen_statistics(self.model):
                    seen = self._differentiated(batches[1], 1.0, [])
            finally:
                with torch.no_grad():
                    for parameter, value in zip(self.shared, before, strict=True):
                        parameter.copy_(value)
            assert isinstance(seen.gradients, Matrix)
            ahead_KP = seen.gradients.J_KP * first_T[seen.step.present][:, None]
            return ahead_KP.nan_to_num(0.0, 0.0, 0.0)  # an overflow there says nothing

        return self.method.direction_ahead(J_KP, step, ahead, lr)

    def _head_weights(self, weight_K: Tensor, step: Step) -> Tensor:
        if not self.method.weighted_heads:
            return torch.ones_like(weight_K)
        return self.together.first(self.method.head_weights(weight_K, step))

    def _differentiated(
        self, parts: Sequence[Forward], scale: float, own: Sequence[nn.Parameter]
    ) -> _Seen:
        """Each loss's gradient, averaged over the parts of the batch that have the loss.

        Args:
            scale: of the losses before they are differentiated; the method's gradients are free of
                it, those of `own` are not.
            own: parameters that are not shared, whose gradients are wanted.
        """
        gradients = KINDS[self.method.needs](self.shared, self.terms, self.together)
        own_of: dict[str, list[Tensor | None]] = {}
        looked_at: list[Mapping[str, Tensor]] = []
        with self.together.statistics(self.model):
            for part in parts:
                passed = part()
                looked_at.append({name: loss.detach() for name, loss in passed.losses.items()})
                mine, z = gather(passed.losses, self.method.terms), _trained(passed)
                del passed  # which holds the losses, too
                gradients.add(z, _through_decoders(mine, z, own, own_of, scale))
        seen = self.together.losses(looked_at)
        step = _step_of(self.method, seen)
        names = _names_of(self.method, step)
        count = Counter(name for losses in seen for name in gather(losses, self.method.terms))
        rows = gradients.mean({name: scale * count[name] for name in names})
        own_of = self.together.rows(names, own_of, own)
        means = {name: divided(own_of[name], count[name]) for name in names}
        return _Seen(mean_losses(seen), step, names, rows, gradients, means)

    def _weighted_pass(
        self,
        parts: Sequence[Forward],
        names: Sequence[str],
        weight_K: Tensor,
        head_K: Tensor,
        cosines: bool = False,
    ) -> tuple[Sequence[Mapping[str, Tensor]], dict[str, float]]:
        """`.grad` of a batch whose losses count `weight` in what is shared, and `head` in the rest.

        Losses without a name here are left out.

        Returns:
            All parts' losses, and cosines of the first one's gradients where they are asked for.
        """
        seen, count, passes = _looked_at(self.method, parts, self.model, self.together)
        factors = [self.scale / max(count[name], 1) for name in names]
        factor_K = torch.tensor(factors).to(weight_K)
        own_of: dict[str, list[Tensor | None]] = {}
        total: list[Tensor | None] = [None] * len(self.shared)
        measured: dict[str, float] = {}
        with self.together.statistics(self.model):
            for number, passed in enumerate(passes):
                mine, z = gather(passed.losses, self.method.terms), _trained(passed)
                mine = {name: loss for name, loss in mine.items() if name in names}
                del passed
                if not mine:
                    continue
                if cosines and number == 0:
                    measured = _measured(mine, z, self.model, self.together)
                z_grads = _through_decoders(mine, z, self.own, own_of, 1.0)
                here = [names.index(name) for name in z_grads]
                weighted = combine((weight_K * factor_K)[here], list(z_grads.values()))
                total = add(total, onward(z, weighted, self.shared, keep=False))
        for parameter, grad in zip(self.shared, total, strict=True):
            parameter.grad = grad
        self.together.grads(self.shared)
        self._add_own(self.together.rows(names, own_of, self.own), names, head_K * factor_K)
        return seen, measured

    def _add_own(
        self,
        grads_of: Mapping[str, Sequence[Tensor | None]],
        names: Sequence[str],
        weight_K: Tensor,
    ) -> None:
        """Weighted gradients of what belongs to one task, into `.grad`."""
        for name, weight in zip(names, weight_K, strict=True):
            unit = weight == 1  # most often
            for parameter, grad in zip(self.own, grads_of.get(name, ()), strict=False):
                if grad is not None:
                    grad = grad if unit else grad * weight.to(grad)
                    parameter.grad = grad if parameter.grad is None else parameter.grad + grad


def _through_decoders(
    losses: dict[str, Tensor],
    z: Sequence[Tensor],
    own: Sequence[nn.Parameter],
    own_of: dict[str, list[Tensor | None]],
    scale: float,
) -> dict[str, Gradient]:
    """Gradients of what the decoders read, by loss; those of their parameters join `own_of`.

    All decoders come before the encoder, whose own passes need memory, too: a loss that is done
    with leaves `losses` and takes its decoder's activations along.
    """
    found: dict[str, Gradient] = {}
    for name in list(losses):
        loss = losses.pop(name) * scale
        keep = len(losses) > 0  # they may share a decoder
        grads = torch.autograd.grad(loss, [*z, *own], retain_graph=keep, allow_unused=True)
        found[name] = grads[: len(z)]
        own_of[name] = add(own_of.get(name), grads[len(z) :])
    return found


def trainable(parameters: Iterator[nn.Parameter]) -> list[nn.Parameter]:
    return [parameter for parameter in parameters if parameter.requires_grad]
