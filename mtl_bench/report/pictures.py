"""Sample predictions: input, truth and every group's panoptic map and depth, side by side."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.report.groups import SMOKE
from mtl_bench.report.style import GRAY, save, styled
from mtl_bench.report.tables import Table

IMAGES, IMAGES_OF_MANY = 3, 2
GROUPS = 6  # more would be too small to see, so they are not all there, and of fewer images
TILE = 192  # pixels wide
NEAR_M, FAR_M = 2.0, 80.0  # ends of the depth colours, logarithmic between them
NO_DEPTH = (90, 90, 90)
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

    @staticmethod
    def load(path: Path) -> "Samples":
        with np.load(path, allow_pickle=False) as file:
            values = {key: file[key] for key in file.files}
        return Samples(
            names=[str(name) for name in values["names"]],
            image=values["image"],
            instance_ids=values.get("instance_ids"),
            true_instance_ids=values.get("true_instance_ids"),
            depth_m=values.get("depth_m"),
            true_depth_m=values.get("true_depth_m"),
        )


def draw(
    table: Table, runs_root: Path, out_dir: Path, labels: LabelSet = CITYSCAPES20
) -> str | None:
    """`samples.png`: a panoptic and a depth line per image; the first seed of every group.

    Returns:
        What the figure shows in words, or None where no run kept samples.
    """
    found = []
    for group in table.groups:
        paths = [runs_root / str(row.get("slug", "")) / "samples.npz" for row in group.rows]
        path = next((path for path in paths if path.is_file()), None)
        if path is not None:
            found.append((group.label, Samples.load(path)))
    if not found:
        return None
    shown = found[:GROUPS]
    images = IMAGES if len(found) == len(shown) else IMAGES_OF_MANY
    lines = _lines([samples for _, samples in shown], images, labels)
    titles = ["input", "truth", *(label for label, _ in shown)]
    _draw_lines(lines, titles, table.smoke, out_dir)
    left_out = f" The first {GROUPS} of {len(found)}." if len(found) > GROUPS else ""
    return (
        "Input, ground truth and predictions on the first evaluation images: panoptic maps and "
        f"depth (median-scaled, {NEAR_M:g} m bright to {FAR_M:g} m dark, gray without value)."
        f"{left_out}"
    )


def overlay(image_HW3: Image, instance_ids_HW: NDArray[np.int32], labels: LabelSet) -> Image:
    """Class colours over the gray image, a shade per instance, white outlines; void stays gray."""
    ids = instance_ids_HW.astype(np.int64)
    is_instance = ids >= 1000
    label_ids = np.where(is_instance, ids // 1000, ids)
    classes = labels.class_of_label_id()[np.clip(label_ids, 0, 255)]
    known = classes < len(labels)
    colors = labels.colors[np.where(known, classes, 0)].astype(float)
    shade = np.where(is_instance, (ids * 37 % 5) * 18 - 36, 0)  # neighbours differ
    colors = np.clip(colors + shade[..., None], 0, 255)
    gray = np.repeat(cv2.cvtColor(image_HW3, cv2.COLOR_RGB2GRAY)[..., None], 3, 2).astype(float)
    mixed = np.where(known[..., None], 0.7 * colors + 0.3 * gray, gray)
    edge = np.zeros(ids.shape, bool)
    edge[:, 1:] |= (ids[:, 1:] != ids[:, :-1]) & (is_instance[:, 1:] | is_instance[:, :-1])
    edge[1:] |= (ids[1:] != ids[:-1]) & (is_instance[1:] | is_instance[:-1])
    return np.where(edge[..., None], 255, mixed).astype(np.uint8)


def depth_colors(depth_m_HW: NDArray[np.floating]) -> Image:
    """Near bright, far dark, logarithmic from NEAR_M to FAR_M; NO_DEPTH where there is no value."""
    depth = depth_m_HW.astype(np.float64)
    known = np.isfinite(depth) & (depth > 0)
    log = np.log(np.where(known, depth, FAR_M) / NEAR_M) / math.log(FAR_M / NEAR_M)
    colors = colormaps["inferno"](1 - np.clip(log, 0, 1), bytes=True)[..., :3]
    return np.where(known[..., None], colors, np.array(NO_DEPTH, np.uint8)).astype(np.uint8)


# --- parts ----------------------------------------------------------------------------------------


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
    return _fit(depth_colors(depth_m_HW), exact=True)


def _map(image: Image, ids: NDArray[np.int32], labels: LabelSet) -> Image:
    """Drawn at the tile's size, so that outlines keep their width."""
    small = _fit(image)
    height, width = small.shape[:2]
    return overlay(small, cv2.resize(ids, (width, height), interpolation=cv2.INTER_NEAREST), labels)


def _fit(image: Image, exact: bool = False) -> Image:
    """To the tile's width; `exact` invents no values between pixels."""
    height, width = image.shape[:2]
    size = (TILE, round(height * TILE / width))
    smooth = cv2.INTER_AREA if width > TILE else cv2.INTER_CUBIC
    return np.asarray(
        cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if exact else smooth), np.uint8
    )


def _draw_lines(
    lines: Sequence[Sequence[Image | None]], titles: Sequence[str], smoke: bool, out_dir: Path
) -> None:
    dpi, gap, top = 100, 4, 26 + (20 if smoke else 0)
    height = next(tile.shape[0] for line in lines for tile in line if tile is not None)
    canvas_height = top + len(lines) * (height + gap)
    canvas_width = len(titles) * (TILE + gap)
    canvas = np.full((canvas_height, canvas_width, 3), 255, np.uint8)
    for y, line in enumerate(lines):
        for x, tile in enumerate(line):
            if tile is not None:
                up, left = top + y * (height + gap), x * (TILE + gap)
                canvas[up : up + height, left : left + TILE] = tile
    with styled():
        figure = Figure(figsize=(canvas_width / dpi, canvas_height / dpi), dpi=dpi)
        figure.figimage(canvas, origin="upper")
        for x, title in enumerate(titles):
            center = (x * (TILE + gap) + TILE / 2) / canvas_width
            size = min(9, 245 / len(title))  # a long one fits its tile
            figure.text(center, 1 - (top - 8) / canvas_height, title, ha="center", fontsize=size)
        if smoke:
            figure.text(0.5, 1 - 14 / canvas_height, SMOKE, ha="center", color=GRAY, fontsize=9)
        save(figure, out_dir, "samples", pixels=True)
