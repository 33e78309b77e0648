"""What made a row: code fingerprints, versions, device. No host names, user names or paths."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell

PACKAGE = Path(__file__).resolve().parents[1]
HARNESS = (  # what numbers depend on; the rest launches, stores or shows
    "data",
    "model",
    "losses",
    "metrics",
    "method.py",
    "jacobian.py",
    "gradients.py",
    "weighting.py",
    "by_gradients.py",
    "backward.py",
    "engine.py",
    "geometry.py",
    "depth_scale.py",
    "pixels.py",
    "grouping.py",
    "postprocess.py",
    "finish.py",
    "train.py",
    "protocols.py",
    "collector.py",
    "evaluate.py",
    "pseudo_frames.py",
    "pseudo_labels.py",
    "deploy/timer.py",
    "deploy/maps.py",
)
PACKAGES = (
    "mtl-bench",
    "torch",
    "torchvision",
    "timm",
    "kornia",
    "numpy",
    "opencv-python-headless",
)


def code(cell: Cell) -> dict[str, str]:
    """Fingerprints of the code that a cell's numbers depend on: method, backbone, harness."""
    return {
        "method": plugins.fingerprint("methods", cell.method),
        "backbone": plugins.fingerprint("backbones", cell.backbone),
        "harness": harness_fingerprint(),
    }


def harness_fingerprint(package: Path = PACKAGE, names: tuple[str, ...] = HARNESS) -> str:
    """12 hexadecimal digits of the modules that produce numbers."""
    digest = hashlib.sha256()
    for name in names:
        paths = sorted((package / name).rglob("*.py")) or [package / name]
        for path in filter(Path.is_file, paths):
            digest.update(path.relative_to(package).as_posix().encode() + b"\0")
            digest.update(path.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()[:12]


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
