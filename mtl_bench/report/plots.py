"""The report's figures of what was measured: one column against another, a column per class.

A Pareto front has the points that no other point beats in both of two numbers.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.style import BASELINE, GRAY, MANY, Look, looks, save, styled
from mtl_bench.report.columns import capital
from mtl_bench.report.statistics import SMOKE, Group
from mtl_bench.report.table import NOTHING, number

if TYPE_CHECKING:
    from mtl_bench.report.grid import Results

RINGS = (10, 14, 20, 27, 35, 45, 57, 70)  # distances of a number from its point, in points
ANGLES = [math.radians(a) for a in range(45, 405, 30)]
ROOM = 9.5  # around a number, in points
FRONT: dict[str, Any] = {"color": GRAY, "linewidth": 1.2, "zorder": 1}
Point = tuple[float, float]


def against(results: "Results", y: Column, x: Column, out_dir: Path) -> str | None:
    """`<y>_<x>`: two columns against each other, one marker per group with its spread.

    Returns:
        What the figure shows in words, or None where no group has both numbers, or where the
        differences in speed are noise, since all groups have the same network.
    """
    groups = [g for g in results.groups if g.entries[y.name].count and g.entries[x.name].count]
    sizes = {group.entries["params_m"].mean for group in groups}
    if not groups or (x == FPS and len(groups) > 1 and len(sizes) == 1):
        return None
    many = len(groups) > MANY
    with styled():
        longest = max(len(group.label) for group in groups)
        across = max(1, min(5, 125 // (longest + 12)))  # of a legend below: 125 letters a line
        lines = math.ceil((len(groups) + 1) / across) if many else 0
        size = (9.2, 4.2 + 0.16 * lines) if many else (6.4, 3.6)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.add_subplot()
        handles: list[Any] = []
        spots = {}
        outside = _zoom(axes, groups, x, y) if many else []
        for index, (group, look) in enumerate(looks_of(results), 1):
            if group in groups:
                spots[index] = (group.entries[x.name].mean, group.entries[y.name].mean)
                if group not in outside:
                    _point(axes, group, x, y, look, 0.35 if many else 1.0)
                label = f"{index} " * many + f"{group.label} (n={len(group.rows)})"
                handles.append(Line2D([], [], linestyle="", label=label, **_marker(group, look)))
        if x == FPS and results.baseline and results.baseline.entries[y.name].count:
            level = results.baseline.entries[y.name].mean
            handles.append(axes.axhline(level, label="trivial predictor", **BASELINE))
        where = f"\n{_where_timed(groups)}" if x == FPS else ""
        axes.set_xlabel(f"{with_unit(x)} ({better(x)} is better){where}")
        axes.set_ylabel(f"{with_unit(y)}\n({better(y)} is better)")
        if not many:
            axes.margins(0.12)
        # those out of view are on the front, too, or beyond it
        plain = [spots[i] for i in spots if not results.groups[i - 1].mark] or [*spots.values()]
        spots = {i: s for i, s in spots.items() if results.groups[i - 1] not in outside}
        if len(plain) > 1:
            draw_front(axes, plain, (x.better, y.better))
            handles.append(Line2D([], [], label="Pareto front", **FRONT))
        watermark(axes, results)
        style: dict[str, Any] = {"loc": "outside right upper"}
        if many:
            style = {"loc": "outside lower center", "ncols": across, "fontsize": 7.5}
        figure.legend(handles=handles, **style)
        if many:
            _number(axes, spots)
        save(figure, out_dir, f"{y.name}_{x.name}")
    spread = any(g.entries[c.name].count > 1 for g in groups for c in (x, y))
    bars = " Bars: the sample standard deviation over seeds." * spread
    if many:
        far = [f"{g.label} {_short(g, y)} at {_short(g, x)}" for g in outside]
        more = f" Further out: {'; '.join(far)}." if far else ""
        return f"{y.title} against {x.title}; the numbers are those of the legend.{bars}{more}"
    points = "; ".join(f"{g.label} {_short(g, y)} at {_short(g, x)} {x.title}" for g in groups)
    return f"{y.title} against {x.title}. {points}.{bars}"


def classes(results: "Results", column: Column, out_dir: Path, name: str) -> str | None:
    """A column per class and group as a heat table.

    Its classes are where its key has them: `<task>.class.<name>.<metric>`.
    """
    values = {group.label: _per_class(group, column) for group in results.groups}
    values = {label: quality for label, quality in values.items() if quality}
    if not values:
        return None
    names = _merged(values.values())
    heat = np.array([[quality.get(n, math.nan) for n in names] for quality in values.values()])
    texts = [[NOTHING if math.isnan(v) else f"{v:.0f}" for v in line] for line in heat]
    high = 100 if column.unit == "%" else float(np.nanmax(heat))
    scale = ("Blues", 0.0, high, with_unit(column))
    heat_table(results, (list(values), names), heat, texts, scale, out_dir, name)
    what = capital(column.in_words)
    return f"{what} per class, mean over seeds; only classes that occur in the split."


def heat_table(
    results: "Results",
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
        if results.smoke:
            axes.set_title(SMOKE, color="#a40000")
        save(figure, out_dir, name)


# --- parts ----------------------------------------------------------------------------------------


def looks_of(results: "Results") -> list[tuple[Group, Look]]:
    """A group's look is its identity's, whatever its status."""
    found = looks(dict.fromkeys(group.identity for group in results.groups))
    return [(group, found[group.identity]) for group in results.groups]


def with_unit(column: Column) -> str:
    return f"{column.title}, {column.about}" if column.about else column.title


def better(column: Column) -> str:
    return "higher" if column.better > 0 else "lower"


def _short(group: Group, column: Column) -> str:
    return number(group.entries[column.name].mean, column)


def _point(
    axes: Axes, group: Group, across: Column, down: Column, look: Look, opaque: float
) -> None:
    x, y = group.entries[across.name], group.entries[down.name]
    axes.errorbar(
        x.mean,
        y.mean,
        xerr=None if math.isnan(x.std) else x.std,
        yerr=None if math.isnan(y.std) else y.std,
        linestyle="",
        elinewidth=1.2,
        ecolor=(look.color, opaque),
        capsize=2.5,
        **_marker(group, look),
    )


def _zoom(axes: Axes, groups: Sequence[Group], x: Column, y: Column) -> list[Group]:
    """Show the range of most groups; those that are out of view."""
    means = np.array([[group.entries[c.name].mean for c in (x, y)] for group in groups])
    (left, right), (low, high) = (middle(several, several) for several in means.T)
    across, up = 0.12 * (right - left) or 1.0, 0.12 * (high - low) or 1.0
    first, last = (left - across, low - up), (right + across, high + up)
    axes.set_xlim(first[0], last[0])
    axes.set_ylim(first[1], last[1])
    shown = np.all((means >= first) & (means <= last), axis=1)
    return [group for group, inside in zip(groups, shown, strict=True) if not inside]


def _number(axes: Axes, spots: Mapping[int, tuple[float, float]]) -> None:
    """A number beside each point, at the nearest place that is free of points and numbers."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # settles the limits and the layout
    to_points = 72 / figure.dpi
    taken = list(axes.transData.transform(np.array(list(spots.values()))) * to_points)
    for label, own in zip(spots, taken.copy(), strict=True):
        offsets = [r * np.array([math.cos(a), math.sin(a)]) for r in RINGS for a in ANGLES]
        rooms = [min(np.hypot(*(own + o - t)) for t in taken) for o in offsets]
        free = (i for i, room in enumerate(rooms) if room >= ROOM)
        offset = offsets[next(free, int(np.argmax(rooms)))]
        taken.append(own + offset)
        far = np.hypot(*offset) > RINGS[0]
        axes.annotate(
            str(label),
            spots[label],
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


def _per_class(group: Group, column: Column) -> dict[str, float]:
    """Mean over the group's seeds, in the column's unit."""
    task, _, metric = column.key.rpartition(".")
    key = re.compile(rf"{re.escape(task)}\.class\.(.+)\.{re.escape(metric)}")
    per_seed = []
    for row in group.rows:
        found = {key.fullmatch(name): value for name, value in row.get("metric", {}).items()}
        per_seed.append({m[1]: v * column.scale for m, v in found.items() if m and v is not None})
    return {str(k): float(v) for k, v in pd.DataFrame(per_seed, dtype=float).mean().items()}


def _merged(several: Iterable[Iterable[str]]) -> list[str]:
    """All names, each behind the one that it follows where it first occurs."""
    found: list[str] = []
    for names in several:
        place = 0
        for name in names:
            if name not in found:
                found.insert(place, name)
            place = found.index(name) + 1
    return found


def plain_log(axes: Axes, name: Literal["x", "y"]) -> None:
    """Make an axis of what is drawn logarithmic, with 1, 10 in plain digits; below two decades 2
    and 5, too."""
    axes.set(**{f"{name}scale": "log"})
    axis: Axis = getattr(axes, f"{name}axis")
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def middle(lows: NDArray[np.float64], highs: NDArray[np.float64], least: float = 0.0) -> Point:
    """The range of all, without those far out: beyond 1.5 times the middle half's width.

    Args:
        least: what a width is taken for at least.
    """
    first, third = float(np.percentile(lows, 25)), float(np.percentile(highs, 75))
    room = 1.5 * max(third - first, least)
    return max(float(np.min(lows)), first - room), min(float(np.max(highs)), third + room)


def watermark(axes: Axes, results: "Results") -> None:
    if results.smoke:
        look: dict[str, Any] = {"rotation": 15, "color": GRAY, "alpha": 0.45, "fontsize": 13}
        axes.text(0.5, 0.5, SMOKE, transform=axes.transAxes, ha="center", va="center", **look)


# --- the Pareto front -----------------------------------------------------------------------------


def front(points: Sequence[Point], better: tuple[int, int] = (+1, +1)) -> list[int]:
    """Indices of the points that are not dominated, by growing first number.

    Args:
        better: of each number, +1: higher, -1: lower.

    A point is dominated by one that is at least as good in both numbers and better in one; equal
    points do not dominate each other. Unlike a convex hull, it has no point of a mixture.
    """
    signed = [(better[0] * x, better[1] * y) for x, y in points]

    def dominated(own: Point) -> bool:
        return any(x >= own[0] and y >= own[1] and (x, y) != own for x, y in signed)

    kept = [index for index, own in enumerate(signed) if not dominated(own)]
    return sorted(kept, key=lambda index: points[index])


def draw_front(axes: Axes, points: Sequence[Point], better: tuple[int, int] = (+1, +1)) -> None:
    """The front as stairs from edge to edge of axes that show the points already.

    Args:
        better: as in `front`.

    Their height is the second number that can be had at the first number or a better one.
    """
    corners = [points[index] for index in front(points, better)]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    corners = corners if better[0] > 0 else corners[::-1]
    first = (left if better[0] > 0 else right, corners[0][1])
    last = (corners[-1][0], low if better[1] > 0 else high)
    xs, ys = zip(first, *corners, last, strict=True)
    axes.plot(xs, ys, drawstyle="steps-pre", **FRONT)
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
