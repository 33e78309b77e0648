"""Cityscapes as samples: the real one and anything in its layout.

A training sample is an augmented frame, its neighbours in time where a task needs them, and the
panoptic targets; an evaluation sample is the plain frame with ground truth at the frame's own size.
Frames larger than the recipe's input are shrunk to it, intrinsics and labels with them: on every
reading, or once where `mtl-bench data cache` wrote them down.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from mtl_bench.core import config
from mtl_bench.data import cityscapes_files as files
from mtl_bench.data import frame_cache
from mtl_bench.data.augment import augment as draw_augmented
from mtl_bench.data.augment import scale
from mtl_bench.data.batch import Batch
from mtl_bench.data.cityscapes_files import CAMERA, DISPARITY, IMAGE, LABELS, SEQUENCE, Kind
from mtl_bench.data.frame_cache import FrameCache, Source
from mtl_bench.data.labels import CITYSCAPES20, LabelSet
from mtl_bench.tasks.panoptic.targets import OUTSIDE, panoptic_targets

NOT_REPROJECTED = torch.tensor([files.EGO_ID, files.SKY_ID, OUTSIDE])
PLAIN = config.Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)


@dataclass(frozen=True)
class DecodedFrame:
    """What is kept of a decoded frame; everything random comes later."""

    images_N3HW: Sequence[Tensor]  # uint8, input size; in training followed by previous and next
    K_33: Tensor
    camera_height_m: float
    camera_pitch_rad: float
    instance_ids: Tensor | None  # int32; input size in training, own size in evaluation
    depth_m: Tensor | None


class Cityscapes:
    """One split.

    Frames without labels, which the depth task trains on, too, may share `<root>/ego_mask.png`: of
    the frames' own size, 8 bits, not 0 on the ego vehicle and whatever else has nothing to tell.

    Args:
        root: the folder that holds leftImg8bit, gtFine, camera, ...
        split: train, val or test.
        data: input size and whether decoded frames stay in memory.
        labels: the classes.
        video: the depth task: neighbours in training, disparity maps in evaluation.
        panoptic: the panoptic task: label files are a must. Without it they only mask the
            reprojection, where they exist.
        augment: random changes of training samples; None for a split that is only evaluated, of
            which no neighbour is needed.
        loss: what the targets depend on.
        sequence_labels: a folder `<city>/*_gtFine_instanceIds.png` with labels of further frames
            of `leftImg8bit_sequence`, which then are training frames too (human labels win).

    Raises:
        ValueError: no frames, or frames that lack a file, the first one named.
    """

    def __init__(
        self,
        root: Path,
        split: str,
        data: config.Data,
        labels: LabelSet = CITYSCAPES20,
        *,
        video: bool,
        panoptic: bool,
        augment: config.Augment | None,
        loss: config.Loss,
        sequence_labels: Path | None = None,
    ) -> None:
        self.root, self.split, self.data, self.labels = root, split, data, labels
        self.video, self.panoptic, self.loss = video, panoptic, loss
        self.sequence_labels = sequence_labels
        self._augment = augment or PLAIN
        self._cache: dict[tuple[int, bool], DecodedFrame] | None = {} if data.cache else None
        self.on_disk = FrameCache(root, data, self._to_input)
        self.names = files.annotated_names(root, split)
        self._annotated = frozenset(self.names)
        self._label_files = self._find_labels()
        if sequence_labels:
            self.names = self._with_sequence_frames()
        mask_path = root / files.EGO_MASK.suffix
        masked = video and augment is not None and not self._annotated <= self._label_files.keys()
        self._ego_mask = files.read_ego_mask(mask_path) if masked and mask_path.exists() else None
        self._camera_names = self._find_cameras()
        self._require_files(training=augment is not None)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def reprojection_mask(self) -> str:
        """What the training frames' masks come from: labels, ego_mask.png, none, or two of them."""
        labelled = len(self._label_files.keys() & set(self.names))
        return files.reprojection_mask(len(self.names), labelled, self._ego_mask is not None)

    @property
    def needs_automask(self) -> bool:
        """Whether masks may leave the sky in: only labels know where it is."""
        return self.reprojection_mask != "labels"

    def sources(self, training: bool) -> list[Source]:
        """The files that samples are made of and that `on_disk` can hold."""
        images = [self._image_file(name) for name in self.names]
        if training and self.video:
            around = {files.neighbour(name, step) for name in self.names for step in (-1, 1)}
            images += sorted({self._file(SEQUENCE, name) for name in around}.difference(images))
        labels = [self._label_files[name] for name in self.names if name in self._label_files]
        sources = [(path, frame_cache.IMAGE) for path in images]
        return sources + [(path, frame_cache.LABELS) for path in labels if training]

    def uncached(self) -> "Cityscapes":
        """The same split, remembering nothing: for worker processes, which would each hold it."""
        other = copy.copy(self)
        other._cache = None
        other.on_disk = FrameCache(self.root, self.data, other._to_input)
        return other

    def sample(self, index: int, generator: Generator | None) -> Batch:
        """One sample, tensors without the B axis.

        Args:
            index: position in `names`.
            generator: source of the augmentation; None for an evaluation sample.

        Raises:
            ValueError: a file of the frame is missing, damaged or does not fit the others.
        """
        training = generator is not None
        frame = self._cache.get((index, training)) if self._cache is not None else None
        if frame is None:
            frame = self._read(self.names[index], training)
            if self._cache is not None:
                self._cache[index, training] = frame
        if generator is None:
            return self._evaluation_sample(self.names[index], frame)
        return self._training_sample(self.names[index], frame, generator)

    # --- samples ----------------------------------------------------------------------------------

    def _evaluation_sample(self, name: str, frame: DecodedFrame) -> Batch:
        return Batch(
            names=[name],
            image_B3HW=frame.images_N3HW[0].contiguous().float() / 255,
            K_B33=frame.K_33,
            camera_height_m_B=torch.tensor(frame.camera_height_m),
            camera_pitch_rad_B=torch.tensor(frame.camera_pitch_rad),
            instance_ids_BHW=frame.instance_ids,
            depth_m_BHW=frame.depth_m,
        )

    def _training_sample(self, name: str, frame: DecodedFrame, generator: Generator) -> Batch:
        ids = frame.instance_ids
        if ids is None:  # no label file: unlabeled everywhere, so that padding can still be marked
            ids = torch.zeros(frame.images_N3HW[0].shape[-2:], dtype=torch.int32)
        view = draw_augmented(frame.images_N3HW, frame.K_33, ids, self._augment, generator)
        batch = Batch(
            names=[name],
            image_B3HW=view.jittered_N3HW[0],
            K_B33=view.K_33,
            camera_height_m_B=torch.tensor(frame.camera_height_m),
            camera_pitch_rad_B=torch.tensor(frame.camera_pitch_rad),
        )
        if self.video:
            batch.context_BN3HW = view.jittered_N3HW[1:]
            batch.clean_B3HW = view.clean_N3HW[0]
            batch.clean_context_BN3HW = view.clean_N3HW[1:]
            batch.reprojection_mask_BHW = ~torch.isin(view.instance_ids_HW, NOT_REPROJECTED)
        if self.panoptic:
            targets = panoptic_targets(view.instance_ids_HW.numpy(), self.labels, self.loss)
            batch.semantic_BHW = torch.from_numpy(targets.semantic)
            batch.semantic_weight_BHW = torch.from_numpy(targets.semantic_weight)
            batch.center_B1HW = torch.from_numpy(targets.center)[None]
            batch.center_weight_B1HW = torch.from_numpy(targets.center_weight)[None]
            batch.offset_B2HW = torch.from_numpy(targets.offset)
            batch.offset_weight_B1HW = torch.from_numpy(targets.offset_weight)[None]
        return batch

    # --- decoding ---------------------------------------------------------------------------------

    def _read(self, name: str, training: bool) -> DecodedFrame:
        path = self._image_file(name)
        images = [self.on_disk.read(path, frame_cache.IMAGE)]
        own_size = images[0].own_size
        frame = (path, own_size)
        if training and self.video:
            around = [self._file(SEQUENCE, files.neighbour(name, step)) for step in (-1, 1)]
            images += [self.on_disk.read(beside, frame_cache.IMAGE, frame) for beside in around]
        camera = files.read_camera(self._file(CAMERA, self._camera_names[name]))
        K = torch.tensor([[camera.fx, 0, camera.u0], [0, camera.fy, camera.v0], [0, 0, 1]])

        ids = depth_m = None
        if self.panoptic or (name in self._label_files and (self.video or not training)):
            label_path = self._label_files[name]
            if training:
                ids = self.on_disk.read(label_path, frame_cache.LABELS, frame).pixels
            else:
                ids = files.read_instance_ids(label_path)
                files.check_same_size(label_path, ids.shape, *frame)
        elif training and self.video and self._ego_mask is not None:
            ids = self._ego_mask
            files.check_same_size(self.root / files.EGO_MASK.suffix, ids.shape, *frame)
            ids = self._to_input(ids, path, cv2.INTER_NEAREST_EXACT)
        if self.video and not training:
            depth_path = self._file(DISPARITY, name)
            depth_m = files.read_depth_m(depth_path, camera)
            files.check_same_size(depth_path, depth_m.shape, *frame)

        return DecodedFrame(
            images_N3HW=[torch.from_numpy(image.pixels).permute(2, 0, 1) for image in images],
            K_33=scale(K, self.data.width / own_size[1], self.data.height / own_size[0]),
            camera_height_m=camera.height_m,
            camera_pitch_rad=camera.pitch_rad,
            instance_ids=None if ids is None else torch.from_numpy(ids.astype(np.int32)),
            depth_m=None if depth_m is None else torch.from_numpy(depth_m),
        )

    def _to_input(self, array: NDArray, path: Path, interpolation: int) -> NDArray:
        height, width = self.data.height, self.data.width
        if array.shape[0] < height or array.shape[1] < width:
            raise ValueError(
                f"{path}: {array.shape[0]}x{array.shape[1]} pixels, fewer than the recipe's "
                f"{height}x{width}; lower recipe.data.height and recipe.data.width"
            )
        if array.shape[:2] == (height, width):
            return array
        return cv2.resize(array, (width, height), interpolation=interpolation)

    # --- which files ------------------------------------------------------------------------------

    def _folder(self, kind: Kind) -> Path:
        return self.root / kind.folder / self.split

    def _file(self, kind: Kind, name: str) -> Path:
        return files.file_of(self._folder(kind), kind, name)

    def _image_file(self, name: str) -> Path:
        return self._file(IMAGE if name in self._annotated else SEQUENCE, name)

    def _find_labels(self) -> dict[str, Path]:
        folders = [self._folder(LABELS)]
        if self.sequence_labels:
            folders.insert(0, self.sequence_labels)  # overwritten by the human labels
        return {
            name: files.file_of(folder, LABELS, name)
            for folder in folders
            for name in files.names_in(folder, LABELS)
        }

    def _with_sequence_frames(self) -> list[str]:
        """Annotated frames, and labelled frames of the sequences that have both neighbours."""
        present = files.names_in(self._folder(SEQUENCE), SEQUENCE)
        further = files.with_neighbours(self._label_files.keys() & present, present)
        return sorted(further | self._annotated)

    def _find_cameras(self) -> dict[str, str]:
        """Whose camera file holds for a frame: its own, or its snippet's annotated frame's."""
        cameras = files.camera_names(self._annotated, set(self.names))
        for name in self.names:
            if name not in cameras:
                raise ValueError(
                    f"{self._label_files[name]}: no annotated frame in its sequence, so no camera "
                    f"file; remove these labels or complete {self._folder(IMAGE)}"
                )
        return cameras

    def _require_files(self, training: bool) -> None:
        needed = [(CAMERA, set(self._camera_names.values()))]
        if self.panoptic:
            needed.append((LABELS, set(self.names)))
        if self.video and training:
            around = {files.neighbour(name, step) for name in self.names for step in (-1, 1)}
            needed.append((SEQUENCE, around))
        if self.video and not training:
            needed.append((DISPARITY, set(self.names)))
        for kind, names in needed:
            labels = kind is LABELS  # which may lie in a second folder
            found = self._label_files if labels else files.names_in(self._folder(kind), kind)
            missing = sorted(names.difference(found))
            if missing:
                raise ValueError(
                    f"{self._file(kind, missing[0])}: missing, one of {len(missing)} "
                    f"{kind.what}s that {self.split} lacks; unpack {kind.package}, or see all "
                    f"with 'mtl-bench data check {self.root}'"
                )
