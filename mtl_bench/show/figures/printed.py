"""Figures as wide as a page: input, panoptic map, depth and point cloud, one frame or many.

Sizes are inches of the printed page, so that text has the size that a reader will see; panels are
drawn at the very pixels that they take up there. The same input gives the same bytes.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from mtl_bench.data.labels import LabelSet
from mtl_bench.report.style import styled
from mtl_bench.show import render
from mtl_bench.show.figures.files import write_whole
from mtl_bench.show.figures.frames import Shown
from mtl_bench.show.predict import Image, Predicted
from mtl_bench.show.predict.files import cloud_picture
from mtl_bench.show.render.depth import RANGES, ticks

WIDTH = 7.0  # inches, both columns of a page
DPI = 300
GAP, TITLE, LABEL = 0.06, 0.19, 0.32  # inches: between panels, above columns, left of rows
TEXT, SMALL = 8.0, 7.0  # points
LINE = 0.145  # inches, of the legend
ENTRY = 0.86  # inches, of the longest class name and its swatch
FORMATS = ("png", "pdf")
INPUT, PANOPTIC, DEPTH, CLOUD = "Input", "Panoptic segmentation", "Depth", "Point cloud"


@dataclass(frozen=True)
class Panel:
    title: str
    image: Image


def prediction(shown: Shown, dpi: int = DPI) -> Figure:
    """One frame, two panels beside each other and two below: the paper's first figure."""
    pixels = round((WIDTH - GAP) / 2 * dpi)
    panels = _panels(shown, _Scale([shown]), pixels)
    rows = [panels[:2], panels[2:]] if len(panels) > 3 else [panels]
    return _compose(rows, [shown], [""] * len(rows), dpi, titles_everywhere=True)


def qualitative(shown: Sequence[Shown], labels: Sequence[str], dpi: int = DPI) -> Figure:
    """A row a frame and run, four columns; `labels` stand left of the rows, empty ones do not."""
    left = LABEL if any(labels) else 0.0
    scale = _Scale(shown)
    columns = len(_titles(shown[0].predicted))
    pixels = round(((WIDTH - left + GAP) / columns - GAP) * dpi)
    rows = [_panels(one, scale, pixels) for one in shown]
    for above, row, one, before in zip(rows, rows[1:], shown[1:], shown, strict=False):
        if one.name == before.name and above:
            row[0] = Panel(INPUT, np.full_like(row[0].image, 255))  # it stands above already
    return _compose(rows, shown, labels, dpi)


def write(figure: Figure, path: Path) -> None:
    """As PNG or PDF, by the file's suffix; whole or not at all, without a date.

    Raises:
        ValueError: another suffix.
    """
    kind = suffix_of(path)
    metadata = {"Software": None} if kind == "png" else {"CreationDate": None, "Producer": None}
    drawn = io.BytesIO()
    with styled():
        mpl.rcParams["pdf.fonttype"] = 42  # TrueType: publishers refuse Type 3
        figure.savefig(drawn, format=kind, dpi=figure.dpi, metadata=metadata)
    write_whole(path, drawn.getvalue())


def suffix_of(path: Path) -> str:
    """Raises: ValueError: neither .png nor .pdf."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise ValueError(f"--out '{path}' must end in .png or .pdf")
    return kind


# --- panels ---------------------------------------------------------------------------------------


class _Scale:
    """The colours of depth: one scale for all frames where their unit has one."""

    def __init__(self, shown: Sequence[Shown]) -> None:
        units = {one.predicted.unit for one in shown} - {None}
        self.unit = units.pop() if len(units) == 1 else None
        self.span = RANGES.get(self.unit or "")

    def of(self, predicted: Predicted) -> tuple[float, float]:
        assert predicted.depth_HW is not None
        assert predicted.unit is not None
        return self.span or render.depth_range(predicted.depth_HW, predicted.unit)


def _titles(predicted: Predicted) -> list[str]:
    panoptic = predicted.instance_ids_HW is not None
    depth = predicted.depth_HW is not None
    return [INPUT, *[PANOPTIC] * panoptic, *[DEPTH, CLOUD] * depth]


def _panels(shown: Shown, scale: _Scale, width: int) -> list[Panel]:
    """What there is of a prediction, so many pixels wide, all of the input's shape."""
    predicted = shown.predicted
    rows, columns = predicted.image_HW3.shape[:2]
    size = (width, round(width * rows / columns))  # OpenCV's order
    image = _fit(predicted.image_HW3, size, smooth=True)
    panels = [Panel(INPUT, image)]
    if predicted.instance_ids_HW is not None:
        ids_HW = _fit(predicted.instance_ids_HW, size)
        panels.append(Panel(PANOPTIC, render.overlay(image, ids_HW, shown.labels)))
    if predicted.depth_HW is not None:
        colors = render.depth_colors(_fit(predicted.depth_HW, size), *scale.of(predicted))
        cloud = _cut(cloud_picture(predicted, shown.labels), size)
        unit = f" [{scale.unit}]" if scale.span else ", near to far in each"
        panels += [Panel(DEPTH + unit, colors), Panel(CLOUD, _fit(cloud, size, smooth=True))]
    return panels


def _fit(values_HW: NDArray[Any], size: tuple[int, int], smooth: bool = False) -> NDArray[Any]:
    """Without `smooth` no value is invented."""
    how = cv2.INTER_NEAREST_EXACT
    if smooth:
        how = cv2.INTER_AREA if size[0] < values_HW.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(values_HW, size, interpolation=how))


def _cut(picture: Image, size: tuple[int, int]) -> Image:
    """The middle of a picture that has the shape of `size`."""
    rows, columns = picture.shape[:2]
    times = min(columns / size[0], rows / size[1])
    width, height = math.floor(size[0] * times), math.floor(size[1] * times)
    top, left = (rows - height) // 2, (columns - width) // 2
    return picture[top : top + height, left : left + width]


# --- the page -------------------------------------------------------------------------------------


def _compose(
    rows: Sequence[Sequence[Panel]],
    shown: Sequence[Shown],
    labels: Sequence[str],
    dpi: int,
    titles_everywhere: bool = False,
) -> Figure:
    """Panels in rows, titles above them, and the legend and the bar of depth below."""
    left = LABEL if any(labels) else 0.0
    columns = max(map(len, rows))
    wide = (WIDTH - left + GAP) / columns - GAP
    high = [row[0].image.shape[0] / dpi for row in rows]
    titled = [titles_everywhere or index == 0 for index in range(len(rows))]
    bar_column = next(
        (i for row in rows for i, p in enumerate(row) if p.title.startswith(DEPTH)), None
    )
    entries = _entries(shown)
    room = _room_for_legend(left, wide, columns, bar_column)
    foot = max(0.34 * (bar_column is not None), LINE * _lines(entries, room[1]) + 0.06)
    total = sum(high) + GAP * len(rows) + TITLE * sum(titled) + foot
    with styled():
        figure = Figure(figsize=(WIDTH, round(total * dpi) / dpi), dpi=dpi)
        top = total
        for row, height, label, has_title in zip(rows, high, labels, titled, strict=True):
            top -= TITLE * has_title
            for column, panel in enumerate(row):
                x = left + column * (wide + GAP)
                _place(figure, panel.image, x, top - height, wide, height, dpi)
                if has_title:
                    _text(figure, x + wide / 2, top + 0.05, panel.title, TEXT, ha="center")
            if label:
                size = min(_fitting(each, height) for each in labels if each)
                middle = top - height / 2
                _text(figure, 0.0, middle, label, size, ha="left", va="center", rotation=90)
            top -= height + GAP
        if bar_column is not None:
            _bar(figure, left + bar_column * (wide + GAP), top, wide, _Scale(shown))
        _legend(figure, entries, room, top)
        return figure


def _room_for_legend(
    left: float, wide: float, columns: int, bar: int | None
) -> tuple[float, float]:
    """Where the legend begins and how wide it is: beside the bar, where there is more room."""
    if bar is None:
        return left, WIDTH - left
    before, after = bar * (wide + GAP), (columns - bar - 1) * (wide + GAP)
    return (left, before) if before >= after else (WIDTH - after + GAP, after - GAP)


def _place(
    figure: Figure, image: Image, x: float, y: float, wide: float, high: float, dpi: int
) -> None:
    """An image at a place in inches, on whole pixels: drawn as it is."""
    height = figure.get_figheight()
    box = [round(x * dpi), round(y * dpi), image.shape[1], image.shape[0]]
    size = [WIDTH * dpi, height * dpi]
    axes = figure.add_axes(_shares(box, size))
    axes.imshow(image, interpolation="none", aspect="auto")
    axes.axis("off")


def _shares(box: Sequence[float], size: Sequence[float]) -> tuple[float, float, float, float]:
    """Left, bottom, width and height as shares of the figure's."""
    x, y, wide, high = box
    return x / size[0], y / size[1], wide / size[0], high / size[1]


def _text(figure: Figure, x: float, y: float, text: str, size: float, **options: Any) -> None:
    where = x / WIDTH, y / figure.get_figheight()
    figure.text(*where, text, fontsize=size, linespacing=1.1, **options)


def _fitting(label: str, height: float) -> float:
    """Points of a text that stands upright beside a row."""
    longest = max(map(len, label.splitlines()))
    return min(SMALL, height / (longest * 0.6) * 72)


def _bar(figure: Figure, x: float, top: float, wide: float, scale: _Scale) -> None:
    """Depth's colours, with numbers where one scale holds for every map."""
    near, far = scale.span or (1.0, 100.0)
    inset, high = 0.12, 0.09
    pixels = round((wide - 2 * inset) * DPI)
    colors = render.depth_colors(np.geomspace(near, far, pixels)[None], near, far)
    size = WIDTH, figure.get_figheight()
    box = (x + inset, top - high, wide - 2 * inset, high)
    axes = figure.add_axes(_shares(box, size))
    axes.imshow(colors, aspect="auto", interpolation="nearest", extent=(0, 1, 0, 1))
    axes.set_yticks([])
    axes.grid(False)
    places = {0.0: "near", 1.0: "far"}
    if scale.span is not None:
        places = {
            math.log(value / near) / math.log(far / near): f"{value:g}"
            for value in ticks(near, far)
        }
    axes.set_xticks(list(places), list(places.values()), fontsize=SMALL)
    axes.tick_params(length=2, pad=1.5, width=0.6)
    for side in axes.spines.values():
        side.set_visible(False)


def _entries(shown: Sequence[Shown]) -> dict[str, tuple[int, int, int]]:
    """Names and colours of the classes in the maps, in the label set's order."""
    found: dict[str, tuple[int, int, int]] = {}
    for one in shown:
        classes = one.predicted.class_HW
        present = set() if classes is None else set(np.unique(classes).tolist())
        found |= {one.labels.labels[i].name: one.labels.labels[i].color for i in present - {255}}
    order = _names(shown[0].labels)
    return {name: found[name] for name in sorted(found, key=order.index)}


def _names(labels: LabelSet) -> list[str]:
    return [label.name for label in labels.labels]


def _lines(entries: dict[str, Any], wide: float) -> int:
    return math.ceil(len(entries) / max(1, int(wide / ENTRY)))


def _legend(figure: Figure, entries: dict[str, Any], room: tuple[float, float], top: float) -> None:
    left, wide = room
    columns = max(1, int(wide / ENTRY))
    size = WIDTH, figure.get_figheight()
    for index, (name, color) in enumerate(entries.items()):
        x = left + index % columns * wide / columns
        y = top - (index // columns + 1) * LINE + 0.05
        swatch = Rectangle((x / size[0], y / size[1]), 0.09 / size[0], 0.09 / size[1])
        swatch.set(facecolor=np.array(color) / 255, transform=figure.transFigure, linewidth=0)
        figure.add_artist(swatch)
        _text(figure, x + 0.13, y + 0.005, name, SMALL)
