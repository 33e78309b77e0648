"""The report's drawn figures: quality against speed, curves, learned weights, quality per class."""

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

from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.report.style import BASELINE, GRAY, Look, looks, save, styled
from mtl_bench.report.tables import BY_NAME, SMOKE, Column, Group, Table

POINTS = 60  # per curve: longer ones are averaged
PANEL = (2.9, 2.1)  # inches
CLASS = re.compile(r"panoptic\.class\.(.+)\.pq")
Curves = Mapping[str, Sequence[pd.DataFrame]]  # group label -> one frame per seed


def against_speed(table: Table, name: str, out_dir: Path) -> str | None:
    """`<name>_fps`: a quality column against FPS, one marker per group with its spread.

    Returns:
        What the figure shows in words, or None where no group has both numbers.
    """
    column, fps = BY_NAME[name], BY_NAME["fps"]
    groups = [g for g in table.groups if g.entries[name].count and g.entries["fps"].count]
    if not groups:
        return None
    with styled():
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.add_subplot()
        handles = []
        for group, look in _looks(table):
            if group in groups:
                _point(axes, group, column, look)
                label = f"{group.label} (n={len(group.rows)})"
                handles.append(Line2D([], [], linestyle="", label=label, **_marker(group, look)))
        if table.baseline and table.baseline.entries[name].count:
            level = table.baseline.entries[name].mean
            handles.append(axes.axhline(level, label="trivial predictor", **BASELINE))
        axes.set_xlabel(f"{fps.title} (higher is better)\n{_where_timed(groups)}")
        better = "higher" if column.better > 0 else "lower"
        unit = f", {column.note}" if column.note else ""
        axes.set_ylabel(f"{column.title}{unit}\n({better} is better)")
        axes.margins(0.12)
        _smoke(axes, table)
        figure.legend(handles=handles, loc="outside right upper")
        save(figure, out_dir, f"{name}_fps")
    points = "; ".join(
        f"{g.label} {g.entries[name].mean:.{column.digits}f} at {g.entries['fps'].mean:.1f} FPS"
        for g in groups
    )
    return f"{column.title} against FPS. {points}."


def curves(table: Table, runs: Curves, prefix: str, out_dir: Path) -> str | None:
    """`<prefix>_curves`: one panel per loss term over the training steps, one line per group.

    Args:
        runs: training curves of the groups that have them.
        prefix: `loss` (unweighted terms) or `weight` (what the method multiplies them with).

    Returns:
        What the figure shows in words, or None where there is nothing to show: no curves, or
        weights that no method changes.
    """
    columns = list(dict.fromkeys(c for frames in runs.values() for f in frames for c in f.columns))
    terms = [column for column in columns if column.startswith(f"{prefix}.")]
    frames = [frame for several in runs.values() for frame in several]
    if prefix == "weight" and all(f[t].nunique() < 2 for t in terms for f in frames if t in f):
        return None
    if not terms:
        return None
    across = min(3, len(terms) + 1)
    down = math.ceil((len(terms) + 1) / across)  # the last panel holds the legend
    with styled():
        figure = Figure(figsize=(PANEL[0] * across, PANEL[1] * down), layout="constrained")
        panels = figure.subplots(down, across, squeeze=False).flatten()
        handles: dict[str, object] = {}
        for axes, term in zip(panels, terms, strict=False):
            for group, look in _looks(table):
                several = [f for f in runs.get(group.label, ()) if term in f]
                if several:
                    line = _curve(axes, several, term, look, group.status == "stale")
                    handles.setdefault(group.label, line)
            axes.set_title(term.removeprefix(f"{prefix}."))
            axes.set_xlabel("step")
            _log_scale(axes)
            _smoke(axes, table)
        for axes in panels[len(terms) :]:
            axes.set_axis_off()
        panels[len(terms)].legend(handles.values(), handles.keys(), loc="center")
        save(figure, out_dir, f"{prefix}_curves")
    what = "Unweighted training loss" if prefix == "loss" else "Weight"
    return f"{what} of each term over the training steps, mean over seeds with their range."


def classes(table: Table, out_dir: Path, labels: LabelSet = CITYSCAPES20) -> str | None:
    """`classes`: panoptic quality per class and group as a heat table."""
    values = {group.label: _class_quality(group) for group in table.groups}
    values = {label: quality for label, quality in values.items() if quality}
    found = {name for quality in values.values() for name in quality}
    names = [label.name for label in labels.labels if label.name in found]
    if not names:
        return None
    heat = np.array([[quality.get(n, math.nan) for n in names] for quality in values.values()])
    with styled():
        height = 1.35 + 0.3 * len(values)
        figure = Figure(figsize=(9.2, height), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(False)
        image = axes.imshow(heat, cmap="Blues", vmin=0, vmax=100, aspect="auto")
        axes.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(values)), list(values))
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        for (y, x), value in np.ndenumerate(heat):
            shown = "-" if math.isnan(value) else f"{value:.0f}"
            color = "white" if value > 60 else "black"
            axes.text(x, y, shown, ha="center", va="center", color=color, fontsize=8)
        figure.colorbar(image, ax=axes, label="PQ, %", pad=0.01, fraction=0.03)
        if table.smoke:
            axes.set_title(SMOKE, color="#a40000")
        save(figure, out_dir, "classes")
    return "Panoptic quality per class, mean over seeds; only classes that occur in the split."


# --- parts ----------------------------------------------------------------------------------------


def _looks(table: Table) -> list[tuple[Group, Look]]:
    """A group's look is its identity's, whatever its status."""
    found = looks(dict.fromkeys(group.identity for group in table.groups))
    return [(group, found[group.identity]) for group in table.groups]


def _point(axes: Axes, group: Group, column: Column, look: Look) -> None:
    x, y = group.entries["fps"], group.entries[column.name]
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


def _curve(
    axes: Axes, frames: Sequence[pd.DataFrame], column: str, look: Look, faint: bool
) -> object:
    """Mean over seeds with their range; faint for stale numbers."""
    last = max(int(frame["step"].max()) for frame in frames)
    width = max(1, math.ceil(last / POINTS))
    binned = [f.groupby((f["step"] - 1) // width)[["step", column]].mean() for f in frames]
    joined = pd.concat(binned).groupby(level=0)
    step, middle = joined["step"].mean(), joined[column]
    style: dict[str, Any] = {"color": look.color, "linestyle": look.dash}
    style["alpha"] = 0.5 if faint else 1.0
    (line,) = axes.plot(step, middle.mean(), linewidth=0.8 if faint else 1.4, **style)
    if len(frames) > 1:
        axes.fill_between(
            step, middle.min(), middle.max(), color=look.color, alpha=0.18, linewidth=0
        )
    return line


def _log_scale(axes: Axes) -> None:
    """Where everything is positive and spans more than a factor of five."""
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.get_lines()])
    if values.size and values.min() > 0 and values.max() > 5 * values.min():
        axes.set_yscale("log")


def _class_quality(group: Group) -> dict[str, float]:
    """Percent per class, mean over the group's seeds."""
    per_seed = []
    for row in group.rows:
        found = {CLASS.fullmatch(key): value for key, value in row.get("metric", {}).items()}
        per_seed.append({m[1]: v for m, v in found.items() if m and v is not None})
    return {str(k): float(v) for k, v in pd.DataFrame(per_seed, dtype=float).mean().items()}


def _smoke(axes: Axes, table: Table) -> None:
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
