"""Look over a tree in KITTI raw's layout: what is there, what is wrong, what it is good for.

Folders are listed, and of each drive's files the first and the last one's headers are read: a full
tree of 95,000 images takes seconds. `deep` decodes every file.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Task
from mtl_bench.data import kitti_files as files
from mtl_bench.data import kitti_splits as splits
from mtl_bench.data import pictures, png, velodyne
from mtl_bench.data.cityscapes_files import check_same_size, read_instance_ids
from mtl_bench.data.kitti import PACKAGES, PSEUDO_LABEL, check_calibrated, other_protocol
from mtl_bench.data.kitti_splits import Frame

_SHOWN = 3  # examples of a problem
_BITS = {"image": 8, "label file": 16, "improved depth map": 16}


@dataclass(frozen=True)
class Problem:
    kind: str
    text: str  # one line that names the file

    def __str__(self) -> str:
        return self.text


@dataclass
class KittiReport:
    """What `check_kitti` found.

    Attributes:
        images: frames that have an image.
        problems: in the order of days and drives.
        days: a line about each day's camera.
        published: frames of each split, in all; `present`, those that are there.
        trainable: frames that can be trained on, by `recipe.data.train_frames`.
        labelled: those of them that have labels.
        truth: test frames by the kind of depth map that they have.
        own_lists: whether the lists of the splits are the tree's.
    """

    root: Path
    images: list[Frame] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    problems: list[Problem] = field(default_factory=list)
    days: list[str] = field(default_factory=list)
    published: dict[str, int] = field(default_factory=dict)
    present: dict[str, int] = field(default_factory=dict)
    trainable: dict[str, int] = field(default_factory=dict)
    labelled: dict[str, int] = field(default_factory=dict)
    truth: Counter[str] = field(default_factory=Counter)
    improved_published: int = 0
    own_lists: bool = False
    predicted_labels: bool = False

    @property
    def dataset(self) -> str:
        """Whose recipes it can run."""
        return "synthetic-kitti" if self.own_lists else "kitti"

    def recipe_lines(self, recipe: Recipe, tasks: Sequence[Task]) -> Iterator[str]:
        """What stands between the tree and a recipe for it, task by task."""
        for task in tasks:
            why = self.obstacle(task, recipe.data.train_frames)
            yield f"recipe {recipe.name}, {task.name}: {why or 'ready'}"

    def obstacle(self, task: Task, choice: str) -> str | None:
        """Why a task cannot be trained and tested; None where nothing is in its way.

        Args:
            choice: of training frames, as `recipe.data.train_frames`.
        """
        count = self.trainable[choice]
        if not count:
            other = self.trainable["all"]
            hint = f"; recipe.data.train_frames=all has {other}" if other else ""
            return f"no frame to train on{hint}"
        if "instance_ids" in task.needs and self.labelled[choice] < count:
            return (
                f"{count - self.labelled[choice]} training frames have no labels; make them with "
                f"'{PSEUDO_LABEL} {self.root}'"
            )
        truths = [metric.truth for metric in task.metrics() if "depth_m" in task.truth]
        lacking = [truth for truth in truths if not self.truth[truth]]
        if lacking:
            others = [kind for kind in PACKAGES if self.truth[kind]]
            hint = f", or {other_protocol(others[0], self.truth[others[0]])}" if others else ""
            return f"no test frame has {lacking[0]} maps; unpack {PACKAGES[lacking[0]]}{hint}"
        return f"{len(self.problems)} problems" if self.problems else None

    def summary(self) -> list[str]:
        """Lines for a terminal."""
        left = sum(frame.camera == "02" for frame in self.images)
        drives = len({frame.drive for frame in self.images})
        what = ("scan", "improved depth map", "label file")
        lines = [
            f"{self.root}: KITTI raw",
            f"days: {len(self.days)}, drives: {drives}, left images: {left}, right images: "
            f"{len(self.images) - left}, "
            + ", ".join(f"{kind}s: {self.counts[kind]}" for kind in what),
            *self.days,
            *self._splits(),
        ]
        for kind, count in Counter(problem.kind for problem in self.problems).items():
            lines.append(f"{count} bad {kind}{'s' * (count > 1)}")
            same = [str(problem) for problem in self.problems if problem.kind == kind]
            lines += [f"  {text}" for text in same[:_SHOWN]]
            lines += [f"  and {count - _SHOWN} more"] if count > _SHOWN else []
        return lines

    def _splits(self) -> Iterator[str]:
        whose = "its own list's" if self.own_lists else "the published"
        for split, count in self.published.items():
            extra = ""
            if split == "train":
                extra = f"; {self.trainable['published']} with both neighbours"
            elif split == "test":
                extra = (
                    f"; {self.truth['improved']} of {self.improved_published} improved depth maps, "
                    f"{self.truth['velodyne']} of {count} scans"
                )
            yield f"{split}: {self.present[split]} of {whose} {count} frames{extra}"
        if not self.own_lists:
            yield f"all with both neighbours, but val's and test's: {self.trainable['all']} frames"
        if self.predicted_labels:
            yield "labels: a network's (mtl-bench pseudo-label); nothing is measured against them"


def check_kitti(root: Path, deep: bool = False) -> KittiReport:
    """Scan a tree.

    Args:
        deep: decode every file, instead of the headers of some.

    Raises:
        ValueError: no such folder, no day in it, or no image.
    """
    tree = files.Tree(root)
    report = KittiReport(root, list(tree.frames()), predicted_labels=tree.predicted_labels)
    if not report.images:
        raise ValueError(
            f"{root}: no image in it; expected KITTI raw's layout, "
            f"<date>/<drive>/image_02/data/<10 digits>.png"
        )
    cameras = _check_days(report, tree)
    _count(report, tree)
    for _, group in groupby(report.images, lambda frame: (frame.drive, frame.camera)):
        frames = list(group)
        for frame in frames if deep else dict.fromkeys((frames[0], frames[-1])):
            _check_frame(report, tree, frame, cameras, deep)
    return report


def _check_days(report: KittiReport, tree: files.Tree) -> dict[tuple[str, str], files.Camera]:
    """Cameras by day and number, of the days whose calibration is in order."""
    cameras = {}
    for date, group in groupby(report.images, lambda frame: frame.date):
        own, folder = list(group), report.root / date
        try:
            for number in splits.CAMERAS.values():
                cameras[date, number] = files.read_camera(folder, number)
            camera = cameras[date, "02"]
            if any(map(tree.has_scan, own)):
                files.scanner_to_pixels(folder, camera)
        except ValueError as error:
            report.problems.append(Problem("calibration", str(error)))
            report.days.append(f"{date}: {len(own)} images, no sound calibration")
            continue
        height, width = camera.size
        report.days.append(
            f"{date}: {len(own)} images of {height}x{width} pixels, focal length "
            f"{camera.K_33[0, 0]:.2f}, baseline {files.baseline_m(folder):.4f} m"
        )
    return cameras


def _count(report: KittiReport, tree: files.Tree) -> None:
    images = set(report.images)
    report.counts["scan"] = len({frame[::2] for frame in images if tree.has_scan(frame)})
    report.counts["improved depth map"] = sum(map(tree.has_improved, images))
    report.counts["label file"] = sum(map(tree.has_labels, images))
    report.own_lists = splits.own_list(report.root, "train") is not None

    listed = {split: splits.frames_of(report.root, split) for split in splits.SPLITS}
    report.published = {split: len(frames) for split, frames in listed.items()}
    report.present = {split: len(images.intersection(own)) for split, own in listed.items()}
    report.improved_published = len(set(listed["test"]) - splits.without_improved())
    test = images.intersection(listed["test"])
    report.truth["improved"] = sum(map(tree.has_improved, test))
    report.truth["velodyne"] = sum(map(tree.has_scan, test))

    kept = {*listed["val"], *listed["test"]}
    for choice, frames in (("published", images.intersection(listed["train"])), ("all", images)):
        own = [f for f in frames if tree.has_neighbours(f) and (f not in kept or choice != "all")]
        report.trainable[choice] = len(own)
        report.labelled[choice] = sum(map(tree.has_labels, own))


def _check_frame(
    report: KittiReport,
    tree: files.Tree,
    frame: Frame,
    cameras: dict[tuple[str, str], files.Camera],
    deep: bool,
) -> None:
    camera = cameras.get((frame.date, frame.camera))
    image = tree.image(frame)
    for kind, path in _files_of(tree, frame):
        try:
            if kind == "scan":
                velodyne.check_length(path, path.stat().st_size)
                continue
            header = pictures.read_header(path)
            png.check_bits(path, header, _BITS[kind])
            size = (header.height, header.width)
            if camera and kind == "image":
                check_calibrated(path, size, camera)
            elif camera:
                check_same_size(path, size, image, camera.size)
            if deep and kind == "label file":
                read_instance_ids(path)
            elif deep and kind == "image":
                pictures.read(path, _BITS[kind])
            elif deep:
                png.read(path, _BITS[kind])
        except ValueError as error:
            report.problems.append(Problem(kind, str(error)))


def _files_of(tree: files.Tree, frame: Frame) -> Iterable[tuple[str, Path]]:
    yield "image", tree.image(frame)
    if tree.has_labels(frame):
        yield "label file", tree.labels(frame)
    if tree.has_improved(frame):
        yield "improved depth map", tree.improved(frame)
    if tree.has_scan(frame) and frame.camera == "02":
        yield "scan", tree.scan(frame)
