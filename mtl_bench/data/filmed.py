"""A video as a data set: its frames in Cityscapes' layout, decoded once into the user's cache.

The reader is Cityscapes' own. Every frame that has both neighbours trains; there is no truth, so
nothing can be measured.
"""

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import platformdirs
from filelock import FileLock

from mtl_bench.core.files import write_json
from mtl_bench.core.recipe import NOTHING
from mtl_bench.data.cameras import Mounted
from mtl_bench.data.cityscapes_files import CAMERA, IMAGE, SEQUENCE, file_of
from mtl_bench.data.video import Reader

# Of a recipe that trains on it
SETTINGS: Mapping[str, Any] = {
    "recipe.data.dataset": "cityscapes",
    "recipe.evaluate.split": NOTHING,
    "recipe.evaluate.also": [],
}
UNKNOWN_HEIGHT_M = 1.0  # stands where the height is not known; training does not read it
_FORMAT = 1  # raised when a tree would have to hold something else
_QUALITY = 95  # of JPEG


def tree_of(
    video: Path,
    camera: Mounted,
    place: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """The folder that holds the frames, decoded now where they are not there yet.

    Args:
        camera: that took the video.
        place: of such folders; None: the user's cache.
        progress: told the frames done and in all (0: not known).

    Raises:
        ValueError: no video, or one of fewer than three frames.
    """
    state = video.stat()
    record = {
        "format": _FORMAT,
        "video": str(video.resolve()),
        "bytes": state.st_size,
        "mtime_ns": state.st_mtime_ns,
        "camera": [*camera.K_33.ravel().tolist(), camera.height_m, camera.pitch_rad],
    }
    key = hashlib.sha256(json.dumps(record).encode()).hexdigest()[:12]
    out = (place or platformdirs.user_cache_path("mtl-bench")) / f"video-{key}"
    out.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(out.with_name(f"{out.name}.lock")):
        if not out.is_dir():
            for remains in out.parent.glob(f"{out.name}.partial-*"):  # of killed runs
                shutil.rmtree(remains, ignore_errors=True)
            partial = out.with_name(f"{out.name}.partial-{secrets.token_hex(4)}")
            try:
                _write(partial, Reader(video), camera, progress)
                write_json(partial / "video.json", record)
                partial.rename(out)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
    return out


def _write(
    root: Path,
    reader: Reader,
    camera: Mounted,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Frames as JPEG, as the video itself is lossy; those that train are linked, not copied."""
    folders = {kind: root / kind.folder / "train" for kind in (SEQUENCE, IMAGE, CAMERA)}
    names: list[str] = []
    files: list[Path] = []
    for number, image_HW3 in enumerate(reader):
        names.append(f"video_{number // 10**6:06d}_{number % 10**6:06d}")
        path = file_of(folders[SEQUENCE], SEQUENCE, names[-1]).with_suffix(".jpg")
        path.parent.mkdir(parents=True, exist_ok=True)
        bgr_HW3 = np.ascontiguousarray(image_HW3[..., ::-1])
        encoded = cv2.imencode(".jpg", bgr_HW3, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))[1]
        path.write_bytes(encoded.tobytes())
        files.append(path)
        if progress is not None:
            progress(len(names), reader.frames)
    if len(names) < 3:
        raise ValueError(
            f"{reader.path}: {len(names)} frames, but training compares a frame with the one "
            f"before it and the one after it; take a video of 3 or more"
        )
    (fx, _, cx), (_, fy, cy), _ = camera.K_33.tolist()
    height_m = UNKNOWN_HEIGHT_M if camera.height_m is None else camera.height_m
    values = {
        "intrinsic": {"fx": fx, "fy": fy, "u0": cx, "v0": cy},
        "extrinsic": {"baseline": 0.0, "z": height_m, "pitch": camera.pitch_rad},
    }
    for name, path in zip(names[1:-1], files[1:-1], strict=True):
        image, own = (file_of(folders[kind], kind, name) for kind in (IMAGE, CAMERA))
        image.parent.mkdir(parents=True, exist_ok=True)
        own.parent.mkdir(parents=True, exist_ok=True)
        os.link(path, image.with_suffix(".jpg"))
        own.write_text(json.dumps(values))
