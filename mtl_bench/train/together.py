"""What the ranks of a cell do together in a step, so that each of them takes the same one.

Every rank has some parts of a batch. All hear the losses of all parts, in the batch's order, and
sum their gradients; whatever follows from these each computes for itself, from the same numbers.
Or all have the one part that a whole batch is, of which each differentiates its own samples, see
`one_batch`: they take rank 0's losses, which are everyone's but for rounding, and sum as before.
Of one rank alone nothing is sent and nothing copied.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mtl_bench.core.ranks import ALONE, Ranks
from mtl_bench.train.statistics import Modules, common_statistics, mean_statistics

Gradient = Sequence[Tensor | None]  # of some tensors, None where it is zero


def _any(losses: Mapping[str, Tensor]) -> None:
    """Takes every loss as it is."""


@dataclass(frozen=True)
class Together:
    """The ranks, and what has to hold of the losses of each part.

    Args:
        check: raises where they are not what a method may see; on all ranks, or on none.
        device: where losses lie.
        one_batch: whether every rank has the losses of the whole batch.
    """

    ranks: Ranks = ALONE
    check: Callable[[Mapping[str, Tensor]], None] = _any
    device: str | torch.device = "cpu"
    one_batch: bool = False

    def have_all(self, parts: Sequence[object]) -> bool:
        """Whether this rank's one part is all that there is of a batch."""
        return len(parts) == 1 and (self.ranks.size == 1 or self.one_batch)

    def losses(self, parts: Sequence[Mapping[str, Tensor]]) -> Sequence[Mapping[str, Tensor]]:
        """Detached losses of all ranks' parts, from those of this one's."""
        if self.ranks.size > 1:
            parts = self._of_all(parts)
        for losses in parts:
            self.check(losses)
        return parts

    def _of_all(self, parts: Sequence[Mapping[str, Tensor]]) -> Sequence[Mapping[str, Tensor]]:
        every = [loss.detach().float() for losses in parts for loss in losses.values()]
        values = iter(torch.stack(every).tolist() if every else [])
        told = self.ranks.gather([{name: next(values) for name in losses} for losses in parts])
        return [
            {name: torch.tensor(value, device=self.device) for name, value in losses.items()}
            for of_rank in (told[:1] if self.one_batch else told)
            for losses in of_rank
        ]

    def first(self, weight_K: Tensor) -> Tensor:
        """Weights as rank 0 has them: another processor may round a solver's in another way."""
        if self.ranks.size == 1:
            return weight_K
        return weight_K.new_tensor(self.ranks.from_first(weight_K.tolist()))

    def rows(
        self, names: Sequence[str], row_of: Mapping[str, Gradient], like: Sequence[Tensor]
    ) -> dict[str, list[Tensor | None]]:
        """Sums over ranks of each name's gradient; None where it is on all of them.

        Args:
            row_of: this rank's; a name that it lacks has none.
            like: the tensors that they are gradients of.
        """
        rows = {name: list(row_of.get(name) or [None] * len(like)) for name in names}
        if self.ranks.size == 1 or not like:
            return rows
        own = ["".join("0" if g is None else "1" for g in row) for row in rows.values()]
        masks = zip(*self.ranks.gather(own), strict=True)
        for (name, row), mask in zip(rows.items(), masks, strict=True):
            there = ["1" in marks for marks in zip(*mask, strict=True)]
            rows[name] = self._sum(row, like, there)
        return rows

    def _sum(
        self, row: Gradient, like: Sequence[Tensor], there: Sequence[bool]
    ) -> list[Tensor | None]:
        here = [(g, x) for g, x, is_there in zip(row, like, there, strict=True) if is_there]
        if not here:
            return [None] * len(row)
        parts = [torch.zeros_like(x) if g is None else g for g, x in here]
        flat = self.ranks.sum_(torch.cat([part.reshape(-1) for part in parts]))
        found = iter(
            torch.empty_like(x).copy_(part.view(x.shape))  # in the memory layout of its tensor
            for part, (_, x) in zip(flat.split([x.numel() for _, x in here]), here, strict=True)
        )
        return [next(found) if is_there else None for is_there in there]

    def grads(self, parameters: Sequence[nn.Parameter]) -> None:
        """Every `.grad` becomes the sum over ranks."""
        if self.ranks.size > 1:
            row = {"": [parameter.grad for parameter in parameters]}
            for parameter, grad in zip(
                parameters, self.rows([""], row, parameters)[""], strict=True
            ):
                parameter.grad = grad

    def statistics(self, model: Modules) -> AbstractContextManager[None]:
        """See `common_statistics`; those of one batch are common already."""
        if self.one_batch:
            return nullcontext()
        return common_statistics(model, self.ranks)

    def mean_statistics(self, model: Modules) -> AbstractContextManager[None]:
        """See `mean_statistics`; those of one batch are common already."""
        return mean_statistics(model, ALONE if self.one_batch else self.ranks)
