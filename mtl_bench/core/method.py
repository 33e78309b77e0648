"""What a weighting method may ask for and must answer.

A method turns the unweighted losses of one step into one update. It is a file in `methods/` with
one class, of one of two kinds:

- `LossMethod`: answers with one scalar, `total(loss_K)`. Its task weights are the scalar's
  derivatives, so they are exact and nobody has to report them.
- `GradientMethod`: sees the task gradients of what is shared and answers with weights or with a
  direction. It never sees the network, the precision or the loss scale.

Hyper-parameters are keyword arguments of the constructor. State is buffers and parameters, so that
it travels in checkpoints; randomness comes from `self.generator`, which does too.

Shapes: T losses of the cell, K losses of this batch (a batch may lack a task's labels; nearly
always K = T), P shared parameters, flattened.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core.terms import Term


class Method(nn.Module):
    """What both kinds share. Derive from `LossMethod` or `GradientMethod` instead.

    Args:
        terms: what is weighted, in the order of every vector with suffix T; each has a `name`, a
            `task`, a `kind` (classification or regression) and the paper's `fixed_weight`.
        seed: start of `self.generator`.
    """

    fixed_T: Tensor
    batches = 1  # independent batches a step
    reevaluates = False  # True: `after_step` gets the batch's losses under the new parameters

    def __init__(self, terms: Sequence[Term], seed: int = 0):
        super().__init__()
        self.terms = tuple(terms)
        self.present = torch.arange(len(terms))  # which of T the K are: state_T[self.present]
        self.generator = torch.Generator().manual_seed(seed)
        fixed = torch.tensor([term.fixed_weight for term in terms])
        self.register_buffer("fixed_T", fixed, persistent=False)

    def after_step(self, before_K: Tensor, after_K: Tensor) -> None:
        """The same batch's losses before and after the optimiser's step, detached."""
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

    def total(self, loss_K: Tensor) -> Tensor:
        """The scalar to minimise, differentiable in the losses and in the method's parameters."""
        raise NotImplementedError


class GradientMethod(Method):
    """A method that needs every loss's gradient: K backward passes through what is shared.

    Override `weights` (the common case) or `direction`.
    """

    weighted_heads = False  # True: decoders, heads and pose are trained with the weights too
    # Of the gradients: "parameters", the shared ones; or "representation", what the decoders read:
    # then K backward passes end there, and one goes on into the encoder.
    space = "parameters"

    def weights(self, G_KK: Tensor, loss_K: Tensor) -> Tensor:
        """Weights [K] of the task gradients.

        Args:
            G_KK: their Gramian J J^T, float64 on the CPU.
            loss_K: the losses, float64 on the CPU.
        """
        raise NotImplementedError

    def direction(self, J_KP: Tensor, loss_K: Tensor) -> tuple[Tensor, Tensor]:
        """Update direction [P] of the shared parameters, and the weights [K] to log.

        Where a method does not override this, the same comes about without the matrix J.
        """
        G_KK = (J_KP @ J_KP.T).double().cpu()
        weight_K = self.weights(G_KK, loss_K.double().cpu()).to(J_KP)
        return weight_K @ J_KP, weight_K

    def head_weights(self, weight_K: Tensor, loss_K: Tensor) -> Tensor:
        """Weights [K] of each loss for the parameters that are not shared."""
        return weight_K if self.weighted_heads else torch.ones_like(weight_K)


class CrossMethod(GradientMethod):
    """A gradient method whose weights come from two batches, and train on a third.

    Of independent batches, J_1 J_2^T estimates the Gramian of the expected gradients without bias;
    J_1 J_1^T would not. The third batch needs no gradients of single losses for what is shared.
    Override `weights`, whose G_KK is J_1 J_2^T here and whose losses are the two batches' mean.
    """

    batches = 3

    def direction(self, J_NKP: Tensor, loss_NK: Tensor) -> tuple[Tensor, Tensor]:
        """What the three batches' gradients J_1, J_2, J_3 lead to."""
        A_KK = (J_NKP[0] @ J_NKP[1].T).double().cpu()
        weight_K = self.weights(A_KK, loss_NK[:2].mean(0).double().cpu()).to(J_NKP)
        return weight_K @ J_NKP[2], weight_K


class LookAheadMethod(GradientMethod):
    """A gradient method that asks how other losses react to its update before it is made."""

    batches = 2  # one to train on, one to look at

    def direction_ahead(
        self, J_KP: Tensor, loss_K: Tensor, ahead: Callable[[Tensor], Tensor], lr: float
    ) -> tuple[Tensor, Tensor]:
        """Update direction [P] and weights [K].

        Args:
            ahead: takes a direction [P], moves the shared parameters by -lr times it, and returns
                the second batch's gradients J [K,P] there. The parameters are then as before.
            lr: today's learning rate of the shared parameters.
        """
        raise NotImplementedError


class Composed(Method):
    """A loss-value method first, a gradient method on the losses as it weighs them: `a+b`.

    The rows that the gradient method sees are scaled by the first method's weights; what is not
    shared is trained with those weights times the gradient method's own.
    """

    def __init__(self, loss: LossMethod, gradient: GradientMethod):
        super().__init__(loss.terms)
        self.loss = loss
        self.gradient = gradient
        self.batches = gradient.batches
        self.reevaluates = loss.reevaluates  # a gradient method has its gradients to learn from

    def after_step(self, before_K: Tensor, after_K: Tensor) -> None:
        self.loss.after_step(before_K, after_K)
