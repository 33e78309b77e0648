"""The published lists of KITTI's frames, and lists that a tree brings along.

Kept small as text: a line has a drive, its cameras (l: 02, r: 03) and runs of frame numbers.

    zhou.txt           training and validation frames of Zhou et al. (CVPR 2017), both cameras
    val.txt            those of them that validate; the others train
    test.txt           Eigen et al. (NeurIPS 2014)
    not_improved.txt   test frames that have no improved depth map

A data set in KITTI's layout that has none of KITTI's days, such as the built-in one, brings its
own lists, `<root>/data_splits/eigen_{zhou,val,test}_files.txt`. A line begins with an image's path,
as in PackNet's: `2000_01_01/2000_01_01_drive_0022_sync/image_03/data/0000000473.png`.
"""

import re
from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parent
SPLITS = ("train", "val", "test")
DATES = ("2011_09_26", "2011_09_28", "2011_09_29", "2011_09_30", "2011_10_03")
_OWN = {"train": "eigen_zhou_files", "val": "eigen_val_files", "test": "eigen_test_files"}
CAMERAS = {"l": "02", "r": "03"}
_LETTERS = {camera: letter for letter, camera in CAMERAS.items()}
_LINE = re.compile(
    r"(?P<date>[\d_]{10})/(?P<drive>(?P=date)[^/\s]+)/image_(?P<camera>02|03)/data/"
    r"(?P<number>\d{10})\.(png|jpe?g)(\s.*)?"
)


class Frame(NamedTuple):
    """One image; the order is by drive, camera and time."""

    drive: str  # 2011_09_26_drive_0022_sync
    camera: str  # 02 left, 03 right
    number: int

    @property
    def date(self) -> str:
        """2011_09_26"""
        return self.drive[:10]

    @property
    def name(self) -> str:
        """2011_09_26_drive_0022_sync_03_0000000473"""
        return f"{self.drive}_{self.camera}_{self.number:010d}"

    def later(self, step: int) -> "Frame":
        """The frame of that many steps of time later."""
        return self._replace(number=self.number + step)


@cache
def published(split: str) -> tuple[Frame, ...]:
    """The published frames of train, val or test, in order.

    Raises:
        ValueError: another split.
    """
    if split == "train":
        return tuple(sorted(_read("zhou").difference(published("val"))))
    if split not in SPLITS:
        raise ValueError(f"no split '{split}' of KITTI; there are {', '.join(SPLITS)}")
    return tuple(sorted(_read(split)))


@cache
def without_improved() -> frozenset[Frame]:
    """Published test frames for which no improved depth map exists."""
    return frozenset(_read("not_improved"))


def frames_of(root: Path, split: str) -> tuple[Frame, ...]:
    """The frames of a split: of the tree's own list where it has one, else the published ones.

    Raises:
        ValueError: no such split, or a line of the tree's list that names no frame.
    """
    path = own_list(root, split)
    if path is None:
        return published(split)
    frames = set()
    for number, line in enumerate(path.read_text().splitlines(), 1):
        match = _LINE.fullmatch(line.strip())
        if match is None:
            raise ValueError(
                f"{path}: line {number} is '{line}', not an image's path such as "
                f"2000_01_01/2000_01_01_drive_0001_sync/image_02/data/0000000001.png"
            )
        frames.add(Frame(match["drive"], match["camera"], int(match["number"])))
    return tuple(sorted(frames))


def own_list(root: Path, split: str) -> Path | None:
    """The tree's own list of a split, where it has one and is not KITTI."""
    path = root / "data_splits" / f"{_OWN.get(split)}.txt"
    kitti = any((root / date).is_dir() for date in DATES)
    return path if path.is_file() and not kitti else None


# --- the packed form ------------------------------------------------------------------------------


def _read(name: str) -> set[Frame]:
    lines = (FOLDER / f"{name}.txt").read_text().splitlines()
    return set(unpack(line for line in lines if not line.startswith("#")))


def unpack(lines: Iterable[str]) -> Iterable[Frame]:
    """`2011_09_26_drive_0001_sync lr 5-9,12` is frames 5 to 9 and 12, of both cameras."""
    for line in lines:
        drive, sides, runs = line.split()
        for run in runs.split(","):
            first, _, last = run.partition("-")
            for number in range(int(first), int(last or first) + 1):
                yield from (Frame(drive, CAMERAS[side], number) for side in sides)


def pack(frames: Iterable[Frame]) -> list[str]:
    """The inverse of `unpack`; how the files of this folder were made from the published lists."""
    numbers = defaultdict(set)
    for frame in frames:
        numbers[frame.drive, _LETTERS[frame.camera]].add(frame.number)
    lines = []
    for drive, side in sorted(numbers):
        other = numbers.get((drive, "lr".replace(side, "")))
        same = numbers[drive, side] == other
        if not (same and side == "r"):
            lines.append(f"{drive} {'lr' if same else side} {_runs(numbers[drive, side])}")
    return lines


def _runs(numbers: set[int]) -> str:
    runs = []
    for first in sorted(n for n in numbers if n - 1 not in numbers):
        last = first
        while last + 1 in numbers:
            last += 1
        runs.append(f"{first}-{last}" if last > first else str(first))
    return ",".join(runs)
