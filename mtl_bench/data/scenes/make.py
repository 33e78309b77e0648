"""Makes a data set: renders all scenes in parallel, and puts the folder in place when it is whole.

Workers are plain child processes (`python -m mtl_bench.data.scenes`) rather than a
multiprocessing pool: they do not import the caller's main module again (safe from scripts,
notebooks and the prompt), and when the parent is killed, the next line that they print finds a
closed pipe and ends them.
"""

import json
import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import platformdirs
from filelock import FileLock
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mtl_bench.core.files import read_json
from mtl_bench.core.recipe import Data
from mtl_bench.data.scenes import arrays, cityscapes, kitti
from mtl_bench.data.scenes.settings import (
    CITYSCAPES,
    CITYSCAPES_ARRAYS,
    KITTI,
    NYUV2,
    RECORD,
    Settings,
    key_of,
)

_WRITERS = {CITYSCAPES: cityscapes, KITTI: kitti, NYUV2: arrays, CITYSCAPES_ARRAYS: arrays}
FAILED = "failed"  # in place of a scene's entry: errno, its text, the folder
_SINGLE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def ensure(
    data: Data, root: Path | None = None, progress: bool = True, layout: str = CITYSCAPES
) -> Path:
    """The rendered data set that a recipe asks for; rendered now if it is not there yet.

    Args:
        data: name, size, numbers of scenes, length of a snippet and seed.
        root: folder that holds rendered data sets; None = the user's cache folder.
        progress: show progress on stderr.
        layout: of files, one of `settings`.

    Returns:
        The data set's folder.

    Raises:
        ValueError: snippets too short to train on, or sizes or counts that cannot be rendered.
    """
    settings = _settings(data, layout)
    root = platformdirs.user_cache_path("mtl-bench") if root is None else Path(root)
    out = root / f"{data.dataset}-{data.height}x{data.width}-{settings.key}"
    if not out.is_dir():
        with _lock(out):
            if not out.is_dir():  # another process may have been at it while we waited
                _render(out, settings, None, progress)
    return out


def made_from(data: Data, root: Path | None, layout: str) -> str | None:
    """The key of the settings that a rendered folder has, or (None) that a recipe gives; None where
    the folder has none."""
    if root is None:
        return _settings(data, layout).key
    values = read_json(root / RECORD)
    return None if values is None else key_of(values)


def _settings(data: Data, layout: str) -> Settings:
    """Raises: ValueError: snippets too short to train on, or what `Settings` refuses."""
    needed = 2 * data.stride + 1
    if data.frames < needed:
        raise ValueError(
            f"recipe.data.frames = {data.frames}, but training compares a frame with the one "
            f"before it and the one after it at a stride of {data.stride}; set {needed} or more"
        )
    return Settings(
        data.height, data.width, data.train_scenes, data.val_scenes, data.test_scenes, data.seed,
        data.frames, _middle(data.frames), _smallest_thing(data.height, data.width),
        layout=layout,
    )  # fmt: skip


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
        layout: of files, one of `settings`.

    Raises:
        ValueError: `out` exists, or sizes or counts that cannot be rendered.
    """
    settings = Settings(
        height, width, train_scenes, val_scenes, test_scenes, seed, frames,
        _middle(frames) if annotated is None else annotated,
        _smallest_thing(height, width) if min_instance_area is None else min_instance_area,
        layout=layout,
    )  # fmt: skip
    out = Path(out)
    with _lock(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ValueError(f"{out} exists already; remove it or choose another folder")
        _render(out, settings, processes, progress)
    return out


def _middle(frames: int) -> int:
    return 19 if frames == 30 else frames // 2


def _smallest_thing(height: int, width: int) -> int:
    return max(1, round(12 * height * width / (64 * 128)))


def _lock(out: Path) -> FileLock:
    """Let one process at a time render into `out`; the system frees the lock of a dead one."""
    out.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(out.with_name(f"{out.name}.lock"))


def _render(out: Path, settings: Settings, processes: int | None, progress: bool) -> None:
    """Render beside the final place, then move: a killed run leaves nothing under that name."""
    for remains in out.parent.glob(f"{out.name}.partial-*"):  # of killed runs: we hold the lock
        shutil.rmtree(remains, ignore_errors=True)  # their last worker may still be writing
    partial = out.with_name(f"{out.name}.partial-{secrets.token_hex(4)}")
    partial.mkdir(parents=True)
    try:
        render_all(partial, settings, processes, progress)
        if out.exists():
            out.rmdir()  # empty, or rmdir refuses
        partial.rename(out)
    except BaseException:  # a full disk, or Ctrl-C
        shutil.rmtree(partial, ignore_errors=True)
        raise


def render_all(root: Path, settings: Settings, processes: int | None, progress: bool) -> None:
    """Write every scene and the summaries under `root`.

    Raises:
        OSError: a file cannot be written.
        RuntimeError: a worker died; it has written why to stderr.
    """
    total = len(settings.scenes)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count = max(1, min(processes or cores or 1, total))
    entries = _scenes(root, settings, 0, 1) if count == 1 else _children(root, settings, count)
    if progress:
        entries = _shown(entries, total, settings)
    _WRITERS[settings.layout].write_summary(root, settings, list(entries))
    settings.write(root)


def work() -> None:
    """Main function of a worker: argv is the JSON job that `_children` makes."""
    job = json.loads(sys.argv[1])
    settings = Settings(**job["settings"])
    try:
        for entry in _scenes(Path(job["root"]), settings, job["first"], job["step"]):
            print(json.dumps(entry), flush=True)
    except BrokenPipeError:  # the parent is gone
        os._exit(1)
    except OSError as error:  # a full disk: the parent says so, once
        print(json.dumps({FAILED: [error.errno, error.strerror, job["root"]]}), flush=True)


def _scenes(root: Path, settings: Settings, first: int, step: int) -> Iterator[dict[str, Any]]:
    """Write every `step`-th scene; what the summaries say of each."""
    for split, scene in settings.scenes[first::step]:
        yield _WRITERS[settings.layout].write_scene(root, settings, split, scene)


def _children(root: Path, settings: Settings, count: int) -> Iterator[dict[str, Any]]:
    """Start the workers and pass on what they report, scene by scene."""
    package_root = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join(filter(None, (package_root, os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, **_SINGLE, "PYTHONPATH": path}
    job = {"root": str(root.resolve()), "settings": asdict(settings), "step": count}
    command = [sys.executable, "-m", "mtl_bench.data.scenes"]
    children: list[subprocess.Popen[str]] = []
    try:
        for first in range(count):
            own = [*command, json.dumps({**job, "first": first})]
            children.append(
                subprocess.Popen(own, stdout=subprocess.PIPE, text=True, env=environment)
            )
        for number in range(len(settings.scenes)):
            stdout = children[number % count].stdout
            assert stdout is not None
            line = stdout.readline()  # a worker that is ahead waits in its pipe
            if not line:
                raise RuntimeError("a rendering process failed; its message stands above")
            entry = json.loads(line)
            if FAILED in entry:
                raise OSError(*entry[FAILED])
            yield entry
    finally:
        for child in children:
            child.kill()
            child.wait()


def _shown(
    entries: Iterator[dict[str, Any]], total: int, settings: Settings
) -> Iterator[dict[str, Any]]:
    """Pass through, drawing a bar in a terminal and a line per tenth elsewhere."""
    title = f"rendering {total} street scenes at {settings.height}x{settings.width}"
    console = Console(stderr=True)
    if not console.is_terminal:
        console.print(title, highlight=False)
        for i, entry in enumerate(entries, 1):
            if i * 10 // total > (i - 1) * 10 // total:
                console.print(f"  {i}/{total} scenes", highlight=False)
            yield entry
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        yield from bar.track(entries, total=total)
