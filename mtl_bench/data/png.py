"""PNG files that are read whole or not at all: decoders hand back half a picture without a word."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.PngImagePlugin import PngImageFile

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33  # signature and IHDR
_END = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk, the same in every file


@dataclass(frozen=True)
class Header:
    height: int
    width: int
    bits: int  # per channel


def read(path: Path, bits: int) -> NDArray[Any]:
    """Decode a file of one channel into [H,W]; uint8 or uint16 as `bits` says.

    Raises:
        ValueError: the file is missing, truncated, damaged or of another bit depth.
    """
    data = read_bytes(path)
    check(path, data, bits)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path}: damaged PNG; copy or unpack the file again")
    if image.ndim != 2:
        raise ValueError(f"{path}: {image.shape[2]} channels where one is expected")
    return np.asarray(image)


def encode(pixels: NDArray[Any], *options: int) -> bytes:
    """A file's content: [H,W] or RGB [H,W,3], uint8 or uint16.

    Args:
        options: OpenCV's, in pairs.
    """
    pixels = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    return cv2.imencode(".png", pixels, options)[1].tobytes()


def read_bytes(path: Path) -> bytes:
    """Raises: ValueError where the file cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error


def check(path: Path, data: bytes, bits: int | None) -> None:
    """Raises: ValueError where a file's bytes are no whole, sound PNG of this depth (None: any)."""
    header = _parse(path, data, data)
    if bits is not None:
        check_bits(path, header, bits)
    try:
        PngImageFile(io.BytesIO(data)).verify()
    except Exception as error:  # Pillow's have no class in common
        raise ValueError(
            f"{path}: damaged PNG (checksum); copy or unpack the file again"
        ) from error


def read_header(path: Path) -> Header:
    """Size and depth from the first and last bytes, without decoding.

    Raises:
        ValueError: the file is missing, truncated or no PNG.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER_BYTES)
            file.seek(max(file.seek(0, io.SEEK_END) - len(_END), 0))
            return _parse(path, start, file.read())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error


def check_bits(path: Path, header: Header, bits: int) -> None:
    """Raises: ValueError where the depth is not the expected one."""
    if header.bits != bits:
        raise ValueError(f"{path}: {header.bits}-bit PNG where {bits} bits are expected")


def _parse(path: Path, start: bytes, end: bytes) -> Header:
    """The header, by a file's first bytes, once its last ones show that it is whole."""
    if not start.startswith(SIGNATURE):
        raise ValueError(f"{path}: not a PNG file" if start else f"{path}: the file is empty")
    if end.rfind(_END) < 0:  # Pillow does not look at what follows the name of the last chunk
        raise ValueError(f"{path}: truncated PNG; copy or unpack the file again")
    width, height = (int.from_bytes(start[i : i + 4]) for i in (16, 20))
    return Header(height, width, start[24])


def to_size(array: NDArray[Any], height: int, width: int, interpolation: int) -> NDArray[Any]:
    """[height,width,...]; area means, where they are asked for, turn bilinear when they enlarge."""
    if array.shape[:2] == (height, width):
        return array
    if interpolation == cv2.INTER_AREA and (height > array.shape[0] or width > array.shape[1]):
        interpolation = cv2.INTER_LINEAR
    found: NDArray[Any] = cv2.resize(array, (width, height), interpolation=interpolation)
    return found
