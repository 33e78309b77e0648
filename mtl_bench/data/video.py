"""Videos in and out, one frame at a time. RGB, uint8 [H,W,3]."""

import math
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.files import utf8_name

Image = NDArray[np.uint8]
CODEC = "mp4v"  # MPEG-4, which every OpenCV can write
UNKNOWN_FPS = 25.0  # of a video that does not say
LARGEST = 65535  # of MPEG-4's clock: a second has so many ticks at most
SLOWEST = 0.01  # frames a second; OpenCV takes fewer for none

# Of what goes wrong, one line of ours is enough
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def representable(fps: float) -> float:
    """The nearest number of frames a second that MPEG-4 can hold: whole ticks of a clock with
    10^n a frame, n as large as the clock allows. OpenCV finds the same fraction."""
    fps = min(max(fps, SLOWEST), float(LARGEST))
    return next(
        round(fps * ticks) / ticks for ticks in (1000, 100, 10, 1) if round(fps * ticks) <= LARGEST
    )


class Reader:
    """A video file; iterating decodes a frame at a time.

    Raises:
        ValueError: not a video, or one without frames.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture = cv2.VideoCapture(utf8_name(path, "OpenCV's video"))
        if not self._capture.isOpened():
            raise ValueError(f"{path}: neither an image nor a video that OpenCV can read")
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = fps if math.isfinite(fps) and fps > 0 else UNKNOWN_FPS
        self.frames = max(0, int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))  # 0: not known
        self._first = self._read()
        if self._first is None:
            raise ValueError(f"{path}: a video without a frame that can be decoded")
        self.size = (self._first.shape[0], self._first.shape[1])

    def __iter__(self) -> Iterator[Image]:
        frame = self._first
        self._first = None
        while frame is not None:
            yield frame
            frame = self._read()
        self._capture.release()

    def _read(self) -> Image | None:
        read, frame = self._capture.read()
        return np.ascontiguousarray(frame[..., ::-1]) if read else None


class Writer:
    """A video file that is written a frame at a time, of the first frame's size.

    Raises:
        ValueError: a codec that is not there, or, at the end, frames that did not get to the disk.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps, self.frames = path, representable(fps), 0
        self._name = utf8_name(path, "OpenCV's video")
        self._writer: cv2.VideoWriter | None = None

    def write(self, image_HW3: Image) -> None:
        if self._writer is None:
            height, width = image_HW3.shape[:2]
            code = cv2.VideoWriter_fourcc(*CODEC)  # type: ignore[attr-defined]
            self._writer = cv2.VideoWriter(self._name, code, self.fps, (width, height))
            if not self._writer.isOpened():
                raise ValueError(f"{self.path}: this OpenCV cannot write {CODEC} videos here")
        self._writer.write(np.ascontiguousarray(image_HW3[..., ::-1]))
        self.frames += 1

    def __enter__(self) -> "Writer":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if self._writer is None:
            return
        self._writer.release()
        if kind is None:
            self._check()

    def _check(self) -> None:
        """OpenCV says nothing of a disk that is full."""
        capture = cv2.VideoCapture(self._name)
        written = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        capture.release()
        if written != self.frames:
            raise ValueError(
                f"{self.path.name}: {written} of {self.frames} frames written; is the disk full?"
            )
