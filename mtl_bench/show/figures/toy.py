"""The toy's two pictures: where every method goes from every start, and how soon it arrives.

Paths are drawn over the sum of both losses, as the field draws them; the map over learning rates is
what such a picture at one rate leaves out.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mtl_bench.core.style import GRAY, PALETTE, styled
from mtl_bench.show.toy import PARETO_X, PARETO_Y, STARTS, SUM_X, Path, losses

WIDTH, COLUMNS = 7.0, 4  # inches; panels in a row
EDGE, CELLS = 10.4, 130  # half the side of what is drawn, and points of the landscape along it
POINTS = 500  # of a path, at most
Walks = Mapping[str, Mapping[float, Sequence[Path]]]  # by method and learning rate, of each start


def paths(walks: Walks, lr: float, dpi: int = 200) -> Figure:
    """A panel a method: its path from every start at one learning rate."""
    side = np.linspace(-EDGE, EDGE, CELLS)
    height = np.array([[sum(loss[0] for loss in losses(x, y)) for x in side] for y in side])
    columns = min(COLUMNS, len(walks))
    rows = math.ceil(len(walks) / columns)
    with styled():
        figure = Figure(
            figsize=(WIDTH * columns / COLUMNS, (WIDTH / COLUMNS + 0.18) * rows + 0.3),
            dpi=dpi,
            layout="constrained",
        )
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        panels = list(grid.flat)
        for panel in panels:
            panel.set_axis_off()
        for panel, (name, by_lr) in zip(panels, walks.items(), strict=False):
            found = by_lr[lr]
            arrived = sum(path.reached is not None for path in found)
            panel.contourf(side, side, height, 14, cmap="Greys", vmin=0, vmax=70)
            panel.plot(PARETO_X, [PARETO_Y] * 2, color="white", linewidth=4.5)
            panel.plot(PARETO_X, [PARETO_Y] * 2, color="black", linewidth=2.5)
            panel.plot(SUM_X, PARETO_Y, "*", color="white", markeredgecolor="black", zorder=4)
            for path, color in zip(found, PALETTE, strict=False):
                places = np.unique(np.linspace(0, len(path.points_N2) - 1, POINTS).astype(int))
                panel.plot(*path.points_N2[places].T, color=color, linewidth=1.2, zorder=2)
                panel.plot(*path.points_N2[0], "o", color=color, markersize=3.5, zorder=3)
                end = "s" if path.reached is not None else "x"
                panel.plot(*path.points_N2[-1], end, color=color, markersize=4, zorder=3)
            panel.set_title(f"{name}  {arrived}/{len(found)}", fontsize=8, pad=2)
            panel.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), aspect="equal")
        figure.supxlabel(
            f"From {len(STARTS)} starts (dots) to the Pareto set (black; star: the least sum), "
            f"Adam at {lr:g}. Squares have arrived, crosses have not.",
            fontsize=7,
            color=GRAY,
        )
    return figure


def steps_map(walks: Walks, steps: int, dpi: int = 200) -> Figure:
    """Methods by learning rates: steps until the last start has reached the Pareto set."""
    names, rates = list(walks), list(next(iter(walks.values())))
    worst = np.full((len(names), len(rates)), np.nan)
    with styled():
        figure = Figure(
            figsize=(1.7 + 0.75 * len(rates), 0.85 + 0.24 * len(names)),
            dpi=dpi,
            layout="constrained",
        )
        axes = figure.subplots()
        axes.grid(visible=False)
        colors = colormaps["viridis_r"]
        norm = LogNorm(min(50, steps / 2), steps)
        for row, by_lr in enumerate(walks.values()):
            for column, found in enumerate(by_lr.values()):
                reached = [path.reached for path in found if path.reached is not None]
                all_there = len(reached) == len(found)
                if all_there:
                    worst[row, column] = max(reached)
                said = f"{max(reached)}" if all_there else f"{len(reached)} of {len(found)}"
                dark = all_there and norm(max(reached)) > 0.4
                color = "white" if dark else "black" if all_there else GRAY
                axes.text(column, row, said, ha="center", va="center", fontsize=7, color=color)
        drawn = axes.imshow(worst, cmap=colors, norm=norm, aspect="auto")
        axes.set_facecolor("#f0f0f0")
        axes.set_xticks(range(len(rates)), [f"{lr:g}" for lr in rates])
        axes.set_yticks(range(len(names)), names)
        axes.tick_params(length=0)
        axes.set_xlabel("learning rate of Adam")
        axes.set_title(
            f"Steps to the Pareto set from the worst of {len(STARTS)} starts", fontsize=8
        )
        bar = figure.colorbar(drawn, ax=axes, pad=0.02)
        bar.set_label(f"steps; gray: not all arrive within {steps}", fontsize=7)
        bar.ax.tick_params(labelsize=7)
    return figure
