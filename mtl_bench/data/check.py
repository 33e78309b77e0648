"""Look over a whole data set in Cityscapes' layout and report everything that is wrong at once."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from mtl_bench.core.dataset import NEIGHBOURS
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Task
from mtl_bench.data import cityscapes_files as files
from mtl_bench.data import pictures, png
from mtl_bench.data.cityscapes_files import CAMERA, DISPARITY, IMAGE, LABELS, SEQUENCE, Kind

PUBLISHED_FRAMES = {"train": 2975, "val": 500, "test": 1525}  # of the real Cityscapes
# What a run needs of every annotated frame: which split, which fields
NEEDS: dict[str, tuple[str, set[str]]] = {
    "panoptic training": ("train", {"instance_ids"}),
    "depth training": ("train", {NEIGHBOURS}),
    "panoptic evaluation": ("val", {"instance_ids"}),
    "depth evaluation": ("val", {"depth_m"}),
}
_FILES = {"instance_ids": LABELS, "depth_m": DISPARITY, NEIGHBOURS: SEQUENCE}  # fields are from
_KINDS = (IMAGE, LABELS, SEQUENCE, CAMERA, DISPARITY)
_SHOWN = 3  # examples of a problem


@dataclass(frozen=True)
class Problem:
    split: str
    kind: Kind
    group: str  # missing, or bad: what the summary counts by
    text: str  # one line that names the file

    def __str__(self) -> str:
        return self.text


@dataclass
class Report:
    """What `check` found.

    Attributes:
        frames: annotated frames of each split.
        present: files of each (split, folder) that belong to annotated frames.
        problems: all of them, in the order of splits and frames.
        unlabelled: training frames of the videos that pseudo labels can be made for.
        reprojection_mask: where the depth task's masks come from, see `Cityscapes`.
    """

    root: Path
    frames: dict[str, int] = field(default_factory=dict)
    present: Counter[tuple[str, str]] = field(default_factory=Counter)
    problems: list[Problem] = field(default_factory=list)
    unlabelled: int = 0
    reprojection_mask: str = "labels"
    size: tuple[int, int] = (0, 0)  # of an image, height and width

    def obstacle(self, purpose: str) -> str | None:
        """Why a purpose of NEEDS is out of reach; None where nothing is in its way."""
        return self._lack(*NEEDS[purpose])

    def _lack(self, split: str, fields: Collection[str]) -> str | None:
        """What of these fields a split lacks."""
        kinds = (IMAGE, *(_FILES[name] for name in sorted(fields)))
        kinds += () if fields == {"instance_ids"} else (CAMERA,)  # as `Dataset.needs_camera`
        if not self.frames.get(split):
            return f"no frames in {IMAGE.folder}/{split}"
        for kind in kinds:
            if not self.present[split, kind.folder]:
                return f"no {kind.folder}/{split}; unpack {kind.package}"
        if NEIGHBOURS in fields and self.reprojection_mask != "labels":
            kinds = (*kinds, files.EGO_MASK)
        count = sum(p.split == split and p.kind in kinds for p in self.problems)
        return f"{count} problem{'s' * (count > 1)}" if count else None

    dataset: ClassVar[str] = "cityscapes"  # whose recipes it can run

    def recipe_lines(self, recipe: Recipe, tasks: Sequence[Task]) -> Iterator[str]:
        """What stands between the data set and a recipe for it, task by task."""
        data = recipe.data
        if self.size < (data.height, data.width):
            own = "{}x{}".format(*self.size)
            yield f"recipe {recipe.name}: frames of {own} are smaller than its input"
            return
        for task in tasks:
            found = [self._lack("train", task.needs), self._lack("val", task.truth)]
            found += [
                f"protocol {metric.prefix.removesuffix('.')}: no {DISPARITY.folder}/{metric.split}"
                for metric in task.metrics()
                if metric.prefix and not (self.root / DISPARITY.folder / metric.split).is_dir()
            ]
            yield f"recipe {recipe.name}, {task.name}: {next(filter(None, found), 'ready')}"
        stage = f"{self.unlabelled} frames to label" if self.unlabelled else "no frame to label"
        yield f"recipe {recipe.name}, --video: {stage}"

    def summary(self) -> list[str]:
        """Lines for a terminal: counts, problems with examples, what the data set is good for."""
        lines = [str(self.root)]
        for split, count in self.frames.items():
            others = ", ".join(f"{self.present[split, k.folder]} {k.what}s" for k in _KINDS[1:])
            published = PUBLISHED_FRAMES.get(split)
            known = f" (Cityscapes: {published})" if published else ""
            lines.append(f"{split}: {count} frames{known}, {others}" if count else f"{split}: none")
        groups = Counter((p.split, p.group, p.kind) for p in self.problems)
        for (split, group, kind), count in groups.items():
            lines.append(f"{split}: {count} {group} {kind.what}{'s' * (count > 1)}")
            same = [
                str(p) for p in self.problems if (p.split, p.group, p.kind) == (split, group, kind)
            ]
            lines += [f"  {text}" for text in same[:_SHOWN]]
            lines += [f"  and {count - _SHOWN} more"] if count > _SHOWN else []
        for purpose, (split, _) in NEEDS.items():
            if split in self.frames:
                lines.append(f"{purpose}: {self.obstacle(purpose) or 'ready'}")
        return lines + self._without_labels()

    def _without_labels(self) -> list[str]:
        """What can be done with training frames that have no labels."""
        if not self.frames.get("train"):
            return []
        mask = self.reprojection_mask
        lines = []
        if not self.present["train", LABELS.folder]:
            lines.append("without labels: only depth can be trained")
        if mask != "labels":
            hint = f"; {files.EGO_MASK.suffix} would mask the ego vehicle"
            hint = "" if files.EGO_MASK.suffix in mask else hint
            lines.append(f"reprojection mask: {mask}, with the auto-mask{hint}")
        return [*lines, f"pseudo labels: {self.unlabelled} training frames could get them"]


def check(root: Path, splits: tuple[str, ...] = ("train", "val"), deep: bool = False) -> Report:
    """Scan a data set: missing files, sizes, bit depths, truncated files, camera values.

    A package of which a split has no file at all counts as not unpacked, not as that many problems.

    Args:
        root: the folder that holds leftImg8bit, gtFine, ...
        splits: which splits to look at.
        deep: decode every image as well: damaged contents and unknown label ids.

    Raises:
        ValueError: the folder is missing, unreadable or holds no frame of any split.
    """
    report = Report(root)
    some = [split for split in splits if (root / IMAGE.folder / split).is_dir()]
    for split in some or splits[:1]:  # with none, the first one's error tells what is wrong
        names = files.annotated_names(root, split)
        report.frames[split] = len(names)
        _check_split(report, split, names, deep)
        if split == "train":
            report.unlabelled = len(files.unlabelled_names(root, split))
            _check_ego_mask(report, names)
    report.frames |= {split: 0 for split in splits if split not in some}
    return report


def _check_split(report: Report, split: str, names: list[str], deep: bool) -> None:
    folders = {kind: report.root / kind.folder / split for kind in _KINDS}
    listed = {kind: files.names_in(folder, kind) for kind, folder in folders.items()}
    for name in names:
        image_path = files.file_of(folders[IMAGE], IMAGE, name)
        size: tuple[int, int] | None = None  # of the image; unknown where it is broken
        for kind in _KINDS:
            steps = (-1, 1) if kind is SEQUENCE else (0,)
            for wanted in (files.neighbour(name, step) for step in steps):
                path = files.file_of(folders[kind], kind, wanted)
                if wanted not in listed[kind]:
                    if listed[kind]:
                        text = f"{path}: missing; unpack {kind.package}"
                        report.problems.append(Problem(split, kind, "missing", text))
                    continue
                report.present[split, kind.folder] += 1
                try:
                    own_size = _check_file(path, kind, deep)
                    if own_size and size:
                        files.check_same_size(path, own_size, image_path, size)
                    if kind is IMAGE and own_size:
                        report.size = size = own_size
                except ValueError as error:
                    report.problems.append(Problem(split, kind, "bad", str(error)))


def _check_ego_mask(report: Report, names: list[str]) -> None:
    """It is in use where a training frame lacks labels; one image stands for all."""
    path = report.root / files.EGO_MASK.suffix
    labelled = report.present["train", LABELS.folder]
    report.reprojection_mask = files.reprojection_mask(len(names), labelled, path.exists())
    if labelled == len(names) or not path.exists():
        return
    image_path = files.file_of(report.root / IMAGE.folder / "train", IMAGE, names[0])
    try:
        size = files.read_ego_mask(path).shape
        image = pictures.read_header(image_path)
        files.check_same_size(path, size, image_path, (image.height, image.width))
    except ValueError as error:
        if not any(str(problem) == str(error) for problem in report.problems):
            report.problems.append(Problem("train", files.EGO_MASK, "bad", str(error)))


def _check_file(path: Path, kind: Kind, deep: bool) -> tuple[int, int] | None:
    """Height and width of an image file, None of a camera.

    Raises:
        ValueError: what is wrong with the file.
    """
    if kind is CAMERA:
        files.read_camera(path)
        return None
    assert kind.bits is not None
    header = pictures.read_header(path)
    png.check_bits(path, header, kind.bits)
    if deep and kind is LABELS:
        files.read_instance_ids(path)
    elif deep and kind.bits == 8:
        pictures.read(path, kind.bits)
    elif deep:
        png.read(path, kind.bits)
    return header.height, header.width
