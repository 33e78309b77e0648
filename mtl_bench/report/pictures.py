"""Sample predictions: input, truth and what every group predicts, side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mtl_bench.core import plugins, quality
from mtl_bench.core.canvas import Image
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.style import GRAY, save, styled
from mtl_bench.report.columns import headlines
from mtl_bench.report.statistics import SMOKE, kept

if TYPE_CHECKING:
    from mtl_bench.report.grid import Results

IMAGES, IMAGES_OF_MANY = 3, 2
GROUPS = 6  # more would be too small to see, so they are not all there, and of fewer images
TILE, GAP, HEADER = 192, 4, 20  # pixels: width, between tiles, height of a line's own title


@dataclass(frozen=True)
class Picture:
    """How a map that a run keeps is drawn beside its truth."""

    task: str
    key: str  # in samples.npz; the truth is true_<key>

    def draw(self, image: Image, map_HW: NDArray[Any], labels: LabelSet) -> Image:
        """Input and map are of one size; imports the task."""
        view = plugins.load("tasks", self.task).drawn_view(self.key, map_HW, labels)
        drawn: Image = view.picture(image)
        return drawn


def pictures() -> dict[Picture, str]:
    """Those of every task that is found, with their words in a caption."""
    return {
        Picture(task, key): words
        for task, drawn in quality.declared("drawn").items()
        for key, words in drawn.items()
    }


@dataclass(frozen=True)
class Samples:
    """Some evaluation images, one run's predictions on them and the truth."""

    names: list[str]
    image: Image  # [n,H,W,3]
    maps: Mapping[str, NDArray[Any]]  # <key>, true_<key> -> [n,H,W,...]; absent: no such task
    quality: Mapping[str, NDArray[Any]]  # of the extremes: what they were picked by, rising

    @staticmethod
    def load(path: Path, kind: str = "") -> "Samples | None":
        """The frames at fixed places, or with `extremes.` the worst and best; None: not kept."""
        with np.load(path, allow_pickle=False) as file:
            keys = [key for key in file.files if key.rpartition(".")[0] == kind.rstrip(".")]
            values = {key.removeprefix(kind): file[key] for key in keys}
        if "names" not in values:
            return None
        picked = [column.name for column in headlines() if column.name in values]
        return Samples(
            names=[str(name) for name in values.pop("names")],
            image=values.pop("image"),
            quality={name: values.pop(name) for name in picked},
            maps=values,
        )


def draw(results: "Results", runs_root: Path, out_dir: Path) -> str | None:
    """`samples.png`: a line per image and task; the first seed of every group.

    Returns:
        What the figure shows in words, or None where no run kept samples.
    """
    found = _found(results, runs_root)
    if not found:
        return None
    shown = found[:GROUPS]
    images = IMAGES if len(found) == len(shown) else IMAGES_OF_MANY
    lines = _lines([samples for _, samples in shown], images, _labels(results))
    if not lines:  # what tasks predict are numbers
        return None
    titles = ["input", "truth", *(label for label, _ in shown)]
    _draw_lines(lines, titles, results.smoke, out_dir, "samples")
    kept = {key for _, samples in found for key in samples.maps}
    maps = " and ".join(words for picture, words in pictures().items() if picture.key in kept)
    what = f"Input, ground truth and predictions on the first evaluation images: {maps}."
    return what + _left_out(found)


def extremes(results: "Results", runs_root: Path, out_dir: Path) -> str | None:
    """`extremes.png`: the worst and the best frame of every group's first seed.

    They were picked by a headline, and are drawn as the picture of its task.

    Returns:
        What the figure shows in words, or None where no run kept such frames.
    """
    found = _found(results, runs_root, "extremes.")
    if not found:
        return None
    column = next(column for column in headlines() if column.name in found[0][1].quality)
    picture = next(picture for picture in pictures() if picture.task == column.task)
    title, labels = column.title, _labels(results)
    lines: list[list[Image | None]] = []
    headers, told = [], []
    for label, samples in found[:GROUPS]:
        tiles = [_triple(samples, index, picture, labels) for index in (0, -1)]
        lines.append([tile for triple in tiles for tile in triple])
        worst, best = (f"{samples.quality[column.name][i]:.{column.digits}f}" for i in (0, -1))
        headers.append([f"{label}: {title} {worst}", "", "", f"{title} {best}", "", ""])
        told.append(f"{label} {worst} and {best}")
    titles = [f"{which}: {what}" for which in ("worst", "best") for what in _TRIPLE]
    _draw_lines(lines, titles, results.smoke, out_dir, "extremes", headers)
    return (
        f"Frames on which each row's first seed has its lowest and its highest {column.in_words}, "
        f"{column.title} of the frame alone: {'; '.join(told)}."
    ) + _left_out(found)


# --- parts ----------------------------------------------------------------------------------------


_TRIPLE = ("input", "truth", "prediction")


def _left_out(found: Sequence[object]) -> str:
    return f" The first {GROUPS} of {len(found)}." if len(found) > GROUPS else ""


def _found(results: "Results", runs_root: Path, kind: str = "") -> list[tuple[str, Samples]]:
    """Labels of the groups that kept such frames, with those of the first run that did."""
    found = []
    for group in results.groups:
        loaded = (Samples.load(path, kind) for path in kept(group, runs_root, "samples.npz"))
        samples = next((samples for samples in loaded if samples is not None), None)
        if samples is not None:
            found.append((group.label, samples))
    return found


def _labels(results: "Results") -> LabelSet:
    """The classes of the data set that the cells share; imports it."""
    dataset = results.groups[0].rows[0]["cell"]["recipe"]["data"]["dataset"]
    labels: LabelSet = plugins.load("datasets", dataset.replace("-", "_")).labels
    return labels


def _triple(samples: Samples, index: int, picture: Picture, labels: LabelSet) -> list[Image | None]:
    image = samples.image[index]
    maps = (samples.maps[f"true_{picture.key}"][index], samples.maps[picture.key][index])
    return [_fit(image), *(_map(picture, image, values, labels) for values in maps)]


def _lines(runs: Sequence[Samples], images: int, labels: LabelSet) -> list[list[Image | None]]:
    """Tiles, line by line; None where there is nothing to show."""
    lines: list[list[Image | None]] = []
    for index, name in enumerate(runs[0].names[:images]):
        image = runs[0].image[index]
        found = [(run, run.names.index(name)) if name in run.names else None for run in runs]
        start: Image | None = _fit(image)
        for picture in pictures():
            maps = [_of(pair, picture.key) for pair in found]
            truths = (_of(pair, f"true_{picture.key}") for pair in found)
            truth = next((m for m in truths if m is not None), None)
            if truth is None and all(m is None for m in maps):
                continue  # no run has this task
            tiles = [m if m is None else _map(picture, image, m, labels) for m in (truth, *maps)]
            lines.append([start, *tiles])
            start = None  # the input stands in an image's first line only
    return lines


def _of(pair: tuple[Samples, int] | None, key: str) -> NDArray[Any] | None:
    return pair[0].maps[key][pair[1]] if pair is not None and key in pair[0].maps else None


def _map(picture: Picture, image: Image, values: NDArray[Any], labels: LabelSet) -> Image:
    """Drawn at the tile's size, so that outlines keep their width."""
    small = _fit(image)
    height, width = small.shape[:2]
    values = values.astype(np.float32) if values.dtype.kind == "f" else values
    # nothing is invented between pixels
    values = cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST)
    return picture.draw(small, values, labels)


def _fit(image: Image) -> Image:
    """To the tile's width."""
    height, width = image.shape[:2]
    size = (TILE, round(height * TILE / width))
    smooth = cv2.INTER_AREA if width > TILE else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=smooth), np.uint8)


def _draw_lines(
    lines: Sequence[Sequence[Image | None]],
    titles: Sequence[str],
    smoke: bool,
    out_dir: Path,
    name: str,
    headers: Sequence[Sequence[str]] = (),
) -> None:
    """Tiles below their columns' titles; with headers each line has titles of its own, too."""
    dpi, top = 100, 26 + (20 if smoke else 0)
    head = HEADER if headers else 0
    height = next(tile.shape[0] for line in lines for tile in line if tile is not None)
    canvas_height = top + len(lines) * (height + GAP + head)
    canvas_width = len(titles) * (TILE + GAP)
    canvas = np.full((canvas_height, canvas_width, 3), 255, np.uint8)
    tops = [top + y * (height + GAP + head) + head for y in range(len(lines))]
    for up, line in zip(tops, lines, strict=True):
        for x, tile in enumerate(line):
            if tile is not None:
                left = x * (TILE + GAP)
                canvas[up : up + height, left : left + TILE] = tile
    with styled():
        figure = Figure(figsize=(canvas_width / dpi, canvas_height / dpi), dpi=dpi)
        figure.figimage(canvas, origin="upper")
        for x, title in enumerate(titles):
            center = (x * (TILE + GAP) + TILE / 2) / canvas_width
            size = min(9, 245 / len(title))  # a long one fits its tile
            figure.text(center, 1 - (top - 8) / canvas_height, title, ha="center", fontsize=size)
        for up, texts in zip(tops, headers, strict=False):
            for x, text in enumerate(texts):
                place = x * (TILE + GAP) / canvas_width, 1 - (up - 6) / canvas_height
                figure.text(*place, text, fontsize=8.5)
        if smoke:
            figure.text(0.5, 1 - 14 / canvas_height, SMOKE, ha="center", color=GRAY, fontsize=9)
        save(figure, out_dir, name, pixels=True)
