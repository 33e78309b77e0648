"""On a GPU the same as on the CPU: every engine, every method, a cell in every precision.

Marked `cuda`: `pytest -m cuda` on a machine that has one, as `benchmarks/gpu.sh` does.
"""

from dataclasses import replace
from functools import partial

import pytest
import torch
from small_networks import subject

from mtl_bench.bench import store
from mtl_bench.bench.run import run_cell
from mtl_bench.core import plugins
from mtl_bench.core.device import Compute
from mtl_bench.data.loader import train_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.deploy import engines, timer
from mtl_bench.train.backward import Pass, backward
from mtl_bench.train.loop import build

pytestmark = pytest.mark.cuda
METHODS = [about.name for about in plugins.describe("methods") if not about.error]
WRAPPERS = {"cr", "samo"}  # go before a gradient method
ENGINES = [
    pytest.param(name, precision, id=f"{name}-{precision}")
    for name in engines.names()
    if name != "compile"  # takes minutes; `benchmarks/gpu.sh` times it
    for precision in engines.facts(name).precisions.get("cuda", ())
]


@pytest.mark.parametrize(("name", "precision"), ENGINES)
def test_an_engine_agrees_with_the_plain_network(name, precision, device):
    given = subject()
    net = given.net.to(device)
    try:
        plan = timer.Plan(passes=4, batch=2, threads=1, compared=2, warmup=1)
        found = timer.row(replace(given, net=net), name, precision, device, plan)
    finally:
        net.cpu()  # other tests share it
    if found["status"] == "unavailable":
        pytest.skip(found["why"])
    assert (found["status"], found["why"]) == ("done", "")


@pytest.mark.parametrize("method", METHODS)
def test_a_method_decides_as_on_the_cpu(method, device, smoke_cell, smoke_root):
    name = f"{method}+mgda" if method in WRAPPERS else method
    cell = replace(smoke_cell, method=name)
    weights = []
    for place in (torch.device("cpu"), device):
        torch.manual_seed(0)
        torch.backends.cudnn.allow_tf32 = False
        model, made, _ = build(cell, Compute(place))
        model.train()
        samples = open_samples(cell.recipe, model.tasks, "train", smoke_root, training=True)
        for task in model.tasks:
            task.begin(samples.dataset)
        batches = train_batches(samples, cell.recipe.optim.batch, 0)

        def forward(batch, model):
            outputs = model(batch)
            return Pass(model.losses(outputs, batch), outputs.representation)

        drawn = [next(batches).to(place) for _ in range(made.batches)]
        parts = [[partial(forward, batch, model)] for batch in drawn]
        found = backward(made, parts, model, lr=1e-3)
        grads = [p.grad for p in model.parameters() if p.grad is not None]
        assert all(grad.device.type == place.type and grad.isfinite().all() for grad in grads)
        weights.append(found.weights)
    assert weights[1] == pytest.approx(weights[0], rel=0.05, abs=1e-3)


@pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
def test_a_cell_runs_from_data_to_row(
    precision, device, smoke_cell, smoke_root, tmp_path, with_optim
):
    cell = with_optim(smoke_cell, precision=precision, micro_batch=2)
    run_dir, _ = store.begin(cell, tmp_path)
    row = run_cell(cell, run_dir, smoke_root, device.type)
    assert row["metric"]["latency.clock"] == "CUDA events"
    assert row["metric"]["latency.precision"] == precision
    assert row["time"]["peak_mib"] > 0
