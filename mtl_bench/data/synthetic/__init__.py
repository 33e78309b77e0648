"""The built-in data set: procedural street scenes as videos, in Cityscapes' layout or KITTI's.

`ensure` renders it into the user's cache on first use, `write` into a folder of choice. Scenes are
rendered by worker processes (`python -m mtl_bench.data.synthetic`); every scene depends on the seed
and its own number alone, so that their count and order leave no trace in the bytes. The folder
appears under its name by a rename at the very end: what has the name is whole.
"""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import platformdirs

from mtl_bench.core.config import Data
from mtl_bench.data.layouts import CITYSCAPES, LAYOUTS
from mtl_bench.data.synthetic.settings import Settings
from mtl_bench.data.synthetic.workers import render_all

__all__ = ["ensure", "write"]


def ensure(data: Data, root: Path | None = None, progress: bool = True) -> Path:
    """The rendered data set that a recipe asks for; rendered now if it is not there yet.

    Args:
        data: name, which says the layout, size, numbers of scenes, length of a snippet and seed.
        root: folder that holds rendered data sets; None = the user's cache folder.
        progress: show progress on stderr.

    Returns:
        The data set's folder.

    Raises:
        ValueError: snippets too short to train on, or sizes or counts that cannot be rendered.
    """
    if data.frames < 3:
        raise ValueError(
            f"recipe.data.frames = {data.frames}, but training compares a frame with the one "
            f"before it and the one after it; set 3 or more"
        )
    counts = data.train_scenes, data.val_scenes, data.test_scenes
    layout = LAYOUTS[data.dataset]
    settings = _settings(data.height, data.width, *counts, data.seed, data.frames, layout=layout)
    root = platformdirs.user_cache_path("mtl-bench") if root is None else Path(root)
    out = root / f"{data.dataset}-{data.height}x{data.width}-{settings.key}"
    if not out.is_dir():
        with _lock(out):
            if not out.is_dir():  # another process may have been at it while we waited
                _render(out, settings, None, progress)
    return out


def write(
    out: Path,
    height: int,
    width: int,
    train_scenes: int,
    val_scenes: int,
    test_scenes: int = 8,
    seed: int = 0,
    frames: int = 3,
    annotated: int | None = None,
    min_instance_area: int | None = None,
    processes: int | None = None,
    progress: bool = True,
    layout: str = CITYSCAPES,
) -> Path:
    """Render a data set into a new folder.

    Args:
        out: folder to create.
        height: pixels; the scenes are the same at every size.
        frames: length of a snippet; Cityscapes' have 30.
        annotated: index of the frame that has labels; None = 19 of 30 as in Cityscapes, else the
            middle one. In KITTI's layout all frames between the first and the last have them.
        min_instance_area: a thing of which fewer pixels are visible is written as a *group*, the
            bare label id (< 1000, `iscrowd`), as annotators do with what they cannot tell apart;
            None = 12 at 64x128, in proportion at other sizes.
        processes: workers; None = one a core.
        layout: of files, one of `data.layouts`.

    Raises:
        ValueError: `out` exists, or sizes or counts that cannot be rendered.
    """
    settings = _settings(
        height,
        width,
        train_scenes,
        val_scenes,
        test_scenes,
        seed,
        frames,
        annotated,
        min_instance_area,
        layout,
    )
    out = Path(out)
    with _lock(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ValueError(f"{out} exists already; remove it or choose another folder")
        _render(out, settings, processes, progress)
    return out


def _settings(
    height: int,
    width: int,
    train: int,
    val: int,
    test: int,
    seed: int,
    frames: int,
    annotated: int | None = None,
    min_area: int | None = None,
    layout: str = CITYSCAPES,
) -> Settings:
    if annotated is None:
        annotated = 19 if frames == 30 else frames // 2
    if min_area is None:
        min_area = max(1, round(12 * height * width / (64 * 128)))
    return Settings(
        height, width, train, val, test, seed, frames, annotated, min_area, layout=layout
    )


def _render(out: Path, settings: Settings, processes: int | None, progress: bool) -> None:
    """Render beside the final place, then move: a killed run leaves nothing under that name."""
    for remains in out.parent.glob(f"{out.name}.partial-*"):  # of killed runs: we hold the lock
        shutil.rmtree(remains, ignore_errors=True)  # their last worker may still be writing
    partial = out.with_name(f"{out.name}.partial-{secrets.token_hex(4)}")
    partial.mkdir(parents=True)
    render_all(partial, settings, processes, progress)
    if out.exists():
        out.rmdir()  # empty, or rmdir refuses
    partial.rename(out)


@contextlib.contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Let one process at a time render into `out`; the system frees the lock of a dead one."""
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except (
        ImportError
    ):  # Windows: two processes that render the same set at once fail on the rename
        yield
        return
    path = out.with_name(f"{out.name}.lock")
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
