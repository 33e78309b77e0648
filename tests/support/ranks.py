"""Ranks of one cell as processes, started once, that do what a test asks of all of them."""

import contextlib
import multiprocessing
import socket
import traceback
from pathlib import Path

import torch

from mtl_bench.core.config import Cell, from_dict, load_recipe, override, to_dict
from mtl_bench.core.ranks import Processes
from support.training import scales_cell

STEPS = ["recipe.optim.steps=3", "recipe.optim.checkpoint_every=3", "recipe.optim.cosine_every=2"]


def serve(rank: int, size: int, port: int, connection) -> None:
    """What each process does: (function, arguments) in, its answer for this rank out."""
    torch.set_num_threads(1)
    with Processes(rank, size, rank, ("127.0.0.1", port)) as ranks:
        ranks.begin(torch.device("cpu"))
        connection.send(None)
        while (asked := connection.recv()) is not None:
            function, cell, arguments = asked
            try:
                connection.send((function(ranks, from_dict(Cell, cell), *arguments), ""))
            except Exception as error:
                traceback.print_exc()
                connection.send((None, f"{type(error).__name__}: {error}"))
        if not ranks.first:
            assert ranks.told() is None  # rank 0 is the first to leave


class Asked:
    """`asked(function, cell, ...)`: what every rank answers; `errors` is what each ended with."""

    def __init__(self, connections):
        self.connections = connections
        self.errors: list[str] = []

    def __call__(self, function, cell: Cell, *arguments, fails=False):
        for connection in self.connections:
            connection.send((function, to_dict(cell), arguments))
        answers = [connection.recv() for connection in self.connections]
        self.errors = [error for _, error in answers]
        assert fails or not any(self.errors), self.errors
        return [answer for answer, _ in answers]


@contextlib.contextmanager
def started(size: int):
    """So many ranks, ready to be asked."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in range(size)]
    processes = [
        context.Process(target=serve, args=(rank, size, port, pipes[rank][1]), daemon=True)
        for rank in range(size)
    ]
    for process in processes:
        process.start()
    for ours, _ in pipes:
        ours.recv()
    try:
        yield Asked([ours for ours, _ in pipes])
    finally:
        for ours, _ in pipes:
            ours.send(None)
        for process in processes:
            process.join(120)  # of a busy machine
            assert process.exitcode == 0


def trained(ranks, cell, root: Path, run_dir: Path, options=None) -> None:
    """Train a cell on these ranks, as `bench.run` does."""
    from mtl_bench.train.progress import Listening
    from support.training import run

    run_dir.mkdir(exist_ok=True)
    progress = None if ranks.first else Listening(run_dir, print)
    run(cell, root, run_dir, progress, ranks=ranks, **(options or {}))


def stopped(ranks, cell, root, run_dir) -> str:
    """Only the last rank hears a signal, in its second step."""
    from mtl_bench.train.progress import Interrupted, Listening
    from support.training import run

    class Asked(Listening):
        def update(self, stage, step, steps, note=""):
            self.stop_asked = step == 2 and not ranks.first

    run_dir.mkdir(exist_ok=True)
    try:
        run(cell, root, run_dir, Asked(run_dir, print), ranks=ranks)
    except Interrupted as stop:
        return str(stop)
    return "not stopped"


# --- small cells, of three steps, and what they leave ---------------------------------------------


def network_cell(method: str, *settings: str) -> Cell:
    cell = Cell(load_recipe("smoke"), "tiny", method)
    return override(cell, [*STEPS, "recipe.optim.micro_batch=2", *settings])


def trunk_cell(method: str, *settings: str) -> Cell:
    return override(scales_cell(method), [*STEPS, "recipe.optim.micro_batch=4", *settings])


def flat(value, place="") -> dict[str, torch.Tensor]:
    """Every number of a checkpoint, by its place in it."""
    if isinstance(value, dict):
        inner = value.items()
    elif isinstance(value, (list, tuple)):
        inner = enumerate(value)
    else:
        return {place: value if torch.is_tensor(value) else repr(value)}
    return {
        key: found for name, one in inner for key, found in flat(one, f"{place}/{name}").items()
    }
