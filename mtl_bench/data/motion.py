"""Which frames move against their neighbours in time: from a standing car nothing is learned.

Source: frames whose mean optical flow is below a pixel are left out of training by Zhou et al.
(CVPR 2017). Here a pixel is one of the network's input, and the mean is over both neighbours; flow
is that of Kroeger et al. (ECCV 2016), found at `COLUMNS` columns or fewer.
"""

import hashlib
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import platformdirs
from filelock import FileLock
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from mtl_bench.core.recipe import Data

COLUMNS = 512
_FORMAT = 1  # raised when the flow of the same files would be another number

Pair = tuple[Path, Path]
Read = Callable[[Path], NDArray[np.uint8]]  # an image [H,W,3] at the input's size


def moving(frames: Mapping[str, tuple[Pair, Pair]], data: Data, read: Read) -> list[str]:
    """Names of the frames that move by `data.min_flow` pixels or more.

    Args:
        frames: the pairs of images of the frame with the one before it and the one after it.

    Raises:
        ValueError: none moves that much, or what is wrong with an image.
    """
    found = _flows(list(dict.fromkeys(pair for two in frames.values() for pair in two)), data, read)
    mean = {name: (found[before] + found[after]) / 2 for name, (before, after) in frames.items()}
    names = [name for name, pixels in mean.items() if pixels >= data.min_flow]
    if not names:
        raise ValueError(
            f"recipe.data.min_flow = {data.min_flow:g} leaves none of {len(frames)} frames: the "
            f"flow is {max(mean.values()):.2g} pixels at most; lower it"
        )
    return names


def flow_px(one_HW3: NDArray[np.uint8], other_HW3: NDArray[np.uint8]) -> float:
    """Mean magnitude of the flow between two images, in their pixels."""
    height, width = one_HW3.shape[:2]
    shrink = min(1.0, COLUMNS / width)
    size = (round(width * shrink), max(1, round(height * shrink)))
    gray = [
        cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        for image in (one_HW3, other_HW3)
    ]
    preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    flow_HW2 = cv2.DISOpticalFlow.create(preset).calc(gray[0], gray[1], None)
    return float(np.linalg.norm(flow_HW2, axis=2).mean() / shrink)


def _flows(pairs: list[Pair], data: Data, read: Read) -> dict[Pair, float]:
    """Of every pair; kept in the user's cache, line by line, so that each is found but once."""
    place = platformdirs.user_cache_path("mtl-bench") / "flow"
    place.mkdir(parents=True, exist_ok=True)
    kept = place / f"{data.height}x{data.width}.txt"
    keys = {pair: _key(pair) for pair in pairs}
    with FileLock(kept.with_suffix(".lock")):
        known = _known(kept)
        missing = [pair for pair in pairs if keys[pair] not in known]
        console = Console(stderr=True)
        with (
            Progress(console=console, disable=not console.is_terminal, transient=True) as bar,
            ThreadPoolExecutor(os.cpu_count()) as pool,
            kept.open("a") as file,
        ):
            found = pool.map(lambda pair: flow_px(*map(read, pair)), missing)
            shown = bar.track(found, len(missing), description="optical flow")
            for pair, pixels in zip(missing, shown, strict=True):
                known[keys[pair]] = pixels
                file.write(f"{keys[pair]} {pixels!r}\n")
    return {pair: known[key] for pair, key in keys.items()}


def _known(kept: Path) -> dict[str, float]:
    """The file's whole lines; an unfinished last one, which a kill leaves, is cut off."""
    if not kept.exists():
        return {}
    text = kept.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        kept.write_text(whole)
    try:
        return {key: float(value) for key, value in map(str.split, whole.splitlines())}
    except ValueError as error:
        raise ValueError(f"{kept}: damaged ({error}); delete it") from error


def _key(pair: Pair) -> str:
    """What tells a pair of files, as they are, from every other one."""
    try:
        states = [(str(path), (s := path.stat()).st_size, s.st_mtime_ns) for path in pair]
    except OSError as error:
        raise ValueError(f"{error.filename}: cannot be read ({error.strerror})") from error
    return hashlib.sha256(repr((_FORMAT, states)).encode()).hexdigest()[:24]
