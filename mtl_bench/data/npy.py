"""Arrays of numbers as NumPy writes them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def read(path: Path) -> NDArray[Any]:
    """A file's array.

    Raises:
        ValueError: the file is missing, cut off, no .npy file, or not of numbers.
    """
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise ValueError(f"{path}: missing") from None
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{path}: not a whole .npy array ({error})") from None
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{path}: an archive of arrays, not one .npy array")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{path}: values of type {array.dtype}, not numbers")
    return array
