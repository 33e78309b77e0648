"""Sample predictions: input, truth and every group's panoptic map and depth, side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.report.groups import SMOKE
from mtl_bench.report.style import GRAY, save, styled
from mtl_bench.report.tables import Table
from mtl_bench.show import render
from mtl_bench.show.render.depth import RANGES

IMAGES, IMAGES_OF_MANY = 3, 2
GROUPS = 6  # more would be too small to see, so they are not all there, and of fewer images
TILE, GAP, HEADER = 192, 4, 20  # pixels: width, between tiles, height of a line's own title
NEAR_M, FAR_M = RANGES["m"]  # ends of the depth colours, logarithmic between them
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Samples:
    """Some evaluation images and one run's predictions on them; absent where a task is."""

    names: list[str]
    image: Image  # [n,H,W,3]
    instance_ids: NDArray[np.int32] | None  # [n,H,W] as Cityscapes writes them
    true_instance_ids: NDArray[np.int32] | None
    depth_m: NDArray[np.float32] | None  # 0: no value
    true_depth_m: NDArray[np.float32] | None
    pq: list[float]  # of the extremes, rising; else empty

    @staticmethod
    def load(path: Path, kind: str = "") -> "Samples | None":
        """The frames at fixed places, or with `extremes.` the worst and best; None: not kept."""
        with np.load(path, allow_pickle=False) as file:
            keys = [key for key in file.files if key.rpartition(".")[0] == kind.rstrip(".")]
            values = {key.removeprefix(kind): file[key] for key in keys}
        if "names" not in values:
            return None
        return Samples(
            names=[str(name) for name in values["names"]],
            image=values["image"],
            instance_ids=values.get("instance_ids"),
            true_instance_ids=values.get("true_instance_ids"),
            depth_m=values.get("depth_m"),
            true_depth_m=values.get("true_depth_m"),
            pq=[float(value) for value in values.get("pq", ())],
        )


def draw(
    table: Table, runs_root: Path, out_dir: Path, labels: LabelSet = CITYSCAPES20
) -> str | None:
    """`samples.png`: a panoptic and a depth line per image; the first seed of every group.

    Returns:
        What the figure shows in words, or None where no run kept samples.
    """
    found = _found(table, runs_root)
    if not found:
        return None
    shown = found[:GROUPS]
    images = IMAGES if len(found) == len(shown) else IMAGES_OF_MANY
    lines = _lines([samples for _, samples in shown], images, labels)
    titles = ["input", "truth", *(label for label, _ in shown)]
    _draw_lines(lines, titles, table.smoke, out_dir, "samples")
    left_out = f" The first {GROUPS} of {len(found)}." if len(found) > GROUPS else ""
    return (
        "Input, ground truth and predictions on the first evaluation images: panoptic maps and "
        f"depth (median-scaled, {NEAR_M:g} m bright to {FAR_M:g} m dark, gray without value)."
        f"{left_out}"
    )


def extremes(
    table: Table, runs_root: Path, out_dir: Path, labels: LabelSet = CITYSCAPES20
) -> str | None:
    """`extremes.png`: the worst and the best frame of every group's first seed, by PQ.

    Returns:
        What the figure shows in words, or None where no run kept such frames.
    """
    found = _found(table, runs_root, "extremes.")
    shown = found[:GROUPS]
    lines: list[list[Image | None]] = []
    headers, told = [], []
    for label, samples in shown:
        lines.append([tile for index in (0, -1) for tile in _triple(samples, index, labels)])
        worst, best = samples.pq[0], samples.pq[-1]
        headers.append([f"{label}: PQ {worst:.1f}", "", "", f"PQ {best:.1f}", "", ""])
        told.append(f"{label} {worst:.1f} and {best:.1f}")
    if not lines:
        return None
    titles = [f"{which}: {what}" for which in ("worst", "best") for what in _TRIPLE]
    _draw_lines(lines, titles, table.smoke, out_dir, "extremes", headers)
    left_out = f" The first {GROUPS} of {len(found)}." if len(found) > GROUPS else ""
    return (
        "Frames on which each row's first seed has its lowest and its highest panoptic quality, "
        f"PQ of the frame alone: {'; '.join(told)}.{left_out}"
    )


# --- parts ----------------------------------------------------------------------------------------


_TRIPLE = ("input", "truth", "prediction")


def _found(table: Table, runs_root: Path, kind: str = "") -> list[tuple[str, Samples]]:
    """Labels of the groups that kept such frames, with those of the first run that did."""
    found = []
    for group in table.groups:
        paths = [runs_root / str(row.get("slug", "")) / "samples.npz" for row in group.rows]
        loaded = (Samples.load(path, kind) for path in paths if path.is_file())
        samples = next((samples for samples in loaded if samples is not None), None)
        if samples is not None:
            found.append((group.label, samples))
    return found


def _triple(samples: Samples, index: int, labels: LabelSet) -> list[Image | None]:
    assert samples.instance_ids is not None
    assert samples.true_instance_ids is not None
    image = samples.image[index]
    maps = (samples.true_instance_ids[index], samples.instance_ids[index])
    return [_fit(image), *(_map(image, ids, labels) for ids in maps)]


def _lines(runs: Sequence[Samples], images: int, labels: LabelSet) -> list[list[Image | None]]:
    """Tiles, line by line; None where there is nothing to show."""
    lines: list[list[Image | None]] = []
    for index, name in enumerate(runs[0].names[:images]):
        image = runs[0].image[index]
        found = [(run, run.names.index(name)) if name in run.names else None for run in runs]
        start: Image | None = _fit(image)
        for predicted, true in (("instance_ids", "true_instance_ids"), ("depth_m", "true_depth_m")):
            maps = [_of(pair, predicted) for pair in found]
            truth = next((m for m in (_of(pair, true) for pair in found) if m is not None), None)
            if truth is None and all(m is None for m in maps):
                continue  # no run has this task
            tiles = [
                m if m is None else _map(image, m, labels) if "ids" in true else _depth_tile(m)
                for m in (truth, *maps)
            ]
            lines.append([start, *tiles])
            start = None  # the input stands in an image's first line only
    return lines


def _of(pair: tuple[Samples, int] | None, name: str) -> NDArray[Any] | None:
    values = None if pair is None else getattr(pair[0], name)
    return None if pair is None or values is None else values[pair[1]]


def _depth_tile(depth_m_HW: NDArray[np.floating]) -> Image:
    return _fit(render.depth_colors(depth_m_HW, NEAR_M, FAR_M), exact=True)


def _map(image: Image, ids: NDArray[np.int32], labels: LabelSet) -> Image:
    """Drawn at the tile's size, so that outlines keep their width."""
    small = _fit(image)
    height, width = small.shape[:2]
    ids = cv2.resize(ids, (width, height), interpolation=cv2.INTER_NEAREST)
    return render.overlay(small, ids, labels)


def _fit(image: Image, exact: bool = False) -> Image:
    """To the tile's width; `exact` invents no values between pixels."""
    height, width = image.shape[:2]
    size = (TILE, round(height * TILE / width))
    smooth = cv2.INTER_AREA if width > TILE else cv2.INTER_CUBIC
    return np.asarray(
        cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if exact else smooth), np.uint8
    )


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
