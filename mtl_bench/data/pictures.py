"""Images of every usual kind, read whole or not at all.

Files are read as bytes and decoded then: OpenCV crashes at a name that is not UTF-8, and hands back
half a picture without a word.
"""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from mtl_bench.data import png

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".jp2")
_LONGEST = 12  # bytes of the beginnings
_BEGINNINGS = (
    *(png.SIGNATURE, b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*", b"\0\0\0\x0cjP  "),
    *(b"P%d" % kind for kind in range(1, 7)),
)

# Of what is wrong with a file, one line of ours is enough
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
warnings.filterwarnings("ignore", module=r"PIL\.")


def is_image(path: Path) -> bool:
    """Whether a file begins like an image.

    Raises:
        ValueError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_LONGEST)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    webp = start.startswith(b"RIFF") and start.endswith(b"WEBP")
    return webp or start.startswith(_BEGINNINGS)


def read(path: Path, bits: int | None = None) -> NDArray[np.uint8]:
    """[H,W,3] RGB.

    Args:
        bits: a PNG of another depth is refused, as is what only claims to be a PNG; None: any
            image is turned into 8 bits.

    Raises:
        ValueError: the file is missing, cut off, damaged or no image.
    """
    data = png.read_bytes(path)
    if data.startswith(png.SIGNATURE) or (bits and path.suffix == ".png"):
        png.check(path, data, bits)
    else:
        _check_whole(path, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: not an image that OpenCV can read, or a damaged one")
    return np.ascontiguousarray(image[..., ::-1])


def read_header(path: Path) -> png.Header:
    """Size and depth, without decoding.

    Raises:
        ValueError: the file is missing, a truncated PNG or no image.
    """
    if path.suffix.lower() == ".png":
        return png.read_header(path)
    try:
        with PIL.Image.open(path) as image:
            return png.Header(image.height, image.width, 8)
    except OSError as error:
        raise ValueError(f"{path}: no image, or one that cannot be read") from error


def _check_whole(path: Path, data: bytes) -> None:
    """Raises: ValueError where Pillow, which knows most kinds, finds that something is missing."""
    if not data:
        raise ValueError(f"{path}: the file is empty")
    try:
        image = PIL.Image.open(io.BytesIO(data))
        image.draft("RGB", (1, 1))  # a JPEG is read to its end, but most of it not worked out
        image.load()
    except PIL.UnidentifiedImageError:
        pass  # what Pillow does not know, OpenCV may
    except Exception as error:  # Pillow's have no class in common
        raise ValueError(
            f"{path}: truncated or damaged image ({error}); copy or unpack the file again"
        ) from error
