"""The figures of a grid of latencies: quality over speed, stages, roofline; a panel for each size.

Colour is the backbone, marker the engine, filling the precision: the same in every figure.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.style import GRAY, MARKERS, looks, save, styled
from mtl_bench.report.plots import FRONT, better, draw_front, plain_log
from mtl_bench.report.statistics import SMOKE

if TYPE_CHECKING:
    from mtl_bench.report.latency import Line, Timings

FILLS = {"fp32": "full", "bf16": "left", "fp16": "none", "int8": "bottom"}
STAGES = (
    ("transfer_ms", "transfer"),
    ("network_ms", "network"),
    ("postprocess_ms", "post-processing"),
)
BAR = 0.19  # inches
NEAR = 1.4  # times as high a roof is so near that words do not fit between


def against_quality(timings: "Timings", column: Column, out_dir: Path) -> str | None:
    """`<column>_fps`: a backbone's quality against each engine's speed, and the Pareto front.

    Returns:
        What the figure shows in words, or None where no timing with all tasks has a quality.
    """
    every = {quality.backbone: quality.values[column.name] for quality in timings.quality}
    values = {backbone: value for backbone, value in every.items() if not math.isnan(value)}
    lines = [li for li in timings.whole if li.row["backbone"] in values]
    if not lines:
        return None
    with styled():
        figure, panels = _panels(timings, lines)
        fronts = [
            [(line.values[FPS.name], values[line.row["backbone"]]) for line in own]
            for _, own in panels
        ]
        for (axes, own), points in zip(panels, fronts, strict=True):
            for line, point in zip(own, points, strict=True):
                axes.plot(*point, linestyle="", **_marker(timings, line))
            plain_log(axes, "x")
            axes.set_xlabel(f"{FPS.title} ({better(FPS)} is better)")
            axes.margins(0.12)
        for (axes, _), points in zip(panels, fronts, strict=True):  # they share the y axis
            draw_front(axes, points, (FPS.better, column.better))
        title = ", ".join(filter(None, (column.title, column.unit)))
        panels[0][0].set_ylabel(f"{title} ({better(column)} is better)")
        _legend(figure, timings, lines, [Line2D([], [], label="Pareto front", **FRONT)])
        save(figure, out_dir, f"{column.name}_{FPS.name}")
    return f"{column.title} over {FPS.in_words}, all tasks. {_where_from(timings)}"


def stages(timings: "Timings", out_dir: Path) -> str | None:
    """`stages`: where a frame's time goes, a bar for each timing."""
    lines = timings.whole
    if not lines:
        return None
    shades = ("#9ecae1", "#0072B2", "#D55E00")
    with styled():
        figure, panels = _panels(timings, lines, BAR)
        for axes, own in panels:
            left = np.zeros(len(own))
            for (key, _), color in zip(STAGES, shades, strict=True):
                widths = np.array([line.values[key] for line in own])
                axes.barh(range(len(own)), widths, left=left, color=color, height=0.75)
                left += widths
            for y, total in enumerate(left):
                axes.text(total, y, f" {total:.0f}", va="center", fontsize=6.5, color=GRAY)
            named = [" ".join((li.names[0], li.engine, li.names[3])) for li in own]
            axes.set_yticks(range(len(own)), named, fontsize=7)
            axes.invert_yaxis()
            axes.grid(False, axis="y")
            axes.set_xlim(0, 1.12 * left.max())
            axes.set_xlabel("ms a frame")
        handles = [
            Patch(color=color, label=label)
            for (_, label), color in zip(STAGES, shades, strict=True)
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        save(figure, out_dir, "stages")
    tasks = lines[0].names[1]
    return f"Mean time of each stage of a frame, {tasks}, batch 1; the number is their sum in ms."


def roofline(timings: "Timings", out_dir: Path) -> str | None:
    """`roofline`: the network's arithmetic a second against what the machine can do at most."""
    lines = [line for line in timings.whole if _has_roof(line)]
    if not lines:
        return None
    with styled():
        roofs = _roofs(lines)
        figure, panels = _panels(timings, lines)
        for axes, own in panels:
            points = [_work(line) for line in own]
            for line, point in zip(own, points, strict=True):
                axes.plot(*point, linestyle="", **_marker(timings, line))
            _draw_roofs(axes, roofs, [x for x, _ in points])
            plain_log(axes, "x")
            plain_log(axes, "y")
            axes.set_xlabel("operations a byte")
        panels[0][0].set_ylabel("GFLOP/s of the network")
        peaks = [
            Line2D([], [], color=GRAY, label=f"{named}: {gflops:.0f} GFLOP/s, {gbs:.0f} GB/s")
            for (gflops, gbs), named in roofs.items()
        ]
        _legend(figure, timings, lines, peaks)
        save(figure, out_dir, "roofline")
    best = max(lines, key=lambda line: line.values["roofline"])
    metric = best.row["metric"]
    gflops, megabytes = 2 * metric["latency.gmacs"], metric["latency.network_mb"]
    return (
        "Operations (two a multiply-add) a second of the network stage over operations a byte that "
        "it moves at least; lines: the machine's measured peak of arithmetic and of memory. "
        f"Nearest to its roof: {best.label}, {best.values['roofline']:.0f} % of what "
        f"{gflops:.1f} GFLOP and {megabytes:.0f} MB a frame allow at "
        f"{metric['roofline.peak_gflops']:.0f} GFLOP/s and {metric['roofline.peak_gbs']:.1f} GB/s."
    )


# --- parts ----------------------------------------------------------------------------------------


def _panels(
    timings: "Timings", lines: Sequence["Line"], bar: float = 0.0
) -> tuple[Figure, list[tuple[Axes, list["Line"]]]]:
    """Axes for each size that has lines, side by side.

    Args:
        bar: height of a line's bar, inches; then the panels stand below each other.
    """
    groups = {size: [line for line in lines if line.size == size] for size in timings.sizes}
    groups = {size: own for size, own in groups.items() if own}
    count = len(groups)
    if bar:
        heights = [0.9 + bar * len(own) for own in groups.values()]
        figure = Figure(figsize=(7.2, sum(heights) + 0.3), layout="constrained")
        ratios: dict[str, Any] = {"height_ratios": heights}
        found = figure.subplots(count, 1, squeeze=False, gridspec_kw=ratios)[:, 0]
    else:
        figure = Figure(figsize=(2.4 + 2.9 * count, 4.2), layout="constrained")
        found = figure.subplots(1, count, squeeze=False, sharey=True)[0]
    for axes, size in zip(found, groups, strict=True):
        axes.set_title(size)
    if timings.smoke:
        figure.suptitle(SMOKE, color="#a40000")
    return figure, list(zip(found, groups.values(), strict=True))


def _marker(timings: "Timings", line: "Line") -> dict[str, Any]:
    engines = dict.fromkeys(li.engine for li in timings.lines)
    look = looks(dict.fromkeys(li.names[0] for li in timings.lines))[line.names[0]]
    return {
        "marker": MARKERS[list(engines).index(line.engine) % len(MARKERS)],
        "color": look.color,
        "fillstyle": FILLS[line.names[3]],
        "markerfacecoloralt": "white",
        "markersize": 7,
        "markeredgewidth": 1.2,
    }


def _legend(
    figure: Figure, timings: "Timings", lines: Sequence["Line"], more: Sequence[Line2D]
) -> None:
    """What colour, marker and filling say, as far as the lines have them."""
    handles: list[Any] = []
    for place in (0, 2, 3):  # backbone, engine, precision
        for name in dict.fromkeys(line.names[place] for line in lines):
            line = next(li for li in lines if li.names[place] == name)
            shown = _marker(timings, line)
            shown |= {0: {"marker": "o"}, 2: {}, 3: {"marker": "h"}}[place]
            shown |= {"color": GRAY} if place else {}
            shown |= {"fillstyle": "full"} if place != 3 else {}
            handles.append(Line2D([], [], linestyle="", label=name, **shown))
    figure.legend(handles=[*handles, *more], loc="outside right upper")


def _where_from(timings: "Timings") -> str:
    """Of which networks quality and speed are: not the same ones, and the reader must know."""
    recipes = {(q.recipe["name"], q.size, q.recipe["network"]["channels"]) for q in timings.quality}
    named = "; ".join(
        f"recipe {name} ({size} images, decoders of {channels} channels)"
        for name, size, channels in sorted(recipes)
    )
    seeds = sorted({quality.seeds for quality in timings.quality})
    timed = " or ".join(dict.fromkeys(str(li.row["timing"]["recipe"]) for li in timings.measured))
    return (
        f"Quality is measured at the training recipe's size: {named}, n = "
        f"{' or '.join(map(str, seeds))}; speed is measured at the deployed size above each panel, "
        f"with the network of recipe {timed}. A point has the backbone in common, not the weights. "
        "The front: what no other point beats in both."
    )


def _has_roof(line: "Line") -> bool:
    metric = line.row["metric"]
    needed = ("latency.gmacs", "latency.network_mb", "roofline.peak_gflops", "roofline.peak_gbs")
    return all(metric.get(key) for key in needed) and not math.isnan(line.values["roofline"])


def _work(line: "Line") -> tuple[float, float]:
    """Operations a byte, and GFLOP/s."""
    metric = line.row["metric"]
    gflop = 2 * metric["latency.gmacs"]
    return gflop * 1000 / metric["latency.network_mb"], gflop * 1000 / line.values["network_ms"]


def _roofs(lines: Sequence["Line"]) -> dict[tuple[float, float], str]:
    """GFLOP/s and GB/s, highest first -> precisions: the highest peaks that any of a precision's
    timings measured."""
    roofs: dict[tuple[float, float], list[str]] = {}
    for precision in dict.fromkeys(line.names[3] for line in lines):
        metrics = [line.row["metric"] for line in lines if line.names[3] == precision]
        gflops, gbs = (max(m[f"roofline.peak_{key}"] for m in metrics) for key in ("gflops", "gbs"))
        roofs.setdefault((gflops, gbs), []).append(precision)
    return {peaks: ", ".join(roofs[peaks]) for peaks in sorted(roofs, reverse=True)}


def _draw_roofs(
    axes: Axes, roofs: Mapping[tuple[float, float], str], intensities: Sequence[float]
) -> None:
    """Each with its precisions to the right of the panel."""
    ridges = [gflops / gbs for gflops, gbs in roofs]
    x = np.geomspace(min([*ridges, *intensities]) / 3, max([*ridges, *intensities]) * 3, 64)
    for (gflops, gbs), named in roofs.items():
        axes.plot(x, np.minimum(gflops, gbs * x), color=GRAY, linewidth=1.2, zorder=1)
        above = any(1 < other / gflops < NEAR for other, _ in roofs)
        below = any(1 < gflops / other < NEAR for other, _ in roofs)
        side = "center" if above == below else "top" if above else "bottom"
        place = (x[-1], gflops)
        axes.annotate(f" {named}", place, va=side, fontsize=7.5, color=GRAY, annotation_clip=False)
    axes.set_xlim(x[0], x[-1])
