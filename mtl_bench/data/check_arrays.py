"""Look over a data set of arrays: counts, shapes, types, ranges, what has no value, and classes.

Headers of all files are read, and the contents of some frames spread over each folder; `deep` reads
all contents.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.dataset import Kind
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Task
from mtl_bench.data._array_folders import (
    FOLDER_OF,
    IMAGE,
    ArrayFolders,
    read_image,
    stems,
    validation,
)

LOOKED_AT = 50  # frames of a folder


@dataclass
class ArrayReport:
    """What `check` found.

    Attributes:
        lines: what the folders hold.
        problems: one line each.
        lacks: of a folder and a field, what is wrong with it.
    """

    kind: type[ArrayFolders]
    root: Path
    lines: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    lacks: dict[tuple[str, str], str] = field(default_factory=dict)

    @property
    def dataset(self) -> str:
        return self.kind.name.replace("_", "-")

    def refuse(self, folder: str, field_: str, why: str) -> None:
        self.problems.append(why)
        self.lacks.setdefault((folder, field_), why)

    def summary(self) -> list[str]:
        return [str(self.root), *self.lines, *(f"wrong: {why}" for why in self.problems)]

    def recipe_lines(self, recipe: Recipe, tasks: Sequence[Task]) -> Iterator[str]:
        """What stands between the data set and a recipe for it, task by task."""
        evaluated = FOLDER_OF[recipe.evaluate.split]
        for task in tasks:
            wanted = [("train", name) for name in (IMAGE, *sorted(task.needs))]
            wanted += [(evaluated, name) for name in (IMAGE, *sorted(task.truth))]
            found = (self.lacks[place] for place in wanted if place in self.lacks)
            yield f"recipe {recipe.name}, {task.name}: {next(found, 'ready')}"


def check(kind: type[ArrayFolders], root: Path, deep: bool = False) -> ArrayReport:
    """Look over the folders `train` and `val`.

    Raises:
        ValueError: a folder without images.
    """
    report = ArrayReport(kind, root)
    for folder in dict.fromkeys(FOLDER_OF.values()):
        names = stems(root / folder / IMAGE)
        split = "train" if folder == "train" else "test"
        published = kind.published.get(split)
        known = f" (published: {published})" if published else ""
        held_out = len(validation(names))
        more = f", {held_out} of them for validation" if folder == "train" else ""
        report.lines.append(f"{folder}: {len(names)} frames{known}{more}")
        _check_field(report, folder, IMAGE, root / folder / IMAGE, names, deep)
        for name in kind.fields:
            place = kind.folder_in(root / folder, name)
            if place is None:
                wanted = " or ".join(kind.folders[name])
                report.refuse(folder, name, f"{root / folder}: no folder {wanted} in it")
            else:
                _check_field(report, folder, name, place, names, deep)
    return report


def _check_field(
    report: ArrayReport, folder: str, name: str, place: Path, names: list[str], deep: bool
) -> None:
    """Add a line on a folder of arrays; its problems are told once for each kind of them."""
    paths = {stem: place / f"{stem}.npy" for stem in names}
    missing = [path for path in paths.values() if not path.is_file()]
    if missing:
        report.refuse(folder, name, f"{missing[0]}: missing{_and_more(len(missing))}")
    there = [path for path in paths.values() if path.is_file()]
    count = len(there) if deep else min(LOOKED_AT, len(there))
    looked_at = [there[i] for i in np.linspace(0, len(there) - 1, count).round().astype(int)]
    found = _Contents(report.kind, name)
    wrong: list[str] = []
    headers: Counter[str] = Counter()
    for path in there:
        try:
            headers[_header(path)] += 1
            if path in looked_at:
                found.add(path)
        except ValueError as error:
            wrong.append(str(error))
    if wrong:
        report.refuse(folder, name, wrong[0] + _and_more(len(wrong)))
    if len(headers) > 1:
        several = ", ".join(headers)
        report.refuse(folder, name, f"{place}: arrays of {len(headers)} kinds: {several}")
    elif found.frames:
        report.lines += [f"  {place.name}: {', '.join(headers)}, {found.values}", *found.shares]


def _header(path: Path) -> str:
    """Type and shape, such as `float32 288x384x3`.

    Raises:
        ValueError: not an array.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{path}: not a whole .npy array ({error})") from None
    return f"{array.dtype} {'x'.join(map(str, array.shape))}"


def _and_more(count: int) -> str:
    return f" (and so are {count - 1} more)" if count > 1 else ""


class _Contents:
    """What the arrays of a folder hold."""

    def __init__(self, kind: type[ArrayFolders], name: str) -> None:
        self.kind, self.name, self.frames = kind, name, 0
        self.low, self.high = np.inf, -np.inf
        self.invalid = self.pixels = 0
        self.classes = np.zeros(len(kind.labels), np.int64)

    def add(self, path: Path) -> None:
        """Raises: ValueError: what is wrong with it."""
        if self.name == IMAGE:
            values, valid = read_image(path), np.ones(1, np.bool_)
        else:
            values = self.kind.read_field(path, self.name)
            valid = self._valid(values)
        known = values[valid] if self.name != IMAGE else values
        self.frames += 1
        self.pixels += valid.size
        self.invalid += int((~valid).sum())
        if known.size:
            self.low, self.high = min(self.low, known.min()), max(self.high, known.max())
        if self.kind.fields.get(self.name) is Kind.IDS:
            self.classes += np.bincount(known, minlength=len(self.classes))

    def _valid(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        kind = self.kind.fields[self.name]
        if kind is Kind.IDS:
            found = values != IGNORE
        else:
            found = values.any(-1) if kind is Kind.NORMALS else values > 0
        return np.asarray(found, np.bool_)

    @property
    def values(self) -> str:
        if self.name == IMAGE:
            return f"colours {self.low:g} .. {self.high:g} of 255"
        share = 100 * self.invalid / self.pixels
        return f"{self.low:.4g} .. {self.high:.4g}, {share:.1f} % without value"

    @property
    def shares(self) -> list[str]:
        """A line on the classes, of labels."""
        if self.kind.fields.get(self.name) is not Kind.IDS:
            return []
        shares = 100 * self.classes / max(self.classes.sum(), 1)
        pairs = zip(self.kind.labels.labels, shares, strict=True)
        return ["    " + ", ".join(f"{label.name} {value:.1f} %" for label, value in pairs)]
