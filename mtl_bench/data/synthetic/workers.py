"""Renders all scenes of a data set in parallel worker processes, with progress on stderr.

Workers are plain child processes rather than a multiprocessing pool: they do not import the
caller's main module again (safe from scripts, notebooks and the prompt), and when the parent is
killed, the next line that they print finds a closed pipe and ends them.
"""

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mtl_bench.data.layouts import CITYSCAPES, KITTI
from mtl_bench.data.synthetic import files, kitti_layout
from mtl_bench.data.synthetic.settings import Settings

_WRITERS: dict[str, ModuleType] = {CITYSCAPES: files, KITTI: kitti_layout}

_SINGLE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def render_all(root: Path, settings: Settings, processes: int | None, progress: bool) -> None:
    """Write every scene and the summaries under `root`.

    Raises:
        RuntimeError: a worker died; it has written why to stderr.
    """
    total = len(settings.scenes)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count = max(1, min(processes or cores or 1, total))
    lines = _own(root, settings) if count == 1 else _children(root, settings, count)
    entries = list(_shown(lines, total, settings) if progress else lines)
    _WRITERS[settings.layout].write_summary(root, settings, entries)


def work() -> None:
    """Main function of a worker: argv is the JSON job that `_children` makes."""
    job = json.loads(sys.argv[1])
    settings = Settings(**job["settings"])
    write_scene = _WRITERS[settings.layout].write_scene
    for split, scene in settings.scenes[job["first"] :: job["step"]]:
        line = json.dumps(write_scene(Path(job["root"]), settings, split, scene))
        try:
            print(line, flush=True)
        except BrokenPipeError:  # the parent is gone
            os._exit(1)


def _own(root: Path, settings: Settings) -> Iterator[dict[str, Any]]:
    for split, scene in settings.scenes:
        yield _WRITERS[settings.layout].write_scene(root, settings, split, scene)


def _children(root: Path, settings: Settings, count: int) -> Iterator[dict[str, Any]]:
    """Start the workers and pass on what they report, in the order of arrival."""
    package_root = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join(filter(None, (package_root, os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, **_SINGLE, "PYTHONPATH": path}
    lines: queue.Queue[str | int] = queue.Queue()

    def start(number: int) -> subprocess.Popen[str]:
        job = {
            "root": str(root.resolve()),
            "settings": asdict(settings),
            "first": number,
            "step": count,
        }
        return subprocess.Popen(
            [sys.executable, "-m", "mtl_bench.data.synthetic", json.dumps(job)],
            stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def listen(number: int, child: subprocess.Popen[str]) -> None:
        assert child.stdout is not None
        for line in child.stdout:
            lines.put(line)
        child.wait()
        lines.put(number)

    children = [start(i) for i in range(count)]
    try:
        for i, child in enumerate(children):
            threading.Thread(target=listen, args=(i, child), daemon=True).start()
        running = count
        while running:
            line = lines.get()
            if isinstance(line, str):
                yield json.loads(line)
                continue
            running -= 1
            if children[line].returncode:
                raise RuntimeError("a rendering process failed; its message stands above")
    finally:
        for child in children:
            child.kill()
            child.wait()


def _shown(
    lines: Iterator[dict[str, Any]], total: int, settings: Settings
) -> Iterator[dict[str, Any]]:
    """Pass through, drawing a bar in a terminal and a line per tenth elsewhere."""
    title = f"rendering {total} street scenes at {settings.height}x{settings.width}"
    console = Console(stderr=True)
    if not console.is_terminal:
        console.print(title, highlight=False)
        for i, line in enumerate(lines, 1):
            if i * 10 // total > (i - 1) * 10 // total:
                console.print(f"  {i}/{total} scenes", highlight=False)
            yield line
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=total)
        for line in lines:
            bar.advance(task)
            yield line
