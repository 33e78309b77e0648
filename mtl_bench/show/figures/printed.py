"""Figures as wide as a page: input, the tasks' pictures and point cloud, one frame or many.

Sizes are inches of the printed page, so that text has the size that a reader will see; panels are
drawn at the very pixels that they take up there. The same input gives the same bytes.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mtl_bench.core.canvas import Image
from mtl_bench.core.files import write_bytes
from mtl_bench.core.style import styled
from mtl_bench.core.view import Key, View
from mtl_bench.show.figures.frames import Shown
from mtl_bench.show.predict.files import cloud_picture

WIDTH = 7.0  # inches, both columns of a page
DPI = 300
GAP, TITLE, LABEL = 0.06, 0.19, 0.32  # inches: between panels, above columns, left of rows
TEXT, SMALL = 8.0, 7.0  # points
LINE = 0.145  # inches, of the legend
ENTRY = 0.86  # inches, of the longest class name and its swatch
FORMATS = ("png", "pdf")
INPUT, CLOUD = Key("Input"), Key("Point cloud")
Keys = Mapping[str, Key]  # by task


@dataclass(frozen=True)
class Panel:
    key: Key
    image: Image


def prediction(shown: Shown, dpi: int = DPI) -> Figure:
    """One frame, two panels beside each other and two below: the paper's first figure."""
    pixels = round((WIDTH - GAP) / 2 * dpi)
    panels = _panels(shown, _keys([shown]), pixels)
    rows = [panels[:2], panels[2:]] if len(panels) > 3 else [panels]
    return _compose(rows, [""] * len(rows), dpi, titles_everywhere=True)


def qualitative(shown: Sequence[Shown], labels: Sequence[str], dpi: int = DPI) -> Figure:
    """A row a frame and run, four columns; `labels` stand left of the rows, empty ones do not."""
    left = LABEL if any(labels) else 0.0
    keys, first = _keys(shown), shown[0].predicted
    columns = 1 + len(first.views) + (first.surface is not None)
    pixels = round(((WIDTH - left + GAP) / columns - GAP) * dpi)
    rows = [_panels(one, keys, pixels) for one in shown]
    for above, row, one, before in zip(rows, rows[1:], shown[1:], shown, strict=False):
        if one.name == before.name and above:
            row[0] = Panel(INPUT, np.full_like(row[0].image, 255))  # it stands above already
    return _compose(rows, labels, dpi)


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


def write_whole(path: Path, content: bytes) -> None:
    """Whole or not at all; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, content)


def suffix_of(path: Path) -> str:
    """Raises: ValueError: neither .png nor .pdf."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise ValueError(f"--out '{path}' must end in .png or .pdf")
    return kind


# --- panels ---------------------------------------------------------------------------------------


def _keys(shown: Sequence[Shown]) -> Keys:
    """What explains the pictures of each task, which all frames share."""
    found: dict[str, list[View]] = {}
    for one in shown:
        for view in one.predicted.views:
            found.setdefault(view.task, []).append(view)
    return {task: type(views[0]).key(views) for task, views in found.items()}


def _panels(shown: Shown, keys: Keys, width: int) -> list[Panel]:
    """What there is of a prediction, so many pixels wide, all of the input's shape."""
    predicted = shown.predicted
    rows, columns = predicted.image_HW3.shape[:2]
    size = (width, round(width * rows / columns))  # OpenCV's order
    image = _fit(predicted.image_HW3, size)
    panels = [Panel(INPUT, image)]
    panels += [Panel(keys[view.task], view.picture(image)) for view in predicted.views]
    if predicted.surface is not None:
        cloud = _cut(cloud_picture(predicted, shown.labels), size)
        panels.append(Panel(CLOUD, _fit(cloud, size)))
    return panels


def _fit(image: Image, size: tuple[int, int]) -> Image:
    how = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)


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
    labels: Sequence[str],
    dpi: int,
    titles_everywhere: bool = False,
) -> Figure:
    """Panels in rows, titles above them, and the legend and the bars of scales below."""
    left = LABEL if any(labels) else 0.0
    columns = max(map(len, rows))
    wide = (WIDTH - left + GAP) / columns - GAP
    high = [row[0].image.shape[0] / dpi for row in rows]
    titled = [titles_everywhere or index == 0 for index in range(len(rows))]
    found = [(column, panel.key) for row in rows for column, panel in enumerate(row)]
    bars = {column: key for column, key in found if key.scale is not None}
    entries = {name: color for _, key in found for name, color in key.swatches.items()}
    room = _room_for_legend(left, wide, columns, next(iter(bars), None))
    foot = max(0.34 * bool(bars), LINE * _lines(entries, room[1]) + 0.06)
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
                    _text(figure, x + wide / 2, top + 0.05, panel.key.title, TEXT, ha="center")
            if label:
                size = min(_fitting(each, height) for each in labels if each)
                middle = top - height / 2
                _text(figure, 0.0, middle, label, size, ha="left", va="center", rotation=90)
            top -= height + GAP
        for column, key in bars.items():
            _bar(figure, left + column * (wide + GAP), top, wide, key)
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


def _bar(figure: Figure, x: float, top: float, wide: float, key: Key) -> None:
    """A scale's colours, with its marks."""
    assert key.scale is not None
    inset, high = 0.12, 0.09
    pixels = round((wide - 2 * inset) * DPI)
    size = WIDTH, figure.get_figheight()
    box = (x + inset, top - high, wide - 2 * inset, high)
    axes = figure.add_axes(_shares(box, size))
    axes.imshow(key.scale.ramp(pixels), aspect="auto", interpolation="nearest", extent=(0, 1, 0, 1))
    axes.set_yticks([])
    axes.grid(False)
    axes.set_xticks(list(key.marks), list(key.marks.values()), fontsize=SMALL)
    axes.tick_params(length=2, pad=1.5, width=0.6)
    for side in axes.spines.values():
        side.set_visible(False)


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
