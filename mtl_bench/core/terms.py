"""Loss terms: what a method weighs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Term:
    """One scalar that a method weighs: a loss term, or a task as the sum of its weighted terms."""

    name: str
    task: str
    kind: str  # classification | regression: the likelihood behind it, for uncertainty weighting
    fixed_weight: float  # the published constant
    parts: tuple["Term", ...] = ()  # of a task: its terms


def present(losses: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    """Those that there are: a term whose pixels are none is absent, not solved.

    A loss of 0 would tell a method that the term needs nothing more, and some then weigh all others
    by next to nothing.
    """
    return {name: loss for name, loss in losses.items() if loss is not None}


def gather(losses: Mapping[str, Tensor], terms: Sequence[Term]) -> dict[str, Tensor]:
    """The losses that these terms stand for; a task's is the sum of its terms at fixed weights.

    A term is absent where the batch has no labels for it, a task where it has none of its terms.
    """
    found: dict[str, Tensor] = {}
    for term in terms:
        here = [part for part in term.parts if part.name in losses]
        if here:
            weighted = [part.fixed_weight * losses[part.name] for part in here]
            several = len(weighted) > 1
            found[term.name] = torch.stack(weighted).sum() if several else weighted[0]
        elif not term.parts and term.name in losses:
            found[term.name] = losses[term.name]
    return found
