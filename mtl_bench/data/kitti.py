"""KITTI raw as samples, on the Eigen-Zhou split or on all of a tree's frames.

What samples hold is as for Cityscapes. Frames differ in size from day to day by up to 2 %: all are
resized to the recipe's input, each axis by its own factor, intrinsics and labels with them (MGNet
keeps the shape and pads to 384 x 1280 instead). Ground truth stays at the frame's own size.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import NEIGHBOURS, Dataset, DecodedFrame, Kind, LabelFrames, Report
from mtl_bench.core.recipe import Recipe
from mtl_bench.data import frame_cache, velodyne
from mtl_bench.data import kitti_files as files
from mtl_bench.data import kitti_splits as splits
from mtl_bench.data.augment import scale
from mtl_bench.data.cityscapes_files import (
    EGO_ID,
    SKY_ID,
    check_same_size,
    read_instance_ids,
    reprojection_mask,
)
from mtl_bench.data.frame_cache import FrameCache, Source
from mtl_bench.data.kitti_splits import Frame
from mtl_bench.data.labels import CITYSCAPES19
from mtl_bench.data.motion import moving
from mtl_bench.data.png import to_size
from mtl_bench.data.pseudo_frames import KittiFrames

# Which depth maps a frame may have, the first that exists wins
TRUTHS = {
    "default": ("improved", "velodyne"),
    "improved": ("improved",),
    "velodyne": ("velodyne",),
}
PACKAGES = {
    "improved": f"{files.DEPTH_PACKAGE}.zip into it or beside it",
    "velodyne": "the drives' velodyne_points",
}
PROTOCOLS = {"improved": "eigen-improved", "velodyne": "eigen-raw"}  # that measure on them
PSEUDO_LABEL = "mtl-bench pseudo-label --checkpoint CITYSCAPES_RUN --data"


class Kitti(Dataset):
    """One split: those of its frames that the tree has.

    Label files, which `mtl-bench pseudo-label` writes, are training targets and mask the sky. They
    are ground truth too where they are no network's: in the built-in data.

    Args:
        root: the folder that holds 2011_09_26, ...
        split: train, val or test. Training frames need both neighbours: others are left out.
        data: input size, and by `train_frames` whether the published frames train or all that
            neither val nor test has.
        needs: with "instance_ids", training frames must have labels. Without it they only mask
            what does not move, where they exist.
        truth: depth maps to evaluate on: `improved`, `velodyne` (projected scans), or `default`,
            improved where a frame has one, else velodyne. Frames without are left out.

    Attributes:
        published_frames: how many the split has as published, with this truth.
        left_out: frames of the split that are not in use, by why.
        truth_counts: frames in use by their depth map's kind.

    Raises:
        ValueError: no frame of the split is there, or frames lack labels or calibration.
    """

    labels = CITYSCAPES19
    fields: ClassVar[Mapping[str, Kind]] = {"instance_ids": Kind.IDS, "depth_m": Kind.DEPTH}
    truths: ClassVar[tuple[str, ...]] = ("improved", "velodyne")
    static_ids: ClassVar[tuple[int, ...]] = (EGO_ID, SKY_ID)
    layout = "KITTI raw"
    marks = "days such as 2011_09_26/"

    def open_split(self) -> None:
        root = self.root
        self.on_disk = FrameCache(root, self.data, self._to_input)
        self.tree = files.Tree(root)
        self.left_out: Counter[str] = Counter()
        frames = self._present()
        if self._compares and self.data.min_flow > 0:
            frames = self._moving(frames)
        if "depth_m" in self.needs:
            frames = self._with_truth(frames, self.truth)
        self._frames = {frame.name: frame for frame in frames}
        self.names = list(self._frames)
        self._label_files = {
            frame.name: self.tree.labels(frame) for frame in frames if self.tree.has_labels(frame)
        }
        if self.training and "instance_ids" in self.needs:
            self._require_labels()
        self._cameras = {
            (date, camera): files.read_camera(root / date, camera)
            for date, camera in {(frame.date, frame.camera) for frame in frames}
            if self.needs_camera or files.is_calibrated(root / date)
        }

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return root.is_dir() and any(files.is_date(path.name) for path in root.iterdir())

    @classmethod
    def check(cls, root: Path, deep: bool = False) -> Report:
        from mtl_bench.data.check_kitti import check_kitti

        return check_kitti(root, deep=deep)

    @classmethod
    def image_files(cls, root: Path, split: str) -> dict[str, Path]:
        tree = files.Tree(root)
        listed = splits.frames_of(root, split)
        found = {frame.name: tree.image(frame) for frame in listed if tree.has_image(frame)}
        if not found:
            raise ValueError(f"{root}: no frame of split '{split}' is there")
        return found

    @classmethod
    def frames_to_label(
        cls, root: Path, out: Path | None, split: str, recipe: Recipe
    ) -> LabelFrames:
        """All of the split that have an image, or with the split "all" every frame."""
        return KittiFrames(root, out, split, recipe)

    @property
    def _compares(self) -> bool:
        """Whether training frames are compared with their neighbours in time."""
        return self.training and NEIGHBOURS in self.needs

    @property
    def static_from(self) -> str:
        """Labels, none, or both."""
        return reprojection_mask(len(self.names), len(self._label_files), False)

    @property
    def knows_static(self) -> bool:
        """Only labels know where the sky is."""
        return self.static_from == "labels"

    @property
    def described(self) -> dict[str, Any]:
        """What a row says of the frames: how many of the published ones, and the truth's kinds."""
        of_all = self.split == "train" and self.data.train_frames == "all"
        return {
            "frames": len(self),
            "frames_published": None if of_all else self.published_frames,
            **({"left_out": dict(self.left_out)} if self.left_out else {}),
            **({"depth_truth": dict(self.truth_counts)} if self.truth_counts else {}),
        }

    def sources(self) -> list[Source]:
        """The files that samples are made of and that `on_disk` can hold."""
        frames = set(self._frames.values())
        if self._compares:
            frames |= {beside for frame in frames for beside in self._around(frame)}
        sources = [(self.tree.image(frame), frame_cache.IMAGE) for frame in sorted(frames)]
        labels = [
            (path, frame_cache.LABELS) for path in self._label_files.values() if self.training
        ]
        return sources + labels

    def paths(self) -> Iterator[Path]:
        """The files of its frames, their truth's and their days' calibration."""
        yield from (path for path, _ in self.sources())
        for date in {frame.date for frame in self._frames.values()}:
            yield from (self.root / date).glob("calib_*.txt")
        yield from () if self.training else self._label_files.values()
        if "depth_m" in self.needs:
            of = {"improved": self.tree.improved, "velodyne": self.tree.scan}
            yield from (of[self._truth[frame]](frame) for frame in self._frames.values())

    # --- which frames -----------------------------------------------------------------------------

    def _present(self) -> list[Frame]:
        """The split's frames that are there, in training with both neighbours."""
        self.truth_counts: Counter[str] = Counter()
        wanted = splits.frames_of(self.root, self.split)
        self.published_frames = len(wanted)
        choice = self.data.train_frames
        if self.split == "train" and choice == "all":
            present = self._of_no_list("val", "test")
        else:
            present = [frame for frame in wanted if self.tree.has_image(frame)]
            self._leave_out("absent", len(wanted) - len(present))
        frames = present
        if self.split == "train":
            frames = [
                frame for frame in present if self.tree.has_neighbours(frame, self.data.stride)
            ]
            self._leave_out("without neighbours", len(present) - len(frames))
        if not frames:
            raise ValueError(self._nothing(choice))
        return frames

    def _around(self, frame: Frame) -> list[Frame]:
        """The frame before and the one after."""
        return [frame.later(step) for step in (-self.data.stride, self.data.stride)]

    def _moving(self, frames: list[Frame]) -> list[Frame]:
        pairs = {}
        for frame in frames:
            before, image, after = map(self.tree.image, sorted([frame, *self._around(frame)]))
            pairs[frame.name] = ((before, image), (image, after))
        kept = set(
            moving(pairs, self.data, lambda p: self.on_disk.read(p, frame_cache.IMAGE).pixels)
        )
        self._leave_out("standing", len(frames) - len(kept))
        return [frame for frame in frames if frame.name in kept]

    def _of_no_list(self, *others: str) -> list[Frame]:
        kept = {frame for split in others for frame in splits.frames_of(self.root, split)}
        return [frame for frame in self.tree.frames() if frame not in kept]

    def _leave_out(self, why: str, count: int) -> None:
        if count:
            self.left_out[why] = count

    def _nothing(self, choice: str) -> str:
        see = f"see 'mtl-bench data check {self.root}'"
        if self.left_out["without neighbours"] and self.data.stride > 1:
            see = f"lower recipe.data.stride = {self.data.stride}, or {see}"
        if self.split == "train" and choice == "all":
            return f"{self.root}: no frame to train on that has both neighbours; {see}"
        advice = f"unpack the drives that have them, {see}"
        if self.split == "train":
            advice += ", or set recipe.data.train_frames=all to train on what is there"
        count = self.published_frames
        return f"{self.root}: none of the {count} frames of the split {self.split}; {advice}"

    def _with_truth(self, frames: list[Frame], truth: str) -> list[Frame]:
        if truth == "improved":
            listed = splits.frames_of(self.root, self.split)
            self.published_frames -= len(splits.without_improved().intersection(listed))
        has = {"improved": self.tree.has_improved, "velodyne": self.tree.has_scan}
        found = {
            frame: next((kind for kind in TRUTHS[truth] if has[kind](frame)), None)
            for frame in frames
        }
        self._truth = {frame: kind for frame, kind in found.items() if kind}
        self.truth_counts = Counter(self._truth.values())
        self._leave_out("without depth maps", len(frames) - len(self._truth))
        if not self._truth:
            wanted = TRUTHS[truth]
            others = {kind: sum(map(has[kind], frames)) for kind in has if kind not in wanted}
            hints = [f"unpack {PACKAGES[kind]}" for kind in wanted]
            hints += [other_protocol(kind, count) for kind, count in others.items() if count]
            raise ValueError(
                f"{self.root}: none of its {len(frames)} frames of {self.split} has a depth map "
                f"({' or '.join(wanted)}); {', or '.join(hints)}"
            )
        return list(self._truth)

    def _require_labels(self) -> None:
        missing = [name for name in self.names if name not in self._label_files]
        if missing:
            raise ValueError(
                f"{self.tree.labels(self._frames[missing[0]])}: missing, one of {len(missing)} "
                f"label files that the panoptic task needs; make them with "
                f"'{PSEUDO_LABEL} {self.root}'"
            )

    # --- decoding ---------------------------------------------------------------------------------

    def read(self, name: str) -> DecodedFrame:
        frame = self._frames[name]
        path = self.tree.image(frame)
        camera = self._cameras.get((frame.date, frame.camera))
        images = [self.on_disk.read(path, frame_cache.IMAGE)]
        size = (images[0].own_size[0], images[0].own_size[1])
        K_33 = None
        if camera is not None:
            check_calibrated(path, size, camera)
            K = torch.from_numpy(camera.K_33).float()
            K_33 = scale(K, self.data.width / size[1], self.data.height / size[0])
        if self._compares:
            around = [self.tree.image(beside) for beside in self._around(frame)]
            whole = (path, size)
            images += [self.on_disk.read(beside, frame_cache.IMAGE, whole) for beside in around]
        fields: dict[str, torch.Tensor] = {}
        ids = self._read_labels(frame, path, size)
        ids_HW = None if ids is None else torch.from_numpy(ids.astype(np.int32))
        if ids_HW is not None and ("instance_ids" in self.needs or not self.training):
            fields["instance_ids"] = ids_HW
        if "depth_m" in self.needs:
            assert camera is not None
            depth_m = self._read_depth_m(frame, path, camera)
            if self.training:
                depth_m = self._to_input(depth_m, path, cv2.INTER_NEAREST_EXACT)
            fields["depth_m"] = torch.from_numpy(depth_m)
        return DecodedFrame(
            images_N3HW=[torch.from_numpy(image.pixels).permute(2, 0, 1) for image in images],
            K_33=K_33,
            camera_height_m=files.CAMERA_HEIGHT_M,
            fields=fields,
            static=ids_HW if self.training else None,
        )

    def _read_labels(
        self, frame: Frame, path: Path, size: tuple[int, int]
    ) -> NDArray[np.uint16] | None:
        """At the input's size in training; in evaluation only true ones, which all frames have."""
        true = len(self._label_files) == len(self) and not self.tree.predicted_labels
        if frame.name not in self._label_files or not (self.training or true):
            return None
        label_path = self._label_files[frame.name]
        if self.training:
            found: NDArray[np.uint16] | None = self.on_disk.read(
                label_path, frame_cache.LABELS, (path, size)
            ).pixels
            return found
        ids = read_instance_ids(label_path)
        check_same_size(label_path, ids.shape, path, size)
        return ids

    def _read_depth_m(self, frame: Frame, path: Path, camera: files.Camera) -> NDArray[np.float32]:
        if self._truth[frame] == "velodyne":
            project_34 = files.scanner_to_pixels(self.root / frame.date, camera)
            return velodyne.depth_map(
                velodyne.read_scan(self.tree.scan(frame)), project_34, camera.size
            )
        depth_path = self.tree.improved(frame)
        depth_m = files.read_improved_m(depth_path)
        check_same_size(depth_path, depth_m.shape, path, camera.size)
        return depth_m

    def _to_input(self, array: NDArray[Any], path: Path, interpolation: int) -> NDArray[Any]:
        return to_size(array, self.data.height, self.data.width, interpolation)


def other_protocol(truth: str, count: int) -> str:
    """What to set where these depth maps are there, and those that were asked for are not."""
    return (
        f"measure on the {truth} maps that {count} frames have: "
        f"--set recipe.evaluate.protocol={PROTOCOLS[truth]} --set recipe.evaluate.also=[]"
    )


def check_calibrated(path: Path, size: tuple[int, ...], camera: files.Camera) -> None:
    """Raises: ValueError where an image has not the size that its day's calibration is for."""
    if tuple(size) != camera.size:
        raise ValueError(
            f"{path}: {size[0]}x{size[1]} pixels, but the day's calibration is for "
            f"{camera.size[0]}x{camera.size[1]}; use KITTI's rectified images (sync) unchanged"
        )
