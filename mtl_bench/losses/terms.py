"""The loss terms: which exist, which task each belongs to, and the paper's fixed weights."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Term:
    """One scalar that leaves the losses unweighted."""

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


def terms_of(tasks: Iterable[str]) -> tuple[Term, ...]:
    """The terms of these tasks, in the order of TERMS.

    Raises:
        ValueError: a task that no term belongs to.
    """
    tasks = tuple(tasks)
    known = {term.task for term in TERMS}
    for task in tasks:
        if task not in known:
            raise ValueError(f"no task called '{task}' (known: {', '.join(sorted(known))})")
    return tuple(term for term in TERMS if term.task in tasks)
