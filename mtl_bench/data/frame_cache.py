"""Decoded frames at the input's size on disk, which every process maps into its memory.

`<place>/<height>x<width>/` has one file for each image and label file of a data set, under its path
from the data set's root: a header, then the pixels as they are. `mtl-bench data cache` writes them;
samples are the same with and without. The place is `frame_cache` in the root, or what the
environment variable MTL_BENCH_FRAME_CACHE names: where frames lie is no matter of a recipe.
"""

import copy
import json
import mmap
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core import config
from mtl_bench.data import cityscapes_files as files

PLACE = "MTL_BENCH_FRAME_CACHE"
_FORMAT = 1  # raised when a file of the cache would have to hold something else
_HEADER_BYTES = 4096  # JSON and blanks; a page, so that pixels begin with one


@dataclass(frozen=True)
class Content:
    """What a file shows: how it is read and shrunk."""

    what: str
    read: Callable[[Path], NDArray[Any]]
    interpolation: int  # OpenCV's
    pixel_bytes: int


IMAGE = Content("image", files.read_image, cv2.INTER_AREA, 3)
LABELS = Content("label map", files.read_instance_ids, cv2.INTER_NEAREST_EXACT, 2)

Source = tuple[Path, Content]
Resize = Callable[[NDArray[Any], Path, int], NDArray[Any]]  # to the input's size, by interpolation


class Decoded(NamedTuple):
    pixels: NDArray[Any]  # [H,W,3] uint8 or [H,W] uint16, at the input's size
    own_size: tuple[int, ...]  # height and width of the file


class FrameCache:
    """What is decoded of one data set at one size: possibly nothing.

    Args:
        root: the data set.
        data: the input's size; with `data.cache`, which keeps frames in memory, they are copied
            out of the files, of which a process can map only so many.
        resize: how a picture comes to the input's size.
    """

    def __init__(self, root: Path, data: config.Data, resize: Resize) -> None:
        self.root, self.size, self._copy = root, (data.height, data.width), data.cache
        self._resize = resize
        self.folder = self._below(Path(os.environ.get(PLACE) or root / "frame_cache"))

    def at(self, place: Path) -> Self:
        """The same in another place."""
        other = copy.copy(self)
        other.folder = self._below(place)
        return other

    def _below(self, place: Path) -> Path:
        return place / "{}x{}".format(*self.size)

    def read(self, path: Path, content: Content, frame: tuple[Path, Any] | None = None) -> Decoded:
        """A file at the input's size: from the cache where it is there, else decoded.

        Args:
            path: the data set's file.
            content: what it shows.
            frame: path and own size of the image that it must have the size of.

        Raises:
            ValueError: what is wrong with the file, or that it has changed since it was cached.
        """
        stored = self._stored(path)
        raw = content.read(path) if stored is None else stored.pixels
        own_size = raw.shape[:2] if stored is None else stored.own_size
        if frame is not None:
            files.check_same_size(path, own_size, *frame)
        if stored is None:
            return Decoded(self._resize(raw, path, content.interpolation), own_size)
        return Decoded(np.array(raw) if self._copy else raw, own_size)

    def add(self, path: Path, content: Content) -> None:
        """Decode a file into the cache; an interrupted process leaves nothing under its name."""
        state = _state_of(path)
        raw = content.read(path)
        pixels = np.ascontiguousarray(self._resize(raw, path, content.interpolation))
        values = {
            **state,
            "own_size": raw.shape[:2],
            "shape": pixels.shape,
            "dtype": str(pixels.dtype),
        }
        out = self._file(path)
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as file:
                file.write(json.dumps(values).encode().ljust(_HEADER_BYTES))
                file.write(pixels.data)
            temporary.replace(out)
        finally:
            temporary.unlink(missing_ok=True)

    def lacks(self, path: Path) -> bool:
        """Whether a file has to be decoded into the cache: it is absent, old or damaged."""
        try:
            return self._stored(path) is None
        except ValueError:
            return True

    def _file(self, path: Path) -> Path:
        relative = path.relative_to(self.root)
        return self.folder / relative.with_name(f"{relative.name}.frame")

    def _stored(self, path: Path) -> Decoded | None:
        if not path.is_relative_to(self.root):  # a run's own pseudo labels
            return None
        stored = self._file(path)
        try:
            with stored.open("rb") as file:
                header = file.read(_HEADER_BYTES)
                memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
            values = json.loads(header)
            shape, own_size = tuple(values["shape"]), tuple(values["own_size"])
            flat = np.frombuffer(memory, values["dtype"], offset=_HEADER_BYTES)
            pixels = flat.reshape(shape)
        except FileNotFoundError:
            return None
        except (KeyError, ValueError) as error:  # also no JSON, or fewer pixels than it says
            raise ValueError(
                f"{stored}: damaged; run 'mtl-bench data cache' again or remove {self.folder}"
            ) from error
        if any(values.get(key) != value for key, value in _state_of(path).items()):
            raise ValueError(
                f"{path}: changed since it was cached in {self.folder}; run 'mtl-bench data cache' "
                f"again or remove that folder"
            )
        return Decoded(pixels, own_size)


def _state_of(path: Path) -> dict[str, int]:
    """What tells a file from the one that was cached."""
    try:
        state = path.stat()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    return {"format": _FORMAT, "bytes": state.st_size, "mtime_ns": state.st_mtime_ns}


# --- building -------------------------------------------------------------------------------------


def needed_bytes(cache: FrameCache, sources: Iterable[Source]) -> int:
    """Of disk, for these files."""
    pixels = cache.size[0] * cache.size[1]
    return sum(_HEADER_BYTES + pixels * content.pixel_bytes for _, content in sources)


def check_space(cache: FrameCache, sources: Iterable[Source]) -> None:
    """Raises: ValueError where the disk has no room for these files."""
    folder = next(folder for folder in cache.folder.absolute().parents if folder.is_dir())
    needed, free = needed_bytes(cache, sources), shutil.disk_usage(folder).free
    if needed > free:
        raise ValueError(
            f"{cache.folder}: the cache takes {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are "
            f"free; choose another disk with --out"
        )


def build(cache: FrameCache, sources: list[Source]) -> Iterator[int]:
    """Decode files, one or more, into the cache, a thread a core; yields how many are done.

    Raises:
        ValueError: what is wrong with a file; those before it are cached.
    """
    paths, contents = zip(*sources, strict=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for done, _ in enumerate(pool.map(cache.add, paths, contents), 1):
                yield done
        finally:
            pool.shutdown(cancel_futures=True)
