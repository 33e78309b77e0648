"""The loss terms: which exist, which task each belongs to, and the paper's fixed weights."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Term:
    """One scalar that a method weighs: a loss term, or a task as the sum of its weighted terms."""

    name: str
    task: str  # panoptic | depth
    kind: str  # classification | regression: the likelihood behind it, for uncertainty weighting
    fixed_weight: float


TERMS = (
    Term("semantic", "panoptic", "classification", 1.0),
    Term("center", "panoptic", "regression", 200.0),
    Term("offset", "panoptic", "regression", 0.01),
    Term("photometric", "depth", "regression", 1.0),
    Term("smoothness", "depth", "regression", 0.001),
)


TASK_KINDS = {"panoptic": "classification", "depth": "regression"}  # of most of the sum


def terms_of(tasks: Iterable[str], granularity: str = "terms") -> tuple[Term, ...]:
    """What a method weighs: the terms of these tasks in the order of TERMS, or the tasks.

    Raises:
        ValueError: a task that no term belongs to.
    """
    tasks = tuple(tasks)
    for task in tasks:
        if task not in TASK_KINDS:
            raise ValueError(f"no task called '{task}' (known: {', '.join(sorted(TASK_KINDS))})")
    if granularity == "tasks":
        return tuple(
            Term(task, task, TASK_KINDS[task], 1.0) for task in TASK_KINDS if task in tasks
        )
    return tuple(term for term in TERMS if term.task in tasks)


def gather(losses: Mapping[str, Tensor], terms: Sequence[Term]) -> dict[str, Tensor]:
    """The losses that these terms stand for; a task's is the sum of its terms at fixed weights.

    A term is absent where the batch has no labels for it, a task where it lacks one of its terms.
    """
    found: dict[str, Tensor] = {}
    for term in terms:
        if term.name in TASK_KINDS:
            parts = [part for part in TERMS if part.task == term.name]
            if all(part.name in losses for part in parts):
                weighted = [part.fixed_weight * losses[part.name] for part in parts]
                found[term.name] = torch.stack(weighted).sum()
        elif term.name in losses:
            found[term.name] = losses[term.name]
    return found
