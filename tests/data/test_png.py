"""A PNG is read whole, or one line says what is wrong with it and what to do."""

import cv2
import numpy as np
import pytest

from mtl_bench.data import png

IMAGE = np.arange(6 * 7, dtype=np.uint8).reshape(6, 7)
HEAD, END = 33, 12  # bytes: signature and IHDR; IEND


@pytest.fixture
def path(tmp_path):
    out = tmp_path / "a.png"
    cv2.imwrite(str(out), IMAGE)
    return out


def flip(at):
    def change(data):
        data[at] ^= 255
        return data

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"", "the file is empty"),
        (lambda data: b"GIF89a" + data, "not a PNG file"),
        *((lambda data, keep=keep: data[:keep], "truncated PNG; copy") for keep in
          (8, 20, HEAD, HEAD + 9, -1, -4, -END)),
        (flip(HEAD - 1), r"damaged PNG \(checksum\); copy or unpack"),  # IHDR's checksum
        (flip(-END - 1), r"damaged PNG \(checksum\); copy or unpack"),  # IDAT's
        (flip(-END - 8), r"damaged PNG \(checksum\); copy or unpack"),  # its content
        (flip(HEAD + 2), r"damaged PNG \(checksum\); copy or unpack"),  # its length
        (lambda data: data[:HEAD] + data[-END:], "damaged PNG"),  # no picture
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(path, change, message):
    path.write_bytes(bytes(change(bytearray(path.read_bytes()))))
    with pytest.raises(ValueError, match=f"^{path}: {message}") as error:
        png.read(path, 8)
    assert "\n" not in str(error.value)


def test_a_missing_file_another_depth_and_other_channels(path, tmp_path):
    with pytest.raises(ValueError, match=r"b\.png: cannot be read"):
        png.read(tmp_path / "b.png", 8)
    with pytest.raises(ValueError, match="8-bit PNG where 16 bits are expected"):
        png.read(path, 16)
    cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="3 channels where one is expected"):
        png.read(path, 8)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_is_whole_is_decoded(path, dtype):
    image, bits = IMAGE.astype(dtype) * dtype(3), 8 * dtype().itemsize
    cv2.imwrite(str(path), image)
    assert png.read_header(path) == png.Header(6, 7, bits)
    read = png.read(path, bits)
    assert read.dtype == dtype
    assert (read == image).all()
