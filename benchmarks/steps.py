"""Steps of our methods and of torchjd's over one shared network, for `methods_cost.py`.

torchjd runs `mtl_backward` and `jac_to_grad` on the same losses, representation and parameters, at
whichever of its settings proves fastest in the same run. What it only has as a weighting of two
batches' Jacobians (modo, sdmgrad) runs as its documentation does: their gradients of the decoders
are not computed, and the third batch has one weighted backward pass.
"""

import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.device import Compute
from mtl_bench.core.terms import Term, gather
from mtl_bench.data import scenes
from mtl_bench.data.loader import train_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.model import Model
from mtl_bench.train.backward import Pass, backward, reevaluate
from mtl_bench.train.loop import build, build_method

try:
    from torchjd import aggregation
    from torchjd.autojac import jac_to_grad, mtl_backward
except ImportError:
    aggregation = None  # nothing to compare with

Step = Callable[[], None]
BASE = "fixed"
LR = 1e-3  # for methods that look ahead
MOST = 3  # batches a step
SAMPLES = 16  # a batch of attributes

# Ours -> torchjd's, at our defaults where it has none; `K` losses.
AGGREGATORS: dict[str, Callable[[int], nn.Module]] = {
    "aligned": lambda K: aggregation.AlignedMTL(),
    "cagrad": lambda K: aggregation.CAGrad(c=0.4),
    "config": lambda K: aggregation.ConFIG(),
    "dualproj": lambda K: aggregation.DualProj(),
    "excess": lambda K: aggregation.ExcessMTL(),
    "fairgrad": lambda K: aggregation.FairGrad(alpha=1.0),
    "graddrop": lambda K: aggregation.GradDrop(),
    "gradvac": lambda K: aggregation.GradVac(),
    "imtl_g": lambda K: aggregation.IMTLG(),
    "mgda": lambda K: aggregation.MGDA(),
    "nash": lambda K: aggregation.NashMTL(n_tasks=K),
    "pcgrad": lambda K: aggregation.PCGrad(),
    "upgrad": lambda K: aggregation.UPGrad(),
}
TWO_BATCH_WEIGHTINGS: dict[str, Callable[[], nn.Module]] = {
    "modo": lambda: aggregation.MoDoWeighting(),
    "sdmgrad": lambda: aggregation.SDMGradWeighting(),
}


@dataclass(frozen=True)
class Setting:
    """How torchjd differentiates: rows at once (None: all), and a Gramian block by block or not."""

    chunk: int | None = 1
    blocks: bool = False

    def __str__(self) -> str:
        return f"parallel_chunk_size={self.chunk}, optimize_gramian_computation={self.blocks}"


SETTINGS = [Setting(chunk, blocks) for chunk in (None, 1) for blocks in (False, True)]


@dataclass
class Bench:
    """A model and batches that all methods share; nobody moves the parameters."""

    cell: Cell
    model: Model
    terms: tuple[Term, ...]
    forwards: list[Callable[[], Pass]]  # one a batch
    device: torch.device
    clock: Callable[[], float]

    def clear(self) -> None:
        for parameter in self.model.parameters():
            parameter.grad = None

    def losses(self, passed: Pass) -> list[Tensor]:
        return list(gather(passed.losses, self.terms).values())

    def wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def open_bench(
    granularity: str, device: torch.device, tasks: int | None = None, recipe: str = "small"
) -> Bench:
    """Args:
    tasks: so many attributes of random images in place of the recipe's two tasks.
    """
    return two_tasks(granularity, device, recipe) if tasks is None else many_tasks(tasks, device)


def two_tasks(granularity: str, device: torch.device, name: str) -> Bench:
    recipe = load_recipe(name)
    frames = 2 * recipe.data.stride + 1
    data = replace(recipe.data, train_scenes=16, val_scenes=4, frames=frames)
    cell = Cell(replace(recipe, data=data), "resnet18", BASE, granularity=granularity)
    model, method, _ = build(cell, Compute(device))
    model.train()
    samples = open_samples(cell.recipe, model.tasks, "train", scenes.ensure(data), training=True)
    for task in model.tasks:
        task.begin(samples.dataset)
    batches = itertools.islice(train_batches(samples, recipe.optim.batch, 0), MOST)
    return bench_of(cell, model, method.terms, batches, device)


def many_tasks(count: int, device: torch.device) -> Bench:
    """CelebA's network and so many of its attributes; what an image shows changes no time."""
    recipe = load_recipe("celeba-cnn9")
    data, names = recipe.data, recipe.tasks[:count]
    cell = Cell(recipe, recipe.backbone, BASE, tasks=names, granularity="tasks")
    model, method, _ = build(cell, Compute(device))
    model.train()
    draw = torch.Generator().manual_seed(0)

    def batch() -> Batch:
        shape = (SAMPLES, 3, data.height, data.width)
        truth = {task.field: torch.rand(SAMPLES, 1, generator=draw).round() for task in model.tasks}
        return Batch([""] * SAMPLES, torch.rand(shape, generator=draw), None, truth)

    return bench_of(cell, model, method.terms, [batch() for _ in range(MOST)], device)


def bench_of(
    cell: Cell,
    model: Model,
    terms: Sequence[Term],
    batches: Iterable[Batch],
    device: torch.device,
) -> Bench:
    def forward_of(batch: Batch) -> Callable[[], Pass]:
        def forward() -> Pass:
            outputs = model(batch)
            return Pass(model.losses(outputs, batch), outputs.representation)

        return forward

    forwards = [forward_of(batch.to(device)) for batch in batches]
    alone = device.type == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if alone else time.perf_counter
    return Bench(cell, model, tuple(terms), forwards, device, clock)


# --- steps ----------------------------------------------------------------------------------------


def our_step(bench: Bench, name: str) -> Step:
    method = build_method(replace(bench.cell, method=name), bench.terms).to(bench.device)
    batches = [[forward] for forward in bench.forwards[: method.batches]]

    def step() -> None:
        weighting = backward(method, batches, bench.model, lr=LR)
        if method.reevaluates:
            reevaluate(method, weighting.step, batches[0], bench.model)

    return step


def torchjd_step(bench: Bench, name: str, setting: Setting) -> Step:
    shared = list(bench.model.shared_parameters())
    own_K = own_parameters(bench)
    together = sum(map(len, own_K)) > len(set(itertools.chain(*own_K)))  # a decoder of two losses

    def jacobian(forward: Callable[[], Pass], own_K: Sequence[Sequence[nn.Parameter]]) -> None:
        passed = forward()
        mtl_backward(
            bench.losses(passed),
            features=passed.representation,
            tasks_params=own_K,
            shared_params=shared,
            retain_graph=together,
            parallel_chunk_size=setting.chunk,
        )

    if name in AGGREGATORS:
        aggregator = AGGREGATORS[name](len(bench.terms))
        blocks = isinstance(aggregator, aggregation.GramianWeightedAggregator) and setting.blocks

        def step() -> None:
            jacobian(bench.forwards[0], own_K)
            jac_to_grad(shared, aggregator, optimize_gramian_computation=blocks)

        return step
    weighting = TWO_BATCH_WEIGHTINGS[name]()

    def two_batches() -> None:
        J = []
        for forward in bench.forwards[:2]:
            jacobian(forward, [[] for _ in own_K])
            J.append(torch.cat([vars(parameter).pop("jac").flatten(1) for parameter in shared], 1))
        weight_K = weighting(J[0] @ J[1].T)
        (weight_K @ torch.stack(bench.losses(bench.forwards[2]()))).backward()

    return two_batches


def own_parameters(bench: Bench) -> list[list[nn.Parameter]]:
    """Of each loss, the parameters that it trains and that are not shared."""
    own = list(bench.model.task_parameters())
    found = []
    for loss in bench.losses(bench.forwards[0]()):
        grads = torch.autograd.grad(loss, own, retain_graph=True, allow_unused=True)
        found.append([p for p, grad in zip(own, grads, strict=True) if grad is not None])
    return found
