"""The report's figures of what was measured: one column against another, quality per class."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mtl_bench.core.labels import LabelSet
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.report.columns import BY_NAME, Column
from mtl_bench.report.groups import SMOKE, Group
from mtl_bench.report.style import BASELINE, GRAY, MANY, Look, looks, save, styled
from mtl_bench.report.tables import Table

RINGS = (10, 14, 20, 27, 35, 45, 57, 70)  # distances of a number from its point, in points
ANGLES = [math.radians(a) for a in range(45, 405, 30)]
ROOM = 9.5  # around a number, in points
CLASS = re.compile(r"panoptic\.class\.(.+)\.pq")


def against(table: Table, y: str, x: str, out_dir: Path) -> str | None:
    """`<y>_<x>`: two columns against each other, one marker per group with its spread.

    Returns:
        What the figure shows in words, or None where no group has both numbers, or where the
        differences in speed are noise, since all groups have the same network.
    """
    groups = [g for g in table.groups if g.entries[y].count and g.entries[x].count]
    sizes = {group.entries["params_m"].mean for group in groups}
    if not groups or (x == "fps" and len(groups) > 1 and len(sizes) == 1):
        return None
    down, across = BY_NAME[y], BY_NAME[x]
    many = len(groups) > MANY
    with styled():
        figure = Figure(figsize=(9.2, 4.8) if many else (6.4, 3.6), layout="constrained")
        axes = figure.add_subplot()
        handles: list[Any] = []
        spots = {}
        for number, (group, look) in enumerate(looks_of(table), 1):
            if group in groups:
                spots[number] = (group.entries[x].mean, group.entries[y].mean)
                _point(axes, group, across, down, look)
                label = f"{number} " * many + f"{group.label} (n={len(group.rows)})"
                handles.append(Line2D([], [], linestyle="", label=label, **_marker(group, look)))
        if x == "fps" and table.baseline and table.baseline.entries[y].count:
            level = table.baseline.entries[y].mean
            handles.append(axes.axhline(level, label="trivial predictor", **BASELINE))
        where = f"\n{_where_timed(groups)}" if x == "fps" else ""
        axes.set_xlabel(f"{_with_unit(across)} ({_better(across)} is better){where}")
        axes.set_ylabel(f"{_with_unit(down)}\n({_better(down)} is better)")
        axes.margins(0.12)
        watermark(axes, table)
        style: dict[str, Any] = {"ncols": 2, "fontsize": 7.5, "columnspacing": 1} if many else {}
        figure.legend(handles=handles, loc="outside right upper", **style)
        if many:
            _number(axes, spots)
        save(figure, out_dir, f"{y}_{x}")
    if many:
        return f"{down.title} against {across.title}; the numbers are those of the legend."
    points = "; ".join(
        f"{g.label} {_short(g, down)} at {_short(g, across)} {across.title}" for g in groups
    )
    return f"{down.title} against {across.title}. {points}."


def classes(table: Table, out_dir: Path, labels: LabelSet = CITYSCAPES20) -> str | None:
    """`classes`: panoptic quality per class and group as a heat table."""
    values = {group.label: _class_quality(group) for group in table.groups}
    values = {label: quality for label, quality in values.items() if quality}
    found = {name for quality in values.values() for name in quality}
    names = [label.name for label in labels.labels if label.name in found]
    if not names:
        return None
    heat = np.array([[quality.get(n, math.nan) for n in names] for quality in values.values()])
    texts = [["-" if math.isnan(v) else f"{v:.0f}" for v in line] for line in heat]
    heat_table(
        table, (list(values), names), heat, texts, ("Blues", 0, 100, "PQ, %"), out_dir, "classes"
    )
    return "Panoptic quality per class, mean over seeds; only classes that occur in the split."


def heat_table(
    table: Table,
    titles: tuple[Sequence[str], Sequence[str]],
    heat: NDArray[np.floating],
    texts: Sequence[Sequence[str]],
    scale: tuple[str, float, float, str],
    out_dir: Path,
    name: str,
) -> None:
    """Numbers on their colours.

    Args:
        titles: of the rows and of the columns.
        heat: [rows, columns]; NaN is white.
        scale: colour map, its lowest and highest value, and what they are.
    """
    rows, columns = titles
    colors, low, high, what = scale
    with styled():
        figure = Figure(figsize=(9.2, 1.35 + 0.3 * len(rows)), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(False)
        image = axes.imshow(heat, cmap=colors, vmin=low, vmax=high, aspect="auto")
        axes.set_xticks(
            range(len(columns)), columns, rotation=40, ha="right", rotation_mode="anchor"
        )
        axes.set_yticks(range(len(rows)), rows)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        for (y, x), value in np.ndenumerate(heat):
            dark = not math.isnan(value) and sum(image.to_rgba(value)[:3]) < 1.6
            color = "white" if dark else "black"
            axes.text(x, y, texts[y][x], ha="center", va="center", color=color, fontsize=8)
        figure.colorbar(image, ax=axes, label=what, pad=0.01, fraction=0.03)
        if table.smoke:
            axes.set_title(SMOKE, color="#a40000")
        save(figure, out_dir, name)


# --- parts ----------------------------------------------------------------------------------------


def looks_of(table: Table) -> list[tuple[Group, Look]]:
    """A group's look is its identity's, whatever its status."""
    found = looks(dict.fromkeys(group.identity for group in table.groups))
    return [(group, found[group.identity]) for group in table.groups]


def _with_unit(column: Column) -> str:
    return f"{column.title}, {column.note}" if column.note else column.title


def _better(column: Column) -> str:
    return "higher" if column.better > 0 else "lower"


def _short(group: Group, column: Column) -> str:
    return f"{group.entries[column.name].mean:.{column.digits}f}"


def _point(axes: Axes, group: Group, across: Column, down: Column, look: Look) -> None:
    x, y = group.entries[across.name], group.entries[down.name]
    axes.errorbar(
        x.mean,
        y.mean,
        xerr=None if math.isnan(x.std) else x.std,
        yerr=None if math.isnan(y.std) else y.std,
        linestyle="",
        elinewidth=1.2,
        capsize=2.5,
        **_marker(group, look),
    )


def _number(axes: Axes, spots: Mapping[int, tuple[float, float]]) -> None:
    """A number beside each point, at the nearest place that is free of points and numbers."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # settles the limits and the layout
    to_points = 72 / figure.dpi
    taken = list(axes.transData.transform(np.array(list(spots.values()))) * to_points)
    for number, own in zip(spots, taken.copy(), strict=True):
        offsets = [r * np.array([math.cos(a), math.sin(a)]) for r in RINGS for a in ANGLES]
        rooms = [min(np.hypot(*(own + o - t)) for t in taken) for o in offsets]
        free = (i for i, room in enumerate(rooms) if room >= ROOM)
        offset = offsets[next(free, int(np.argmax(rooms)))]
        taken.append(own + offset)
        far = np.hypot(*offset) > RINGS[0]
        axes.annotate(
            str(number),
            spots[number],
            tuple(offset),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=7,
            arrowprops={"arrowstyle": "-", "color": GRAY, "linewidth": 0.5} if far else None,
        ).set_in_layout(False)


def _marker(group: Group, look: Look) -> dict[str, Any]:
    """Hollow for stale numbers."""
    face = "white" if group.status == "stale" else look.color
    return {
        "marker": look.marker,
        "color": look.color,
        "markerfacecolor": face,
        "markersize": 7,
        "markeredgewidth": 1.5,
    }


def _where_timed(groups: Sequence[Group]) -> str:
    rows = [row.get("metric", {}) for group in groups for row in group.rows]
    sizes = sorted(
        {f"{r['latency.height']}x{r['latency.width']}" for r in rows if "latency.height" in r}
    )
    devices = sorted({str(r["latency.device"]) for r in rows if "latency.device" in r})
    threads = sorted({int(r["latency.threads"]) for r in rows if "latency.threads" in r})
    counts = [f"{n} thread{'s' * (n > 1)}" for n in threads]
    return ", ".join(["batch 1", *sizes]) + "\n" + ", ".join([*devices, *counts])


def _class_quality(group: Group) -> dict[str, float]:
    """Percent per class, mean over the group's seeds."""
    per_seed = []
    for row in group.rows:
        found = {CLASS.fullmatch(key): value for key, value in row.get("metric", {}).items()}
        per_seed.append({m[1]: v for m, v in found.items() if m and v is not None})
    return {str(k): float(v) for k, v in pd.DataFrame(per_seed, dtype=float).mean().items()}


def watermark(axes: Axes, table: Table) -> None:
    if table.smoke:
        axes.text(
            0.5,
            0.5,
            SMOKE,
            transform=axes.transAxes,
            ha="center",
            va="center",
            rotation=15,
            color=GRAY,
            alpha=0.45,
            fontsize=13,
        )
