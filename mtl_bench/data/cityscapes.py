"""Cityscapes: the real one and anything in its layout.

Frames larger than the recipe's input are shrunk to it, intrinsics and labels with them: on every
reading, or once where `mtl-bench data cache` wrote them down.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import NEIGHBOURS, Dataset, DecodedFrame, Kind, LabelFrames, Report
from mtl_bench.core.recipe import Recipe
from mtl_bench.data import cityscapes_files as files
from mtl_bench.data import frame_cache
from mtl_bench.data.augment import scale
from mtl_bench.data.cityscapes_files import CAMERA, DISPARITY, IMAGE, LABELS, SEQUENCE
from mtl_bench.data.cityscapes_files import Kind as Package
from mtl_bench.data.frame_cache import FrameCache, Source
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.data.motion import moving
from mtl_bench.data.pseudo_frames import CityscapesFrames


class Cityscapes(Dataset):
    """One split.

    Frames without labels, which a task that needs neighbours trains on, too, may share
    `<root>/ego_mask.png`: of the frames' own size, 8 bits, not 0 on the ego vehicle and whatever
    else has nothing to tell.

    Args:
        root: the folder that holds leftImg8bit, gtFine, camera, ...
        needs: with "instance_ids", label files are a must. Without it they only mask what does not
            move, where they exist.
        further_labels: a folder `<city>/*_gtFine_instanceIds.png` with labels of further frames
            of `leftImg8bit_sequence`, which then are training frames too (human labels win).
    """

    labels = CITYSCAPES20
    fields: ClassVar[Mapping[str, Kind]] = {"instance_ids": Kind.IDS, "depth_m": Kind.DEPTH}
    truths: ClassVar[tuple[str, ...]] = ("disparity",)
    static_ids: ClassVar[tuple[int, ...]] = (files.EGO_ID, files.SKY_ID)
    takes_further_labels = True
    layout = "Cityscapes"
    marks = "leftImg8bit/"
    published: ClassVar[Mapping[str, int]] = {"train": 2975, "val": 500, "test": 1525}

    def open_split(self) -> None:
        self.on_disk = FrameCache(self.root, self.data, self._to_input)
        self.names = files.annotated_names(self.root, self.split)
        self._annotated = frozenset(self.names)
        self._label_files = self._find_labels()
        if self.further_labels:
            self.names = self._with_sequence_frames()
        mask_path = self.root / files.EGO_MASK.suffix
        masked = self._compares and not self._annotated <= self._label_files.keys()
        self._ego_mask = files.read_ego_mask(mask_path) if masked and mask_path.exists() else None
        self._camera_names = self._find_cameras()
        self._require_files()
        self._standing = 0  # frames that are left out
        if self._compares and self.data.min_flow > 0:
            self._leave_out_standing()

    @classmethod
    def recognises(cls, root: Path) -> bool:
        return (root / IMAGE.folder).exists()

    @classmethod
    def check(cls, root: Path, deep: bool = False) -> Report:
        from mtl_bench.data.check import check

        return check(root, deep=deep)

    @classmethod
    def image_files(cls, root: Path, split: str) -> dict[str, Path]:
        folder = root / IMAGE.folder / split
        return {
            name: files.file_of(folder, IMAGE, name) for name in files.annotated_names(root, split)
        }

    @classmethod
    def frames_to_label(
        cls, root: Path, out: Path | None, split: str, recipe: Recipe
    ) -> LabelFrames:
        """Those of the sequences that have both neighbours and no human label."""
        return CityscapesFrames(root, out, split, recipe)

    @property
    def _compares(self) -> bool:
        """Whether training frames are compared with their neighbours in time."""
        return self.training and NEIGHBOURS in self.needs

    @property
    def static_from(self) -> str:
        """Labels, ego_mask.png, none, or two of them."""
        labelled = len(self._label_files.keys() & set(self.names))
        return files.reprojection_mask(len(self.names), labelled, self._ego_mask is not None)

    @property
    def knows_static(self) -> bool:
        """Only labels know where the sky is."""
        return self.static_from == "labels"

    @property
    def described(self) -> dict[str, Any]:
        """What a row says of the training frames, where some are left out."""
        left_out = {"standing": self._standing}
        return {"frames": len(self), "left_out": left_out} if self._standing else {}

    def sources(self) -> list[Source]:
        """The files that samples are made of and that `on_disk` can hold."""
        images = [self._image_file(name) for name in self.names]
        if self._compares:
            around = {beside for name in self.names for beside in self._around(name)}
            images += sorted({self._file(SEQUENCE, name) for name in around}.difference(images))
        labels = [self._label_files[name] for name in self.names if name in self._label_files]
        sources = [(path, frame_cache.IMAGE) for path in images]
        return sources + [(path, frame_cache.LABELS) for path in labels if self.training]

    def paths(self) -> Iterator[Path]:
        """The files of its frames, and their cameras'."""
        yield from (path for path, _ in self.sources())
        cameras = (self._file(CAMERA, name) for name in set(self._camera_names.values()))
        yield from (path for path in cameras if self.needs_camera or path.is_file())
        if not self.training:
            labelled = self._label_files.keys() & set(self.names)
            yield from (self._label_files[name] for name in labelled)
        if "depth_m" in self.needs:
            yield from (self._file(DISPARITY, name) for name in self.names)
        if self._ego_mask is not None:
            yield self.root / files.EGO_MASK.suffix

    # --- decoding ---------------------------------------------------------------------------------

    def read(self, name: str) -> DecodedFrame:
        path = self._image_file(name)
        images = [self.on_disk.read(path, frame_cache.IMAGE)]
        own_size = images[0].own_size
        frame = (path, own_size)
        if self._compares:
            around = [self._file(SEQUENCE, beside) for beside in self._around(name)]
            images += [self.on_disk.read(beside, frame_cache.IMAGE, frame) for beside in around]
        camera = K_33 = None
        camera_path = self._file(CAMERA, self._camera_names[name])
        if self.needs_camera or camera_path.exists():
            camera = files.read_camera(camera_path)
            K = torch.tensor([[camera.fx, 0, camera.u0], [0, camera.fy, camera.v0], [0, 0, 1]])
            K_33 = scale(K, self.data.width / own_size[1], self.data.height / own_size[0])

        fields: dict[str, torch.Tensor] = {}
        wanted = "instance_ids" in self.needs
        ids = None
        if wanted or (name in self._label_files and (self._compares or not self.training)):
            label_path = self._label_files[name]
            if self.training:
                ids = self.on_disk.read(label_path, frame_cache.LABELS, frame).pixels
            else:
                ids = files.read_instance_ids(label_path)
                files.check_same_size(label_path, ids.shape, *frame)
        elif self._compares and self._ego_mask is not None:
            ids = self._ego_mask
            files.check_same_size(self.root / files.EGO_MASK.suffix, ids.shape, *frame)
            ids = self._to_input(ids, path, cv2.INTER_NEAREST_EXACT)
        ids_HW = None if ids is None else torch.from_numpy(ids.astype(np.int32))
        if ids_HW is not None and (wanted or not self.training):
            fields["instance_ids"] = ids_HW
        if "depth_m" in self.needs:
            assert camera is not None
            depth_path = self._file(DISPARITY, name)
            depth_m = files.read_depth_m(depth_path, camera)
            files.check_same_size(depth_path, depth_m.shape, *frame)
            if self.training:
                depth_m = self._to_input(depth_m, depth_path, cv2.INTER_NEAREST_EXACT)
            fields["depth_m"] = torch.from_numpy(depth_m)

        return DecodedFrame(
            images_N3HW=[torch.from_numpy(image.pixels).permute(2, 0, 1) for image in images],
            K_33=K_33,
            camera_height_m=camera.height_m if camera else 0.0,
            camera_pitch_rad=camera.pitch_rad if camera else 0.0,
            fields=fields,
            static=ids_HW if self.training else None,
        )

    def _to_input(self, array: NDArray[Any], path: Path, interpolation: int) -> NDArray[Any]:
        height, width = self.data.height, self.data.width
        if array.shape[0] < height or array.shape[1] < width:
            raise ValueError(
                f"{path}: {array.shape[0]}x{array.shape[1]} pixels, fewer than the recipe's "
                f"{height}x{width}; lower recipe.data.height and recipe.data.width"
            )
        if array.shape[:2] == (height, width):
            return array
        found: NDArray[Any] = cv2.resize(array, (width, height), interpolation=interpolation)
        return found

    # --- which files ------------------------------------------------------------------------------

    def _folder(self, kind: Package) -> Path:
        return self.root / kind.folder / self.split

    def _file(self, kind: Package, name: str) -> Path:
        return files.file_of(self._folder(kind), kind, name)

    def _image_file(self, name: str) -> Path:
        return self._file(IMAGE if name in self._annotated else SEQUENCE, name)

    def _around(self, name: str) -> list[str]:
        """The frame before and the one after."""
        return [files.neighbour(name, step) for step in (-self.data.stride, self.data.stride)]

    def _leave_out_standing(self) -> None:
        pairs = {}
        for name in self.names:
            image = self._image_file(name)
            before, after = (self._file(SEQUENCE, beside) for beside in self._around(name))
            pairs[name] = ((before, image), (image, after))
        kept = moving(pairs, self.data, lambda p: self.on_disk.read(p, frame_cache.IMAGE).pixels)
        self._standing, self.names = len(pairs) - len(kept), kept

    def _find_labels(self) -> dict[str, Path]:
        folders = [self._folder(LABELS)]
        if self.further_labels:
            folders.insert(0, self.further_labels)  # overwritten by the human labels
        return {
            name: files.file_of(folder, LABELS, name)
            for folder in folders
            for name in files.names_in(folder, LABELS)
        }

    def _with_sequence_frames(self) -> list[str]:
        """Annotated frames, and labelled frames of the sequences that have both neighbours."""
        present = files.names_in(self._folder(SEQUENCE), SEQUENCE)
        further = files.with_neighbours(
            self._label_files.keys() & present, present, self.data.stride
        )
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

    def _require_files(self) -> None:
        needed = [(CAMERA, set(self._camera_names.values()))] if self.needs_camera else []
        if "instance_ids" in self.needs:
            needed.append((LABELS, set(self.names)))
        if self._compares:
            around = {beside for name in self.names for beside in self._around(name)}
            needed.append((SEQUENCE, around))
        if "depth_m" in self.needs:
            needed.append((DISPARITY, set(self.names)))
        for kind, names in needed:
            labels = kind is LABELS  # which may lie in a second folder
            found = self._label_files if labels else files.names_in(self._folder(kind), kind)
            missing = sorted(names.difference(found))
            if missing:
                far = kind is SEQUENCE and self.data.stride > 1
                stride = f" at recipe.data.stride = {self.data.stride}" if far else ""
                raise ValueError(
                    f"{self._file(kind, missing[0])}: missing, one of {len(missing)} "
                    f"{kind.what}s that {self.split} lacks{stride}; unpack {kind.package}, or see "
                    f"all with 'mtl-bench data check {self.root}'"
                )
