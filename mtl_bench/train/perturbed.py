"""Parts of a batch for a method that differentiates each loss at a point of its own.

Every loss gets a pass of its own: on its way in, the shared parameters move by the loss's shift;
the next pass, or the end, takes them back. The losses keep the values that they have where the
parameters were. Batch norms count the first pass of all and no other.

Shapes: K losses of the batch.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from mtl_bench.core.method import PerturbedMethod, Step
from mtl_bench.core.terms import Term, gather
from mtl_bench.train.gramian import add
from mtl_bench.train.statistics import frozen_statistics
from mtl_bench.train.together import Together

if TYPE_CHECKING:
    from mtl_bench.train.backward import Forward, Pass, Split


@contextlib.contextmanager
def perturbed(
    method: PerturbedMethod,
    parts: "Sequence[Forward]",
    shared: Sequence[nn.Parameter],
    model: "Split",
    together: Together,
) -> "Iterator[list[Forward]]":
    """Parts to differentiate in place of the given ones, one a loss and part, in their order.

    Args:
        shared: what is moved.
    """
    values: list[dict[str, Tensor]] = []  # by part, of the terms that it has
    mean: list[Tensor | None] | None = None
    with together.statistics(model):
        for part in parts:
            mine = gather(part().losses, method.terms)
            values.append({name: loss.detach() for name, loss in mine.items()})
            if mine:
                total = torch.stack(list(mine.values())).sum()
                mean = add(mean, torch.autograd.grad(total, shared, allow_unused=True))
    everywhere = together.losses(values)
    present = [term for term in method.terms if any(term.name in part for part in everywhere)]
    if not present:  # no labels at all: not for this module to say
        yield list(parts)
        return
    mean = together.rows(["mean"], {} if mean is None else {"mean": mean}, shared)["mean"]
    before = [parameter.detach().clone() for parameter in shared]

    def move(shift: Sequence[Tensor] | None) -> None:
        with torch.no_grad():
            for i, (parameter, value) in enumerate(zip(shared, before, strict=True)):
                parameter.copy_(value if shift is None else value + shift[i])

    def losses_at(shift: Sequence[Tensor]) -> Tensor:
        move(shift)
        with torch.no_grad():
            found = [gather(part().losses, method.terms) for part in parts]
        return _means(together.losses(found), present)

    indices = torch.tensor([i for i, term in enumerate(method.terms) if term in present])
    step = Step(_means(everywhere, present), indices)
    with frozen_statistics(model):
        shifts = method.shifts(mean, losses_at, step)
        try:
            yield [
                _at(part, own, term, shift, move)
                for term, shift in zip(present, shifts, strict=True)
                for part, own in zip(parts, values, strict=True)
                if term.name in own
            ]
        finally:
            move(None)


def _means(parts: Sequence[Mapping[str, Tensor]], terms: Sequence[Term]) -> Tensor:
    of = [[part[term.name] for part in parts if term.name in part] for term in terms]
    return torch.stack([torch.stack(values).mean() for values in of]).detach()


def _at(
    part: "Forward",
    values: dict[str, Tensor],
    term: Term,
    shift: Sequence[Tensor],
    move: Callable[[Sequence[Tensor] | None], None],
) -> "Forward":
    """A part's pass at a shift, with one term's losses, whose value is what it was before."""
    names = [one.name for one in term.parts or (term,)]

    def forward() -> "Pass":
        move(shift)
        passed = part()
        there = {name: passed.losses[name] for name in names}
        away = (values[term.name] - gather(there, [term])[term.name]).detach()
        first = term.parts[0].fixed_weight if term.parts else 1.0
        there[names[0]] = there[names[0]] + away / first
        return replace(passed, losses=there)

    return forward
