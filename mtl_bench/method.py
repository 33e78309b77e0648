"""What a weighting method may ask for and must answer.

A method turns the unweighted loss terms of one step into one update. It is a file in `methods/`
with one class, of one of two kinds:

- `LossMethod`: answers with one scalar, `total(loss_T)`. Its task weights are the scalar's
  derivatives, so they are exact and nobody has to report them.
- `GradientMethod`: sees the task gradients of the shared parameters and answers with weights or
  with a direction. It never sees the network, the ranks or the loss scale.

Hyper-parameters are keyword arguments of the constructor. State is buffers and parameters, so that
it travels in checkpoints; randomness comes from `self.generator`, which does too.

Shapes: T loss terms, P shared parameters (flattened).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.losses.terms import Term


class Method(nn.Module):
    """What both kinds share. Derive from `LossMethod` or `GradientMethod` instead.

    Args:
        terms: the loss terms in the order of every vector with suffix T; each has a `name`, a
            `task`, a `kind` (classification or regression) and the paper's `fixed_weight`.
        seed: start of `self.generator`.
    """

    fixed_T: Tensor

    def __init__(self, terms: Sequence[Term], seed: int = 0):
        super().__init__()
        self.terms = tuple(terms)
        self.generator = torch.Generator().manual_seed(seed)
        fixed = torch.tensor([term.fixed_weight for term in terms])
        self.register_buffer("fixed_T", fixed, persistent=False)

    def get_extra_state(self) -> dict[str, Any]:
        return {"terms": [t.name for t in self.terms], "generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        names = [term.name for term in self.terms]
        if state["terms"] != names:  # slots mean terms: loading others would be silently wrong
            raise ValueError(f"method state is for the terms {state['terms']}, not {names}")
        self.generator.set_state(state["generator"])


class LossMethod(Method):
    """A method that needs loss values only: one ordinary backward pass."""

    def total(self, loss_T: Tensor) -> Tensor:
        """The scalar to minimise, differentiable in the losses and in the method's parameters."""
        raise NotImplementedError


class GradientMethod(Method):
    """A method that needs the gradient of every term: T backward passes through the encoder.

    Override `weights` (the common case) or `direction`.
    """

    weighted_heads = False  # True: decoders, heads and pose are trained with the weights too

    def weights(self, G_TT: Tensor, loss_T: Tensor) -> Tensor:
        """Weights [T] of the task gradients.

        Args:
            G_TT: their Gramian J J^T, float64 on the CPU.
            loss_T: the losses, float64 on the CPU.
        """
        raise NotImplementedError

    def direction(self, J_TP: Tensor, loss_T: Tensor) -> tuple[Tensor, Tensor]:
        """Update direction [P] of the shared parameters, and the weights [T] to log."""
        G_TT = (J_TP @ J_TP.T).double().cpu()
        weight_T = self.weights(G_TT, loss_T.double().cpu()).to(J_TP)
        return weight_T @ J_TP, weight_T
