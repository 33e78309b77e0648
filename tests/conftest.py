"""What several test files share: a small rendered data set and the smoke recipe's cell."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

os.environ["HF_HUB_OFFLINE"] = "1"  # nothing may be downloaded in a test

from mtl_bench.core.config import Cell, load_recipe

SHARED = Path(__file__).resolve().parents[2] / "shared"  # real samples; not in a public clone


def pytest_collection_modifyitems(items):
    """What needs a GPU is skipped without one; `gpu.sh --cpu-rehearsal` runs some of it all the
    same."""
    if torch.cuda.is_available() or "MTL_BENCH_REHEARSAL" in os.environ:
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="needs a GPU"))


@pytest.fixture
def device() -> torch.device:
    """Of a test marked `cuda`; the CPU in a rehearsal."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(autouse=True)
def as_at_the_start():
    """Signals and threads are the process's own: what runs inside a test leaves them as they were.

    Ctrl-C interrupts in every test, also where pytest itself was started in the background.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    threads = torch.get_num_threads()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def smoke_root(tmp_path_factory) -> Path:
    """The smoke recipe's data set, rendered once."""
    from mtl_bench.data import scenes as synthetic

    return synthetic.ensure(
        load_recipe("smoke").data, tmp_path_factory.mktemp("data") / "smoke", progress=False
    )


@pytest.fixture
def smoke_cell() -> Cell:
    return Cell(load_recipe("smoke"), backbone="tiny", method="fixed_uncertainty")


@pytest.fixture
def change_harness(monkeypatch):
    """Make the harness look edited, for some stages or all."""
    from mtl_bench.bench import jobs
    from mtl_bench.core import provenance

    real = provenance.fingerprints

    def change(*stages: str) -> None:
        def other(stage, roots):
            edited = {"harness": "edited"} if stage in stages or not stages else {}
            return real(stage, roots) | edited

        for module in (provenance, jobs):
            monkeypatch.setattr(module, "fingerprints", other)

    return change


@pytest.fixture
def with_optim():
    """Change optimiser settings of a cell."""

    def change(cell: Cell, **settings) -> Cell:
        return replace(
            cell, recipe=replace(cell.recipe, optim=replace(cell.recipe.optim, **settings))
        )

    return change
