"""PNG files that are read whole or not at all: decoders hand back half a picture without a word."""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33  # signature and IHDR
_TAIL_BYTES = 12  # IEND


@dataclass(frozen=True)
class Header:
    height: int
    width: int
    bits: int  # per channel


def read(path: Path, bits: int, color: bool = False) -> NDArray[Any]:
    """Decode a file into [H,W] or, in color, [H,W,3] RGB; uint8 or uint16 as `bits` says.

    Raises:
        ValueError: the file is missing, truncated, damaged or of another bit depth.
    """
    data = _read_bytes(path)
    check_bits(path, _parse_header(path, data), bits)
    _check_chunks(path, data)
    flag = cv2.IMREAD_COLOR if color else cv2.IMREAD_UNCHANGED
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    if image is None:
        raise ValueError(f"{path}: damaged PNG; copy or unpack the file again")
    if image.ndim != 2 + color:
        raise ValueError(f"{path}: {image.shape[2]} channels where one is expected")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if color else image


def read_header(path: Path) -> Header:
    """Size and depth from the first and last bytes, without decoding.

    Raises:
        ValueError: the file is missing, truncated or no PNG.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
            file.seek(max(file.seek(0, 2) - _TAIL_BYTES, 0))
            tail = file.read()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    header = _parse_header(path, head)
    if tail[4:8] != b"IEND":
        raise _truncated(path)
    return header


def check_bits(path: Path, header: Header, bits: int) -> None:
    """Raises: ValueError where the depth is not the expected one."""
    if header.bits != bits:
        raise ValueError(f"{path}: {header.bits}-bit PNG where {bits} bits are expected")


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error


def _parse_header(path: Path, data: bytes) -> Header:
    if not data.startswith(_SIGNATURE):
        raise ValueError(f"{path}: not a PNG file" if data else f"{path}: the file is empty")
    if len(data) < _HEADER_BYTES:
        raise _truncated(path)
    width, height = (int.from_bytes(data[i : i + 4]) for i in (16, 20))
    return Header(height, width, data[24])


def _check_chunks(path: Path, data: bytes) -> None:
    """Walk from chunk to chunk up to IEND, comparing checksums: length, type, content, CRC-32."""
    view, start = memoryview(data), len(_SIGNATURE)
    while start + 12 <= len(data):
        end = start + 12 + int.from_bytes(view[start : start + 4])
        if end > len(data):
            break
        if zlib.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end]):
            raise ValueError(f"{path}: damaged PNG (checksum); copy or unpack the file again")
        if view[start + 4 : start + 8] == b"IEND":
            return
        start = end
    raise _truncated(path)


def _truncated(path: Path) -> ValueError:
    return ValueError(f"{path}: truncated PNG; copy or unpack the file again")
