"""The page: table, figures and protocol in one HTML file that needs nothing but itself."""

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from mtl_bench.report import FIGURES, formats
from mtl_bench.report.columns import Row, flatten
from mtl_bench.report.groups import PSEUDO, SMOKE, Group, text
from mtl_bench.report.style import MANY
from mtl_bench.report.tables import SHOWN, Table

TEMPLATE = "page.html.j2"
SECTIONS = (  # title, dotted prefix of a row
    ("Evaluation", "protocol."),
    ("Data", "cell.recipe.data."),
    ("Network", "cell.recipe.network."),
    ("Training", "cell.recipe.optim."),
    ("Augmentation", "cell.recipe.augment."),
    ("Losses", "cell.recipe.loss."),
    ("Pseudo labels", f"cell.{PSEUDO}"),
    ("Post-processing", "cell.recipe.evaluate."),
    ("Environment", "env."),
)
TIMING = (
    "passes",
    "warmup",
    "images",
    "height",
    "width",
    "device",
    "precision",
    "threads",
    "clock",
)
COUNTED = ("failed", "fallback")  # dgc.*
WIDE = ("loss_curves", "weight_curves", "diagnostics", "classes", "samples", "extremes")


@dataclass(frozen=True)
class Figure:
    """A drawn figure: its files' stem, heading and what it shows."""

    name: str
    heading: str
    caption: str


def template(name: str) -> jinja2.Template:
    """A page's template of this folder; all pages include the same style and script."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(name)


def render(
    grid: Any,
    table: Table,
    rows: Sequence[Row],
    figures: Sequence[Figure],
    command: str,
    out_dir: Path,
) -> str:
    """The page's HTML; the figures' files are read from `out_dir`."""
    drawn = [(figure, inline(out_dir, figure)) for figure in figures]
    return (
        template(TEMPLATE).render(
            grid=grid,
            recipe=getattr(grid.recipe, "name", grid.recipe),
            table=table,
            figures=drawn,
            wide=FIGURES if len(table.groups) > MANY else WIDE,
            smoke=SMOKE,
            states=_states(rows),
            sections=protocol(table),
            counted=_counted(table),
            cells=_cells(rows),
            command=command,
            f=formats,
        )
        + "\n"
    )


def protocol(table: Table) -> list[tuple[str, list[tuple[str, str, bool]]]]:
    """How the numbers were made: sections of (name, value, whether the rows differ in it)."""
    flats = [flatten(row) for group in table.groups for row in group.rows]
    sections = [("Cells", _settings(flats, {"seed": "seed", **_CELL}))]
    for title, prefix in SECTIONS:
        # the video stage's settings are in every cell, but say something of its own cells only
        having = [f for f in flats if f.get("cell.video")] if PSEUDO in prefix else flats
        keys = dict.fromkeys(k for flat in having for k in flat if k.startswith(prefix))
        names = {key: key.removeprefix(prefix) for key in keys}
        sections.append((title, _settings(having, names)))
    timing = {f"metric.latency.{name}": name for name in TIMING}
    sections.append(
        ("Latency, batch 1, transfer and post-processing included", _settings(flats, timing))
    )
    return [(title, settings) for title, settings in sections if settings]


_CELL = {
    "cell.method": "method",
    "cell.backbone": "backbone",
    "cell.tasks": "tasks",
    "cell.single_task": "one network a task",
    "cell.video": "video stage",
    "cell.granularity": "what is weighed",
    "cell.pretrained": "pre-trained weights",
}


def _settings(
    flats: Sequence[Mapping[str, Any]], names: Mapping[str, str]
) -> list[tuple[str, str, bool]]:
    settings = []
    for key, name in names.items():
        values = list(dict.fromkeys(text(flat[key]) for flat in flats if key in flat))
        if values:
            settings.append((name, " | ".join(values), len(values) > 1))
    return settings


def _counted(table: Table) -> list[tuple[str, list[str]]]:
    """Images whose depth could not be scaled from the road, summed over a group's seeds."""
    lines = []
    for group in table.groups:
        values = [_sum(group, f"dgc.{name}") for name in COUNTED]
        if any(value is not None for value in values):
            lines.append((group.label, ["-" if v is None else f"{v:g}" for v in values]))
    return lines


def _sum(group: Group, key: str) -> float | None:
    values = [row.get("metric", {}).get(key) for row in group.rows]
    return sum(v for v in values if v is not None) if any(v is not None for v in values) else None


def _states(rows: Iterable[Row]) -> str:
    """`11 done, 1 failed`."""
    states = [str(row.get("status", "done")) for row in rows]
    order = dict.fromkeys((*SHOWN, *sorted(states)))
    return ", ".join(f"{states.count(state)} {state}" for state in order if state in states)


def _cells(rows: Sequence[Row]) -> list[list[str]]:
    """Every cell on its own: slug, seed, status, and the numbers that carry the table."""
    lines = []
    for row in rows:
        metric = row.get("metric", {})
        single = [formats.single(row, name) for name in ("pq", "miou", "abs_rel", "rmse", "fps")]
        state = str(row.get("status", "done")) + (" (smoke)" if row.get("smoke") else "")
        lines.append([str(row.get("slug", "")), text(row.get("seed", "")), state])
        lines[-1] += single if metric else ["-"] * len(single)
    return lines


# --- figures --------------------------------------------------------------------------------------


def inline(out_dir: Path, figure: Figure) -> Markup:
    """The SVG itself, or the PNG as a data URI where there is no SVG."""
    alternative = escape(figure.caption)
    svg = out_dir / f"{figure.name}.svg"
    if not svg.is_file():
        data = base64.b64encode((out_dir / f"{figure.name}.png").read_bytes()).decode()
        return Markup(f'<img src="data:image/png;base64,{data}" alt="{alternative}">')
    drawing = svg.read_text(encoding="utf-8")
    drawing = drawing[drawing.index("<svg") :]
    drawing = re.sub(r"<metadata>.*?</metadata>\s*", "", drawing, flags=re.DOTALL)
    # two figures may use the same ids: each gets names of its own
    drawing = re.sub(r'(\bid="|url\(#|href="#)', rf"\1{figure.name}-", drawing)
    return Markup(drawing.replace("<svg", f'<svg role="img" aria-label="{alternative}"', 1))
