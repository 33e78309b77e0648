"""What several test files share: a small rendered data set and the smoke recipe's cell."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

os.environ["HF_HUB_OFFLINE"] = "1"  # nothing may be downloaded in a test

from mtl_bench.config import Cell, load_recipe

SHARED = Path(__file__).resolve().parents[2] / "shared"  # real samples; not in a public clone


@pytest.fixture(autouse=True)
def own_signal_handlers():
    """A cell that runs inside a test takes signals; the next test gets its own again."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def smoke_root(tmp_path_factory) -> Path:
    """The smoke recipe's data set, rendered once."""
    from mtl_bench.data import synthetic

    return synthetic.ensure(
        load_recipe("smoke").data, tmp_path_factory.mktemp("data") / "smoke", progress=False
    )


@pytest.fixture
def smoke_cell() -> Cell:
    return Cell(load_recipe("smoke"), backbone="tiny", method="fixed_uncertainty")


@pytest.fixture
def with_optim():
    """Change optimiser settings of a cell."""

    def change(cell: Cell, **settings) -> Cell:
        return replace(
            cell, recipe=replace(cell.recipe, optim=replace(cell.recipe.optim, **settings))
        )

    return change
