"""Training with the weights that a method gave in another run, but not by the method.

What is left of a method's gain when its weights no longer follow the training is not due to their
adapting. Source: arXiv:2505.10347 trains with fixed weights, the mean that a method had converged
to; shuffled and level weights are ours.

The batches are those of the recorded run, as data order and seed are. A loss is weighed wherever
the batch has it; where the record has no weight for it at that step, by its mean weight.

Shapes: S steps of the record, T losses of the method, H = 1 where everything is trained with the
same weights, else 2: those of what is shared, and those of the rest.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from mtl_bench.core.method import GradientMethod, LossMethod, Method, Step
from mtl_bench.train import curve


class Replay(Method):
    """What both kinds of replay share: the weights, step by step."""

    columns: Sequence[str]  # prefixes of the record's columns, one for each of H
    weights_HT: Tensor  # of the present step

    def take(self, record: Path, steps: int, mode: str, seed: int) -> None:
        """Read a run's weights and arrange them.

        Args:
            record: its `curve.csv`.
            mode: of `core.config.REPLAYS`.

        Raises:
            ValueError: the record is damaged, or has not the weights of all steps and losses.
        """
        rows = curve.read(record)
        names = [[f"{prefix}.{term.name}" for term in self.terms] for prefix in self.columns]
        lacking = [name for several in names for name in several if not rows or name not in rows[0]]
        if lacking or len(rows) < steps:
            what = f"{len(rows)} of {steps} steps" if len(rows) < steps else f"no '{lacking[0]}'"
            raise ValueError(f"{record} has {what}: train its cell again, with --rerun")
        recorded = [[[float(row[k] or math.nan) for k in some] for some in names] for row in rows]
        series_SHT = torch.tensor(recorded, dtype=torch.float32).double()  # as the method gave them
        self.series_SHT = arranged(series_SHT, mode, seed).to(self.fixed_T)

    def at(self, step: int) -> None:
        """Go to a step, counted from 0."""
        self.weights_HT = self.series_SHT[step]


class LossReplay(Replay, LossMethod):
    """Of a loss-value method: sum_i w_i L_i, one ordinary backward pass."""

    columns = ("weight",)

    def total(self, step: Step) -> Tensor:
        return (self.weights_HT[0, step.present] * step.loss_K).sum()


class GradientReplay(Replay, GradientMethod):
    """Of a gradient method: one weighted pass through what is shared, after that of each decoder,
    which is trained as the method trained it."""

    columns = ("weight", "head")


def replay_of(method: Method) -> Replay:
    """What stands in the place of a method; it has no weights before it takes a record."""
    kind = LossReplay if isinstance(method, LossMethod) else GradientReplay
    return kind(method.terms)


def arranged(series_SHT: Tensor, mode: str, seed: int) -> Tensor:
    """Weights for every step, from those of a record; NaN where a batch lacked a loss.

    Args:
        mode: `mean` over the steps that have the loss; `final`, its last; `shuffled`, each step's
            weights at another step whose batch has the same losses; `level`, at each step the mean
            over its losses for all of them.
        seed: of the order in which they are shuffled.
    """
    mean_HT = series_SHT.nanmean(0)
    if mode == "mean":
        found = mean_HT.expand_as(series_SHT)
    elif mode == "final":
        found = torch.stack([_last(one) for one in series_SHT.flatten(1).T]).view_as(mean_HT)
        found = found.expand_as(series_SHT)
    elif mode == "shuffled":
        found = series_SHT[_order(series_SHT[:, 0].isnan(), seed)]
    else:
        found = series_SHT.nanmean(2, keepdim=True).expand_as(series_SHT)
        mean_HT = found.nanmean(0)
    return torch.where(found.isnan(), mean_HT, found)


def _last(series_S: Tensor) -> Tensor:
    known = series_S[~series_S.isnan()]
    return known[-1] if len(known) else series_S[-1]


def _order(absent_ST: Tensor, seed: int) -> Tensor:
    """A permutation [S] of the steps that keeps to steps with the same losses."""
    draw = torch.Generator().manual_seed(seed)
    order_S = torch.arange(len(absent_ST))
    alike: dict[tuple[bool, ...], list[int]] = {}
    for step, absent_T in enumerate(absent_ST.tolist()):
        alike.setdefault(tuple(absent_T), []).append(step)
    for steps in alike.values():
        places = torch.tensor(steps)
        order_S[places] = places[torch.randperm(len(places), generator=draw)]
    return order_S
