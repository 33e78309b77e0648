"""One whole batch on several ranks: what is of the whole batch is made of all ranks' samples.

Each rank sends its own samples through the network, where batch norms normalise by the moments of
all ranks' samples, forwards and backwards. The maps that come out are joined to those of the whole
batch, and every rank computes all losses of that: whatever a loss divides by or ranks is therefore
the batch's, and no task knows of it. Others' samples are plain values; a backward pass reaches a
rank's own, and the ranks' gradients add up to the batch's.

Ranks meet inside of passes, so all run the same passes in the same order.

Shapes: W ranks, b samples of each, C channels.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.overrides import TorchFunctionMode

from mtl_bench.core.batch import Batch
from mtl_bench.core.ranks import Ranks
from mtl_bench.core.task import Maps
from mtl_bench.model.layers import full


def whole(own: Batch, ranks: Ranks) -> Batch:
    """All ranks' samples, by rank."""
    names = [name for names in ranks.gather(own.names) for name in names]
    return dataclasses.replace(own.map(ranks.join), names=names)


def joined(maps_of: Mapping[str, Maps], own: Batch, ranks: Ranks) -> dict[str, Maps]:
    """Every task's maps [b,...] as those of the whole batch [W*b,...].

    Raises:
        ValueError: a map that is not one of each sample.
    """
    for task, maps in maps_of.items():
        for name, map_ in maps.items():
            if map_.shape[:1] != (len(own.names),):
                raise ValueError(
                    f"recipe.optim.one_batch: map '{name}' of task '{task}' is {[*map_.shape]}, "
                    f"where ranks need one of each of {len(own.names)} samples to join"
                )
    return {
        task: {name: _Joined.apply(map_, ranks) for name, map_ in maps.items()}
        for task, maps in maps_of.items()
    }


class _Joined(torch.autograd.Function):
    """All ranks' tensors along the first axis."""

    @staticmethod
    def forward(ctx: Any, own: Tensor, ranks: Ranks) -> Tensor:
        ctx.start, ctx.length = ranks.rank * len(own), len(own)
        return ranks.join(own)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad.narrow(0, ctx.start, ctx.length), None


# --- batch norms ----------------------------------------------------------------------------------


class Synchronised(TorchFunctionMode):
    """Inside, every batch norm that normalises by its batch does by that of all ranks.

    It takes the place of the function behind all such modules, so that what a module does beside
    it, such as an activation, stays the module's.
    """

    def __init__(self, ranks: Ranks) -> None:
        super().__init__()
        self.ranks = ranks

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        if func is F.batch_norm:
            return self._batch_norm(*args, **(kwargs or {}))
        return func(*args, **(kwargs or {}))

    def _batch_norm(
        self,
        x: Tensor,
        running_mean: Tensor | None,
        running_var: Tensor | None,
        weight: Tensor | None = None,
        bias: Tensor | None = None,
        training: bool = False,
        momentum: float = 0.1,
        eps: float = 1e-5,
    ) -> Tensor:
        if not training:
            return F.batch_norm(x, running_mean, running_var, weight, bias, False, momentum, eps)
        with torch.no_grad():
            mean_C, var_C, count = _moments(x, self.ranks)
            if running_mean is not None:
                running_mean.lerp_(mean_C.to(running_mean), momentum)
            if running_var is not None:
                unbiased_C = var_C * (count / (count - 1))
                running_var.lerp_(unbiased_C.to(running_var), momentum)
        found: Tensor = _Normalised.apply(x, weight, bias, mean_C, var_C, count, eps, self.ranks)
        return found


def _moments(x: Tensor, ranks: Ranks) -> tuple[Tensor, Tensor, Tensor]:
    """Mean [C], biased variance [C] and count of all ranks' values, in float64.

    Chan, Golub, LeVeque, "Updating formulae and a pairwise algorithm for computing sample
    variances" (1979): of each rank's own, nothing is squared that is not centred.
    """
    var_C, mean_C = torch.var_mean(full(x), _axes(x), correction=0)
    number = var_C.new_full((1,), x.numel() // len(var_C), dtype=torch.float64)
    of_all = ranks.join(torch.cat([mean_C.double(), var_C.double(), number])[None])
    count_W1, (mean_WC, var_WC) = of_all[:, -1:], of_all[:, :-1].chunk(2, 1)
    count = count_W1.sum()
    mean_C = (count_W1 * mean_WC).sum(0) / count
    var_C = (count_W1 * (var_WC + (mean_WC - mean_C).square())).sum(0) / count
    return mean_C, var_C, count


def _axes(x: Tensor) -> list[int]:
    """All but the channels'."""
    return [axis for axis in range(x.dim()) if axis != 1]


class _Normalised(torch.autograd.Function):
    """w (x - m) / sqrt(v + eps) + b, where m and v are of all ranks' x.

    With c = x - m, r = 1 / sqrt(v + eps), g the gradient of the result and means over all ranks:
    that of x is w r (g - mean(g) - c r^2 mean(g c)). Those of w and b are a rank's own share.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor | None,
        bias: Tensor | None,
        mean_C: Tensor,
        var_C: Tensor,
        count: Tensor,
        eps: float,
        ranks: Ranks,
    ) -> Tensor:
        dtype = torch.promote_types(x.dtype, torch.float32)
        scale_C = (var_C + eps).rsqrt().to(dtype)
        mean_C, var_C = mean_C.to(dtype), var_C.to(dtype)
        ctx.save_for_backward(x, weight, mean_C, scale_C, count.to(dtype))
        ctx.ranks = ranks
        return F.batch_norm(x, mean_C, var_C, weight, bias, False, 0.0, eps)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, mean_C, scale_C, count = ctx.saved_tensors
        shape = [-1 if axis == 1 else 1 for axis in range(x.dim())]
        grad_, centred = full(grad), full(x) - mean_C.view(shape)
        sums_2C = torch.stack([grad_.sum(_axes(x)), (grad_ * centred).sum(_axes(x))])
        of_x = of_weight = of_bias = None
        if ctx.needs_input_grad[1]:
            of_weight = sums_2C[1] * scale_C
        if ctx.needs_input_grad[2]:
            of_bias = sums_2C[0].clone()
        if ctx.needs_input_grad[0]:
            mean_2C = ctx.ranks.sum_(sums_2C) / count
            slope = (mean_2C[1] * scale_C.square()).view(shape)
            factor_C = scale_C if weight is None else scale_C * weight
            of_x = (grad_ - mean_2C[0].view(shape) - centred * slope) * factor_C.view(shape)
        return of_x, of_weight, of_bias, None, None, None, None, None
