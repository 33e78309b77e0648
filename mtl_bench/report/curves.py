"""The report's figures over the training steps: losses, learned weights, diagnostics.

A cell of `curve.csv` may be empty: a batch without a task's labels, or a step without cosines.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mtl_bench.core.style import MANY, Look, save, styled
from mtl_bench.report.columns import capital
from mtl_bench.report.plots import heat_table, looks_of, plain_log, watermark
from mtl_bench.report.table import NOTHING

if TYPE_CHECKING:
    from mtl_bench.report.grid import Results

POINTS, POINTS_OF_MANY = 60, 20  # per curve: longer ones are averaged
PANEL = (2.9, 2.1)  # inches
COSINE = "cosine."
Curves = Mapping[str, Sequence[pd.DataFrame]]  # group label -> one frame per seed


def terms(results: "Results", runs: Curves, prefix: str, out_dir: Path) -> str | None:
    """`<prefix>_curves`: one panel per loss term over the training steps, one line per group.

    Args:
        runs: training curves of the groups that have them.
        prefix: `loss` (unweighted terms) or `weight` (what the method multiplies them with).

    Returns:
        What the figure shows in words, or None where there is nothing to show: no curves, or
        weights that no method changes.
    """
    panels = {c: c.removeprefix(f"{prefix}.") for c in _columns(runs, f"{prefix}.")}
    frames = [frame for several in runs.values() for frame in several]
    constant = all(f[c].nunique() < 2 for c in panels for f in frames if c in f)
    if not panels or (prefix == "weight" and constant):
        return None
    _draw(results, runs, panels, out_dir, f"{prefix}_curves")
    what = "Unweighted training loss" if prefix == "loss" else "Weight"
    return f"{what} of each term over the training steps, {_how(results)}"


def diagnostics(results: "Results", runs: Curves, out_dir: Path) -> str | None:
    """`diagnostics`: norm of the update and cosines of the task gradients over the steps.

    One panel each; cosines of many groups as a table of their means, since no eye follows ten
    panels of thirty lines.

    Returns:
        What the figure shows in words, or None where no curve has either.
    """
    norm = dict.fromkeys(_columns(runs, "update_norm"), "norm of the update")
    cosines = {column: _pair(column) for column in _columns(runs, COSINE)}
    if not norm and not cosines:
        return None
    if cosines and len(runs) > MANY:
        _cosine_table(results, runs, norm | cosines, out_dir)
        return "Means over steps and seeds: cosines between the task gradients, norm of the update."
    _draw(results, runs, norm | cosines, out_dir, "diagnostics")
    words = ["norm of the parameters' update"] * bool(norm)
    words += ["cosines between the task gradients"] * bool(cosines)
    return f"{capital(' and '.join(words))} over the training steps, {_how(results)}"


# --- parts ----------------------------------------------------------------------------------------


def _columns(runs: Curves, prefix: str) -> list[str]:
    """Those with a value, in the order in which they come."""
    frames = [frame for several in runs.values() for frame in several]
    found = dict.fromkeys(c for f in frames for c in f.columns if c.startswith(prefix))
    return [column for column in found if any(_has(frame, column) for frame in frames)]


def _has(frame: pd.DataFrame, column: str) -> bool:
    return column in frame and bool(frame[column].notna().any())


def _pair(column: str) -> str:
    first, second = column.removeprefix(COSINE).split(".")
    return f"cosine {first}, {second}"


def _how(results: "Results") -> str:
    several = any(len(group.rows) > 1 for group in results.groups)
    many = len(results.groups) > MANY
    words = "mean over seeds." if many else "mean over seeds with their range."
    stage = any(row.get("cell", {}).get("video") for group in results.groups for row in group.rows)
    return (words if several else "one seed each.") + (
        " The video stage counts its own steps." if stage else ""
    )


def _cosine_table(
    results: "Results", runs: Curves, columns: Mapping[str, str], out_dir: Path
) -> None:
    """A row per group, a column per pair, and the norm of the update without a colour."""
    labels = [group.label for group in results.groups if group.label in runs]
    means = np.array([[_mean(runs[label], column) for column in columns] for label in labels])
    cosine = np.array([column.startswith(COSINE) for column in columns])
    spell = ["{:z.2f}" if is_cosine else "{:.2g}" for is_cosine in cosine]
    texts = [
        [NOTHING if math.isnan(v) else s.format(v) for v, s in zip(line, spell, strict=True)]
        for line in means
    ]
    heat = np.where(cosine, means, math.nan)
    titles = (labels, list(columns.values()))
    heat_table(results, titles, heat, texts, ("RdBu", -1, 1, "mean cosine"), out_dir, "diagnostics")


def _mean(frames: Sequence[pd.DataFrame], column: str) -> float:
    means = [float(frame[column].mean()) for frame in frames if _has(frame, column)]
    return float(np.mean(means)) if means else math.nan


def _draw(
    results: "Results", runs: Curves, panels: Mapping[str, str], out_dir: Path, name: str
) -> None:
    """One panel per column; the legend stands in the last one, or below where it is long.

    Args:
        panels: a column of the curves -> the panel's title.
    """
    many = len(runs) > MANY
    places = len(panels) + (not many)
    across = min(3 if places <= 6 else 4, places)
    down = math.ceil(places / across)
    lines = math.ceil(len(runs) / 5) if many else 0
    with styled():
        size = (PANEL[0] * across, PANEL[1] * down + 0.17 * lines)
        figure = Figure(figsize=size, layout="constrained")
        all_axes = figure.subplots(down, across, squeeze=False).flatten()
        handles: dict[str, Any] = {}
        for axes, (column, title) in zip(all_axes, panels.items(), strict=False):
            for group, look in looks_of(results):
                several = [f for f in runs.get(group.label, ()) if _has(f, column)]
                if several:
                    line = _curve(axes, several, column, look, group.status == "stale", many)
                    handles.setdefault(group.label, line)
            axes.set_title(title)
            axes.set_xlabel("step")
            _scale(axes, column)
            watermark(axes, results)
        for axes in all_axes[len(panels) :]:
            axes.set_axis_off()
        if many:
            figure.legend(
                handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=7.5
            )
        else:
            all_axes[len(panels)].legend(handles.values(), handles.keys(), loc="center")
        save(figure, out_dir, name)


def _curve(
    axes: Axes, frames: Sequence[pd.DataFrame], column: str, look: Look, faint: bool, many: bool
) -> object:
    """Mean over seeds with their range; faint for stale numbers; no range among many lines."""
    frames = [frame[["step", column]].dropna() for frame in frames]
    last = max(int(frame["step"].max()) for frame in frames)
    width = max(1, math.ceil(last / (POINTS_OF_MANY if many else POINTS)))
    binned = [f.groupby((f["step"] - 1) // width)[["step", column]].mean() for f in frames]
    joined = pd.concat(binned).groupby(level=0)
    step, middle = joined["step"].mean(), joined[column]
    style: dict[str, Any] = {"color": look.color, "linestyle": look.dash}
    style["alpha"] = 0.5 if faint else 1.0
    (line,) = axes.plot(step, middle.mean(), linewidth=0.8 if faint or many else 1.4, **style)
    if len(frames) > 1 and not many:
        axes.fill_between(
            step, middle.min(), middle.max(), color=look.color, alpha=0.18, linewidth=0
        )
    return line


def _scale(axes: Axes, column: str) -> None:
    """Cosines from -1 to 1; others logarithmic where they are positive and span a factor of 5."""
    if column.startswith(COSINE):
        axes.set_ylim(-1.05, 1.05)
        return
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.get_lines()])
    if values.min() > 0 and values.max() > 5 * values.min():
        plain_log(axes, "y")
