"""What a weighting method may ask for and must answer.

A method turns the unweighted losses of a step into one update. It is a file in `methods/` with one
class, which declares in one word what it needs and has the function that gets it:

    needs               of the losses                                          function
    "losses"            their values                                           total
    "gramian"           inner products of their gradients                      weights
    "representation"    the same, of the gradients of what the decoders read   weights
    "jacobian"          their gradients                                        direction

A `LossMethod` needs values: its scalar's derivatives are its weights, so that these are exact and
nobody has to report them. A `GradientMethod` needs one of the others, of what the tasks share. No
method sees the network, the precision or the loss scale.

Hyper-parameters are keyword arguments of the constructor. State is buffers and parameters, so that
it travels in checkpoints; randomness comes from `self.generator`, which does too.

Shapes: T losses of the cell, K losses of this step (a batch may lack a task's labels; nearly
always K = T), P shared parameters, flattened.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from mtl_bench.core.terms import Term

Needs = Literal["losses", "gramian", "representation", "jacobian"]


@dataclass(frozen=True)
class Step:
    """The losses of one step. A method with state of every term reads `state_T[step.present]`."""

    loss_K: Tensor
    present: Tensor  # [K]: which of the T terms they are


class Method(nn.Module):
    """What both kinds share. Derive from `LossMethod` or `GradientMethod` instead.

    Args:
        terms: what is weighted, in the order of every vector with suffix T; each has a `name`, a
            `task`, a `kind` (classification or regression) and the paper's `fixed_weight`.
        seed: start of `self.generator`.
    """

    needs: Needs
    batches = 1  # independent batches a step
    replayable: bool  # whether every update is the sum of one batch's gradients by the weights that
    # it logs, which `replay` can then train with; unsaid: yes, but not where it needs a jacobian
    reevaluates = False  # True: `after_step` gets the batch's losses under the new parameters
    # Hyper-parameters that a grid's trials tune, and where their values lie: see bench/space.py
    space: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    stage_members: ClassVar[dict[str, tuple[str, ...]]] = {"tune": ("space",)}
    fixed_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0):
        super().__init__()
        self.terms = tuple(terms)
        self.generator = torch.Generator().manual_seed(seed)
        fixed = torch.tensor([term.fixed_weight for term in terms])
        self.register_buffer("fixed_T", fixed, persistent=False)

    def after_step(self, step: Step, after_K: Tensor) -> None:
        """Learn from what the update did.

        Args:
            step: the step, whose losses are those before the update.
            after_K: the same batch's losses after it.
        """
        raise NotImplementedError

    def get_extra_state(self) -> dict[str, Any]:
        return {"terms": [t.name for t in self.terms], "generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        names = [term.name for term in self.terms]
        if state["terms"] != names:  # slots mean terms: loading others would be silently wrong
            raise ValueError(f"method state is for the terms {state['terms']}, not {names}")
        self.generator.set_state(state["generator"])


class LossMethod(Method):
    """A method that needs loss values only: one ordinary backward pass."""

    needs: Needs = "losses"

    def total(self, step: Step) -> Tensor:
        """The scalar to minimise, differentiable in the losses and in the method's parameters."""
        raise NotImplementedError


class GradientMethod(Method):
    """A method that needs every loss's gradient: K backward passes through what is shared.

    With needs = "representation" these end at what the decoders read; one goes on into the encoder.
    """

    needs: Needs = "gramian"
    weighted_heads = False  # True: decoders, heads and pose are trained with `head_weights`

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        """Weights [K] of the gradients.

        Args:
            G_KK: their Gramian J J^T; float64 on the CPU, as the step's losses.
        """
        raise NotImplementedError

    def direction(self, J_KP: Tensor, step: Step) -> tuple[Tensor, Tensor]:
        """Update direction [P] of the shared parameters, and the weights [K] to log.

        A method whose direction is always weights @ J says so: replayable = True.
        """
        raise NotImplementedError

    def head_weights(self, weight_K: Tensor, step: Step) -> Tensor:
        """Weights [K] of the losses for the parameters that are not shared.

        Args:
            weight_K: those of the gradients.
        """
        return weight_K


class CrossMethod(GradientMethod):
    """A gradient method whose weights come from two batches, and train on a third.

    Of independent batches, J_1 J_2^T estimates the Gramian of the expected gradients without bias;
    J_1 J_1^T would not. The third batch needs no gradients of single losses for what is shared.
    `weights` gets J_1 J_2^T as its G_KK, and the two batches' mean losses.
    """

    batches = 3
    replayable = False


class LookAheadMethod(GradientMethod):
    """A gradient method that asks how other losses react to its update before it is made."""

    needs = "jacobian"
    batches = 2  # one to train on, one to look at
    replayable = False

    def direction_ahead(
        self, J_KP: Tensor, step: Step, ahead: Callable[[Tensor], Tensor], lr: float
    ) -> tuple[Tensor, Tensor]:
        """Update direction [P] and weights [K], in the place of `direction`.

        Args:
            ahead: takes a direction [P], moves the shared parameters by -lr times it, and returns
                the second batch's gradients J [K,P] there. The parameters are then as before.
            lr: today's learning rate of the shared parameters.
        """
        raise NotImplementedError


class Wrapper(GradientMethod):
    """A gradient method around another: in `a+b`, what `a` makes of the weights of `b`.

    Unless it says otherwise, nothing.

    Args:
        inner: what it is around where nothing is said.
    """

    def __init__(self, terms: Sequence[Term], inner: GradientMethod, seed: int = 0):
        super().__init__(terms, seed)
        self.around(inner)

    def around(self, inner: GradientMethod) -> "Wrapper":
        """Itself, around another method.

        Raises:
            ValueError: a method whose answer is more than weights of one batch's gradients.
        """
        if inner.needs == "jacobian" or inner.batches != 1:
            name, other = type(self).__name__, type(inner).__name__
            raise ValueError(f"{name} goes around methods that weigh one batch, not {other}")
        self.inner, self.needs, self.weighted_heads = inner, inner.needs, inner.weighted_heads
        return self

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        return self.inner.weights(G_KK, step)

    def head_weights(self, weight_K: Tensor, step: Step) -> Tensor:
        return self.inner.head_weights(weight_K, step)


class PerturbedMethod(Wrapper):
    """A wrapper that has every loss differentiated at a point of its own, near the present one.

    The method that it is around sees those gradients, and the losses where the point is.
    """

    replayable = False

    def around(self, inner: GradientMethod) -> Wrapper:
        """Itself, around another method.

        Raises:
            ValueError: one that wants gradients of anything but what is shared.
        """
        if inner.needs == "representation":
            name, other = type(self).__name__, type(inner).__name__
            raise ValueError(
                f"{name} moves shared parameters, and {other} wants no gradients of them"
            )
        return super().around(inner)

    def shifts(
        self,
        mean: Sequence[Tensor | None],
        losses_at: Callable[[Sequence[Tensor]], Tensor],
        step: Step,
    ) -> list[list[Tensor]]:
        """How far to move for each of K losses, tensor by tensor of what is shared.

        Args:
            mean: the gradient of the losses' mean, up to a positive factor.
            losses_at: takes a shift, returns the losses [K] there.
        """
        raise NotImplementedError


class Composed(Method):
    """A loss-value method first, a gradient method on the losses as it weighs them: `a+b`.

    The gradients that the gradient method sees are scaled by the first method's weights; what is
    not shared is trained with those weights times the gradient method's own.
    """

    needs: Needs = "gramian"

    def __init__(self, loss: LossMethod, gradient: GradientMethod):
        super().__init__(loss.terms)
        self.loss = loss
        self.gradient = gradient
        self.needs = gradient.needs
        self.batches = gradient.batches
        self.reevaluates = loss.reevaluates  # a gradient method has its gradients to learn from

    def after_step(self, step: Step, after_K: Tensor) -> None:
        self.loss.after_step(step, after_K)
