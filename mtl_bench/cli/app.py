"""The command line: what the commands are, and what an error, an interruption or a bug becomes.

Exit codes: 0 done, 1 some cell failed, 2 wrong usage or bad input (one line says what), 75
another process is at it, 130 interrupted. Commands import what they need inside, so that help and
lists come at once.
"""

import errno
import io
import os
import signal
import sys
import traceback
from types import FrameType
from typing import Any, NoReturn

import typer

from mtl_bench.cli import (
    cell,
    collect,
    data,
    deploy,
    figure,
    grid,
    help,
    look,
    predict,
    pseudo,
    score,
)
from mtl_bench.core.locks import CLAIMED, ClaimedError
from mtl_bench.core.ranks import LostError

TRACEBACK = "MTL_BENCH_TRACEBACK"  # set: errors come with their traceback
# Threads that wait for each other give their core back soon: spinning long, one busy process beside
# a training of two threads made it 80 times slower. Read when torch is loaded.
SPIN = {"GOMP_SPINCOUNT": "1000", "KMP_BLOCKTIME": "1"}
# no space, over quota, over the size of a file, read-only
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
NAMES = (errno.ENAMETOOLONG, errno.ELOOP)  # a path that is none
USERS = (FileNotFoundError, PermissionError, NotADirectoryError, IsADirectoryError)


class Group(help.Group):
    """Turns what a user can cause into one line and an exit code; a bug keeps its traceback."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            typer.echo(f"interrupted{f': {stop}' if str(stop) else ''}", err=True)
            raise typer.Exit(130) from None
        except ClaimedError as error:
            typer.echo(f"mtl-bench: {error}", err=True)
            raise typer.Exit(CLAIMED) from None
        except LostError as error:
            typer.echo(f"mtl-bench: {error}", err=True)
            raise typer.Exit(1) from None
        except SystemExit as stop:  # commands end by `typer.Exit`
            typer.echo(f"mtl-bench: a plug-in has called sys.exit({stop.code!r})", err=True)
            raise typer.Exit(1) from None
        except (ValueError, OSError, FloatingPointError) as error:  # the last: training blew up
            if isinstance(error, OSError) and not _is_users(error):
                raise
            if os.environ.get(TRACEBACK):
                traceback.print_exc()
            typer.echo(f"mtl-bench: {one_line(error)}", err=True)
            raise typer.Exit(2) from None


app = help.App(Group, name="mtl-bench", epilog="Example: mtl-bench ablate --grid backbones")
for module in (grid, collect, cell, score, pseudo, predict, figure, deploy, data, look):
    module.register(app)


@app.callback()
def about() -> None:
    """Benchmark multi-task learning methods and backbones for driving scenes."""


def main() -> None:
    """The console script; SIGTERM and a closed terminal are interruptions like Ctrl-C."""
    for name, value in SPIN.items():
        os.environ.setdefault(name, value)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # a file's name goes out as it is
    for number in (signal.SIGTERM, signal.SIGUSR1):  # the latter: a queue's time limit is near
        signal.signal(number, _interrupt)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _interrupt)  # under nohup it is ignored, and stays so
    app(prog_name="mtl-bench")
    sys.exit(0)


def one_line(error: Exception) -> str:
    """An error's message on one line; of an operating-system error, what and which file."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


def _is_users(error: OSError) -> bool:
    return isinstance(error, USERS) or error.errno in (*FULL, *NAMES)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt(signal.Signals(number).name)
