"""How every figure looks: colours, markers, sizes, and files that are the same each time.

Colours are Okabe and Ito's (2008), told apart with every common colour-vision deficiency; a marker
and a line style of its own go with each, so that nothing hangs on colour alone.
"""

import io
import itertools
import re
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import matplotlib as mpl
from matplotlib.figure import Figure

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")
T = TypeVar("T", bound=Hashable)
BASELINE: dict[str, Any] = {"color": "#555555", "linestyle": (0, (1, 1.5)), "linewidth": 1.4}
GRAY = "#666666"
PATH = re.compile(r'\b(?:d|x|y)="[^"]*"')
DECIMALS = re.compile(r"-?\d+\.\d{2,}")

SETTINGS: dict[Any, Any] = {
    "svg.hashsalt": "mtl-bench",  # ids without randomness
    "svg.fonttype": "path",  # looks the same wherever it is opened
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 120,
    "path.simplify": True,
}


@dataclass(frozen=True)
class Look:
    color: str
    marker: str
    dash: str


def looks(labels: Iterable[T]) -> dict[T, Look]:
    """A look per label, by its position: the same in every figure of a report."""
    cycle = zip(
        itertools.cycle(PALETTE), itertools.cycle(MARKERS), itertools.cycle(DASHES), strict=False
    )
    return {label: Look(*look) for label, look in zip(labels, cycle, strict=False)}


@contextmanager
def styled() -> Iterator[None]:
    with mpl.rc_context():
        mpl.rcdefaults()  # a user's matplotlibrc must not change a report
        mpl.rcParams.update(SETTINGS)
        yield


def save(figure: Figure, out_dir: Path, name: str, pixels: bool = False) -> None:
    """`name.png` and `name.svg`, without dates; `pixels` are not scaled and have no SVG."""
    dpi = figure.dpi if pixels else SETTINGS["savefig.dpi"]
    figure.savefig(out_dir / f"{name}.png", dpi=dpi, metadata={"Software": None})
    if not pixels:
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        drawing = PATH.sub(_shorten, buffer.getvalue())
        (out_dir / f"{name}.svg").write_text(drawing, encoding="utf-8", newline="\n")


def _shorten(path: re.Match[str]) -> str:
    """A tenth of a point is finer than a line is wide; the file gets a third smaller."""
    return DECIMALS.sub(lambda number: f"{float(number[0]):.1f}", path[0])
