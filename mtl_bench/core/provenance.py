"""What made a row: code fingerprints, versions, device. No host names, user names or paths."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell
from mtl_bench.core.fingerprint import HARNESS, Root, fingerprints, of_package, ours

PACKAGE = Path(__file__).resolve().parents[1]
STAMPED_BEFORE = "stamped by an older version"
TOUCHED = "its data's files were written anew"  # with the same names and sizes, or settings
UNSURE = (STAMPED_BEFORE, TOUCHED)  # an evaluation of the checkpoint tells whether it still holds
NOT_REPRODUCED = "its checkpoint does not give its row's metrics"
PACKAGES = (
    "mtl-bench",
    "torch",
    "torchvision",
    "timm",
    "kornia",
    "numpy",
    "opencv-python-headless",
)


Code = dict[str, dict[str, str]]  # stage -> part -> fingerprint


def code(cell: Cell) -> Code:
    """Fingerprints of the code that each stage of a cell uses, by method, backbone and harness.

    Raises:
        ValueError: a plug-in that is not there, or is no Python.
    """
    found = {stage: fingerprints(stage, begins) for stage, begins in roots(cell).items()}
    labels = {f"labels by {part}": code for part, code in found.pop("label", {}).items()}
    found["train"] = found["train"] | labels  # a new one: fingerprints are kept and shared
    return found


def roots(cell: Cell) -> dict[str, list[Root]]:
    """Where the code of each stage begins; a video cell has the stage "label", too."""
    tasks = [plugin_root("tasks", name) for name in cell.tasks]
    dataset = plugin_root("datasets", cell.recipe.data.dataset.replace("-", "_"))
    methods = [
        Root(plugins.path_of("methods", name), part="method", base="Method")
        for name in plugins.part_names(cell.method)
    ]
    seen = [*tasks, dataset, backbone_root(cell.backbone)]
    found = {
        stage: [*(methods if stage == "train" else ()), *seen, *begins]
        for stage, begins in HARNESS_ROOTS.items()
    }
    return found | ({"label": [*tasks, dataset]} if cell.video else {})


def backbone_root(name: str) -> Root:
    return Root(plugins.path_of("backbones", name), part="backbone", base="Backbone")


def plugin_root(kind: str, name: str) -> Root:
    """Of a plug-in that may be this package's own."""
    path, base = plugins.path_of(kind, name), plugins.BASES[kind][1]
    return Root(path, part=HARNESS if ours(path) else f"{kind}/{name}.py", base=base)


_MODEL = [
    Root(of_package("model.network"), ("build_model", "side_by_side")),
    Root(of_package("core.device"), ("Compute",)),
    Root(of_package("core.task"), ("tasks_of", "finish")),
]
# Where each stage of a cell begins in this package
HARNESS_ROOTS = {
    "train": [
        Root(of_package("train.loop"), ("train",)),
        Root(of_package("evaluate.labels"), ("label",)),
        *_MODEL,
    ],
    "evaluate": [
        Root(of_package("evaluate.walk"), ("evaluate", "evaluate_together")),
        *_MODEL,
    ],
    "time": [Root(of_package("bench.stored"), ("time_cell",)), *_MODEL],
}


def changes(before: Mapping[str, Any], now: Code, words: Mapping[str, str]) -> dict[str, str]:
    """Stage -> what of its code changed since `before` was taken, in words; empty for nothing.

    Args:
        words: part -> how it is called.
    """
    if not all(isinstance(before.get(stage), Mapping) for stage in now):
        return dict.fromkeys(now, STAMPED_BEFORE)
    found = {}
    for stage, parts in now.items():
        different = [
            words.get(part, part) for part in parts if before[stage].get(part) != parts[part]
        ]
        if different:
            unknown = not before[stage]
            found[stage] = NOT_REPRODUCED if unknown else f"{', '.join(different)} changed"
    return found


def in_words(changed: Mapping[str, str]) -> str:
    """`train: methods/mine.py changed; evaluate, time: harness changed`"""
    if set(changed.values()) == {STAMPED_BEFORE}:
        return STAMPED_BEFORE
    stages: dict[str, list[str]] = {}
    for stage, why in changed.items():
        stages.setdefault(why, []).append(stage)
    return "; ".join(f"{', '.join(names)}: {why}" for why, names in stages.items())


def environment(device: Any = "cpu") -> dict[str, Any]:
    """Versions, hardware and command line; `device` is torch's, or its name."""
    import torch  # takes seconds, and only the commands that compute need it

    device = torch.device(device)
    cuda = device.type == "cuda"
    commit, dirty = git_state()
    return {
        "python": platform.python_version(),
        "os": platform.system(),
        **{name: version(name) for name in PACKAGES},
        "torch": torch.__version__,  # with its build: +cpu, +cu128
        "git_commit": commit,
        "git_dirty": dirty,
        "device": torch.cuda.get_device_name(device) if cuda else cpu_model(),
        "cuda": torch.version.cuda if cuda else None,
        "cudnn": torch.backends.cudnn.version() if cuda else None,
        "cpu": cpu_model(),
        "cores": cores(),
        "threads": torch.get_num_threads(),
        "argv": command_line(sys.argv),
    }


def version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def git_state(root: Path = PACKAGE.parent) -> tuple[str | None, bool | None]:
    """Commit of the checkout and whether it has changes; None outside a checkout or without git."""
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None, None
    commit = _git(root, "rev-parse", "HEAD")
    changes = _git(root, "status", "--porcelain")
    return commit, None if changes is None else bool(changes)


def _git(root: Path, *words: str) -> str | None:
    done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


def cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def cores() -> int:
    """Those that this process may use, which on a shared machine are fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def command_line(argv: list[str]) -> str:
    """The command as typed; of a path outside the working directory only the last name stays."""
    words = []
    for word in ["mtl-bench", *argv[1:]]:
        option, equals, value = word.rpartition("=")
        path = Path(value).expanduser()
        outside = path.is_absolute() or ".." in path.parts
        words.append(f"{option}{equals}{path.name}" if outside else word)
    return " ".join(words)
