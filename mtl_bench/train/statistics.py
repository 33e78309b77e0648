"""Running statistics of batch norms: left alone by passes that do not count, one on all ranks,
means of many batches at the end, and not trusted where training saw a constant.

A batch norm's statistics follow the parts of a batch one after another: r <- (1 - m) r + m s. What
n parts each on W ranks make of them is therefore, of the ranks' own r_i that all began with r_0,

    (1-m)^(nW) r_0 + sum_i (1-m)^(n(W-1-i)) (r_i - (1-m)^n r_0),

which is one sum over ranks: exact, but for rounding.
"""

import contextlib
from collections.abc import Iterator
from typing import Protocol

import torch
from torch import Tensor, nn

from mtl_bench.core.ranks import Ranks

Norm = nn.modules.batchnorm._BatchNorm
CONSTANT = 1e-6  # variance, of eps: what comes out of the norm varies by less than a thousandth


class Modules(Protocol):
    def modules(self) -> Iterator[nn.Module]: ...


def _norms(model: Modules) -> list[Norm]:
    return [m for m in model.modules() if isinstance(m, Norm)]


@contextlib.contextmanager
def frozen_statistics(model: Modules) -> Iterator[None]:
    """Training mode whose batch norms leave their running statistics alone."""
    norms = _norms(model)
    tracked = [m.track_running_stats for m in norms]
    for norm in norms:
        norm.track_running_stats = False
    try:
        yield
    finally:
        for norm, value in zip(norms, tracked, strict=True):
            norm.track_running_stats = value


@contextlib.contextmanager
def common_statistics(model: Modules, ranks: Ranks) -> Iterator[None]:
    """Every rank's batch norms after it are as if one rank had seen all parts that passed inside.

    Raises:
        ValueError: a batch norm without momentum, whose statistics are means over all steps.
    """
    if ranks.size == 1:
        yield
        return
    before = [_Seen(norm) for norm in _norms(model) if norm.num_batches_tracked is not None]
    yield
    moved = [(was, now) for was in before if (now := _Seen(was.norm)).parts != was.parts]
    if not moved:
        return
    terms = [_term(was, now, ranks) for was, now in moved]
    merged = ranks.sum_(torch.cat(terms)).split([len(term) for term in terms])
    for (was, now), value in zip(moved, merged, strict=True):
        now.set(value, was.parts + (now.parts - was.parts) * ranks.size)


@contextlib.contextmanager
def mean_statistics(model: Modules, ranks: Ranks) -> Iterator[None]:
    """After it, the batch norms that train have the means of all parts' statistics inside, of all
    ranks, in place of running ones, which are mostly of the last 1 / momentum parts.

    Source: "precise BN" of Wu, Johnson, Rethinking "Batch" in BatchNorm, arXiv:2105.07576, 3.
    """
    norms = [norm for norm in _norms(model) if norm.training and norm.running_mean is not None]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # torch's word for a mean
    yield
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    if ranks.size == 1 or not norms:
        return
    seen = [_Seen(norm) for norm in norms]
    means = ranks.sum_(torch.cat([one.value for one in seen])) / ranks.size
    for one, mean in zip(seen, means.split([len(one.value) for one in seen]), strict=True):
        one.set(mean, one.parts * ranks.size)


def silence_constants(model: Modules) -> int:
    """Give scale 0 to what the batch norms that train have seen as constant for long.

    A depthwise convolution behind a silent ReLU has one value, and its running variance shrinks to
    nothing. An image that wakes the ReLU comes out of the norm 1 / sqrt(eps) = 300 times as large,
    and drowns all other channels. On what training has seen, scale 0 changes nothing.

    Returns:
        How many channels it was.
    """
    silenced = 0
    for norm in _norms(model):
        if norm.training and norm.affine and norm.running_var is not None:
            constant_C = norm.running_var < CONSTANT * norm.eps
            norm.weight.data.masked_fill_(constant_C, 0)
            silenced += int(constant_C.sum())
    return silenced


class _Seen:
    """A batch norm's statistics as they are: mean and variance side by side, in float64."""

    def __init__(self, norm: Norm) -> None:
        assert norm.num_batches_tracked is not None
        self.norm, self.parts = norm, int(norm.num_batches_tracked)
        self.value = torch.cat([buffer.double() for buffer in self._buffers()])

    def _buffers(self) -> tuple[Tensor, Tensor]:
        assert self.norm.running_mean is not None
        assert self.norm.running_var is not None
        return self.norm.running_mean, self.norm.running_var

    def set(self, value: Tensor, parts: int) -> None:
        for buffer, new in zip(self._buffers(), value.chunk(2), strict=True):
            buffer.data.copy_(new)  # `.data`: a backward pass that is still to come has seen them
        assert self.norm.num_batches_tracked is not None
        self.norm.num_batches_tracked.fill_(parts)


def _term(was: _Seen, now: _Seen, ranks: Ranks) -> Tensor:
    """What this rank adds to the sum."""
    momentum, parts = was.norm.momentum, now.parts - was.parts
    if momentum is None:
        raise ValueError("a batch norm with momentum None does not train on several ranks")
    kept = (1 - momentum) ** parts
    own = kept ** (ranks.size - 1 - ranks.rank) * (now.value - kept * was.value)
    return own + kept**ranks.size * was.value if ranks.first else own
