"""How every figure looks: colours, markers, sizes, and files that are the same each time.

Colours are Okabe and Ito's (2008), told apart with every common colour-vision deficiency; a marker
and a line style of its own go with each, so that nothing hangs on colour alone.
"""

import io
import re
import sys
import warnings
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import matplotlib as mpl
from matplotlib.figure import Figure
from PIL import Image

MANY = 10  # lines of a table: a figure of more is drawn for many, with numbers or a long legend
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")
T = TypeVar("T", bound=Hashable)
BASELINE: dict[str, Any] = {"color": "#555555", "linestyle": (0, (1, 1.5)), "linewidth": 1.4}
GRAY = "#666666"
GLYPH = re.compile(r"Glyph (\d+) .* missing from")  # what matplotlib warns of, many times a figure
told: set[str] = set()  # letters that the figures lack

SETTINGS: dict[Any, Any] = {
    "svg.hashsalt": "mtl-bench",  # ids without randomness
    "svg.fonttype": "none",  # text stays text: small, searchable, read aloud
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
    "text.parse_math": False,  # a name with two $ is a name
}


@dataclass(frozen=True)
class Look:
    color: str
    marker: str
    dash: str


def looks(labels: Iterable[T]) -> dict[T, Look]:
    """A look per label, by its position: the same in every figure of a report.

    Colours come round after eight; from then on they go with other markers and dashes.
    """
    found = {}
    for i, label in enumerate(labels):
        turn = i + i // len(PALETTE)
        dash, marker = DASHES[turn % len(DASHES)], MARKERS[turn % len(MARKERS)]
        found[label] = Look(PALETTE[i % len(PALETTE)], marker, dash)
    return found


@contextmanager
def styled() -> Iterator[None]:
    with mpl.rc_context(), warnings.catch_warnings(record=True) as caught:
        mpl.rcdefaults()  # a user's matplotlibrc must not change a report
        mpl.rcParams.update(SETTINGS)
        yield
    lacking = set()
    for warning in caught:
        if glyph := GLYPH.match(str(warning.message)):
            lacking.add(chr(int(glyph[1])))
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    if lacking - told:
        font, letters = SETTINGS["font.family"], " ".join(sorted(lacking - told))
        print(f"PNG files show boxes for letters that {font} lacks: {letters}", file=sys.stderr)
    told.update(lacking)


def save(figure: Figure, out_dir: Path, name: str, pixels: bool = False) -> None:
    """`name.png`, small, since reports are committed, and `name.svg`; both without dates.

    Args:
        pixels: a picture of pixels, which are not scaled; it has no SVG.
    """
    drawn = io.BytesIO()
    dpi = figure.dpi if pixels else SETTINGS["savefig.dpi"]
    figure.savefig(drawn, dpi=dpi, format="png", metadata={"Software": None})
    # 256 colours: the commonest of a picture, the most different ones of thin lines
    choice = Image.Quantize.MEDIANCUT if pixels else Image.Quantize.MAXCOVERAGE
    image = Image.open(drawn).convert("RGB")
    image = image.quantize(256, choice, kmeans=1, dither=Image.Dither.NONE)
    image.save(out_dir / f"{name}.png", optimize=True)
    if not pixels:
        drawing = io.StringIO()
        figure.savefig(drawing, format="svg", metadata={"Date": None, "Creator": None})
        (out_dir / f"{name}.svg").write_text(drawing.getvalue(), encoding="utf-8", newline="\n")
