"""The page: table, figures and protocol in one HTML file that needs nothing but itself."""

import base64
import contextlib
import re
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from mtl_bench.report.protocol import Protocol
from mtl_bench.report.table import Section, Table, pretty

TEMPLATE = "page.html.j2"
PAGE = "index.html"
MADE = (".png", ".svg", ".csv")


@dataclass(frozen=True)
class Figure:
    """A drawn figure: its files' stem, heading and what it shows."""

    name: str
    heading: str
    caption: str
    wide: bool = False  # it takes the page's width


@dataclass(frozen=True)
class Page:
    """What stands around a table."""

    kind: str  # grid | latency | literature: the style's
    title: str  # of the window
    heading: str
    about: Markup
    command: str  # what makes it again
    banner: str = ""
    lacking: str = "Without numbers"
    nothing: str = ""  # said where the table has no section
    figures: Sequence[Figure] = ()
    aside: str | Section = ""  # behind the figures
    protocol: Protocol | None = None
    of: str = "lines"  # what may differ in the protocol
    same: str = "The same numbers"  # as in the files beside the page
    files: Sequence[str] = ()  # beside the tables
    counted: Sequence[Section] = ()
    folded: Section | None = None


def render(page: Page, table: Table, folder: Path) -> str:
    """The page's HTML; the figures' files are read from the folder."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    drawn = [(figure, inline(folder, figure)) for figure in page.figures]
    values: dict[str, Any] = {"page": page, "table": table, "figures": drawn, "pretty": pretty}
    return environment.get_template(TEMPLATE).render(values) + "\n"


def figures_of(headings: dict[str, str], captions: dict[str, str | None]) -> list[Figure]:
    """Those that were drawn, in the headings' order."""
    drawn = ((stem, heading, captions.get(stem)) for stem, heading in headings.items())
    return [Figure(stem, heading, caption) for stem, heading, caption in drawn if caption]


@contextlib.contextmanager
def beside(out_dir: Path, figures: Collection[str] = ()) -> Iterator[Path]:
    """A folder to build in, whose files take their places in `out_dir` when the block ends.

    If it fails, all there stays as it is.

    Args:
        figures: stems, which may stand behind a name and `-`; those that an earlier build made and
            this one did not go.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".new-", dir=out_dir) as folder:
        built = Path(folder)
        yield built
        for path in list(out_dir.iterdir()):
            ours = path.stem.rpartition("-")[2] in figures and path.suffix in MADE
            if ours and not (built / path.name).exists():
                path.unlink()
        for path in sorted(built.iterdir()):
            path.replace(out_dir / path.name)


def inline(folder: Path, figure: Figure) -> Markup:
    """The SVG itself, or the PNG as a data URI where there is no SVG."""
    alternative = escape(figure.caption)
    svg = folder / f"{figure.name}.svg"
    if not svg.is_file():
        data = base64.b64encode((folder / f"{figure.name}.png").read_bytes()).decode()
        return Markup(f'<img src="data:image/png;base64,{data}" alt="{alternative}">')
    drawing = svg.read_text(encoding="utf-8")
    drawing = drawing[drawing.index("<svg") :]
    drawing = re.sub(r"<metadata>.*?</metadata>\s*", "", drawing, flags=re.DOTALL)
    # two figures may use the same ids: each gets names of its own
    drawing = re.sub(r'(\bid="|url\(#|href="#)', rf"\1{figure.name}-", drawing)
    return Markup(drawing.replace("<svg", f'<svg role="img" aria-label="{alternative}"', 1))
