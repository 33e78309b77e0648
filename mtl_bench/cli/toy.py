"""`figure toy`: every method's way over the field's toy, and how soon it arrives."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mtl_bench.cli import options as o

if TYPE_CHECKING:
    from mtl_bench.show import toy as problem


def toy(
    methods: Annotated[
        str,
        typer.Option(
            metavar="NAME,NAME,...", help="Which methods, by name; a+b is one.", show_default=False
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE.png|FILE.pdf",
            help="Where the paths go; the map of steps goes beside them, as FILE-steps.",
        ),
    ],
    lrs: Annotated[
        str, typer.Option(metavar="LR,LR,...", help="Learning rates of the map.")
    ] = "0.02,0.05,0.1,0.2",
    lr: Annotated[float, typer.Option("--lr", help="One of them, that paths are drawn at.")] = 0.05,
    steps: Annotated[
        int, typer.Option(min=100, help="At most. Published: 35000 at a learning rate of 0.001.")
    ] = 2500,
    jobs: Annotated[int, typer.Option(min=1, help="Methods at a time.")] = 2,
    dpi: Annotated[int, typer.Option("--dpi", help="Pixels an inch.")] = 200,
    plugins: o.PluginsOption = None,
) -> None:
    """The field's two-dimensional toy: every method's paths, and steps by learning rate."""
    from mtl_bench.core import plugins as found
    from mtl_bench.show.figures.printed import suffix_of, write
    from mtl_bench.show.figures.toy import paths, steps_map

    names = list(dict.fromkeys(filter(None, map(str.strip, methods.split(",")))))
    if not names:
        raise ValueError("--methods names no method: mtl-bench list methods")
    rates = [_rate(word) for word in lrs.split(",")]
    if lr not in rates:
        raise ValueError(f"--lr {lr:g} is not one of --lrs {lrs}")
    suffix_of(out)
    for name in names:
        for part in found.part_names(name):
            found.path_of("methods", part)
    walks = dict(zip(names, _walked(names, rates, steps, jobs), strict=True))
    second = out.with_stem(f"{out.stem}-steps")
    write(paths(walks, lr, dpi), out)
    write(steps_map(walks, steps, dpi), second)
    typer.echo(f"{out}\n{second}")


def _rate(word: str) -> float:
    try:
        found = float(word)
    except ValueError:
        found = 0.0
    if not 0 < found < 10:
        raise ValueError(f"--lrs: '{word}' is no learning rate above 0")
    return found


def _walked(
    names: list[str], rates: list[float], steps: int, jobs: int
) -> "list[dict[float, list[problem.Path]]]":
    """Each method's walks; a line to stderr when one is done."""
    import concurrent.futures
    import multiprocessing

    found = {}
    if jobs == 1:
        for name in names:
            found[name] = _walk(name, rates, steps)
            typer.echo(name, err=True)
    else:
        context = multiprocessing.get_context("spawn")
        pool = concurrent.futures.ProcessPoolExecutor(jobs, context)
        try:
            pending = {pool.submit(_walk, name, rates, steps): name for name in names}
            for done in concurrent.futures.as_completed(pending):
                found[pending[done]] = done.result()
                typer.echo(pending[done], err=True)
        finally:
            pool.shutdown(cancel_futures=True)  # a signal waits for the methods under way alone
    return [found[name] for name in names]


def _walk(name: str, rates: list[float], steps: int) -> "dict[float, list[problem.Path]]":
    import torch

    from mtl_bench.show import toy as problem
    from mtl_bench.train.compose import compose

    torch.set_num_threads(1)  # of tensors of two numbers
    return {
        rate: [
            problem.walk(compose(name, {}, problem.TERMS, seed=0), start, rate, steps)
            for start in problem.STARTS
        ]
        for rate in rates
    }
