"""What `gpu.sh` runs: parts with a time limit each, and one JSON of what they found.

Every part is a process of its own, forked from this one, which has imported torch and never asks
for CUDA. A part that fails or is late is recorded with the end of what it printed, and the others
go on; the exit code is 1 then. The JSON is written anew after each part.
"""

import argparse
import contextlib
import importlib.util
import io
import json
import multiprocessing
import os
import re
import resource
import runpy
import signal
import statistics
import sys
import tempfile
import time
import tomllib
import traceback
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
TOTAL_S = 470.0
TAIL = 1500  # characters of a failed part's output
WARM = 10  # training steps that are left out of the medians
MARK = "mark.cuda"

MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL"}  # others are called as the package

Found = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """Sizes of everything: the paper's on a GPU, tiny ones in a rehearsal."""

    device: str
    size: tuple[int, int]
    scenes: int
    backbone: str
    tests: tuple[str, ...]  # further words for pytest
    engines: tuple[tuple[str, str], ...]  # with their precisions
    timing: tuple[str, ...]  # further words for `latency`
    training: tuple[str, ...]  # further words for `train`
    steps: int
    costs: tuple[str, ...]  # words for `methods_cost.py`
    patience: float = 1.0  # times the limits


FAST = ("eager", "compile", "tensorrt")  # compile: on CUDA as CUDA graphs
ON_GPU = Plan(
    "cuda",
    (1024, 2048),
    14,  # a core each, and more than a batch of 12
    "resnet18",
    (),
    (("plain", "fp32"), *((name, precision) for name in FAST for precision in ("fp32", "fp16"))),
    ("--seconds", "8"),
    (),
    50,
    ("--rounds", "3"),
)
REHEARSAL = Plan(
    "cpu",
    (64, 128),
    4,
    "tiny",
    ("-k", "cuda_events"),
    (("eager", "fp32"),),
    ("--recipe", "smoke", "--passes", "2", "--seconds", "1", "--batch", "1", "--threads", "1"),
    tuple(
        f"recipe.{key}"
        for key in (
            *("data.height=64", "data.width=128", "data.workers=1", "augment.crop=[64,64]"),
            *(
                "network.strides=[2,4,8]",
                "network.channels=8",
                "network.fused=8",
                "network.head=8",
                "network.pose=light",
            ),
            *("network.pose_channels=8", "optim.batch=4", "optim.micro_batch=2"),
            *("optim.precision=fp32", "optim.warmup_steps=1"),
        )
    ),
    3,
    ("--recipe", "smoke", "--quick", "uncertainty"),
    4.0,  # on a busy machine
)


# --- the parts, each in its own process -----------------------------------------------------------


def environment(plan: Plan, work: Path) -> Found:
    """Versions and hardware; fails where the device is not there."""
    import torch

    from mtl_bench.core import provenance
    from mtl_bench.core.device import choose_device

    device = choose_device(plan.device)
    found = provenance.environment(device) | {"lacking": lacking()}
    del found["argv"]
    if device.type == "cuda":
        facts = torch.cuda.get_device_properties(device)
        found |= {
            "capability": f"{facts.major}.{facts.minor}",
            "memory_gib": facts.total_memory / 2**30,
            "multiprocessors": facts.multi_processor_count,
        }
    return found


def lacking() -> list[str]:
    """Packages that pyproject.toml names and nobody installed; not all of them are used here."""
    needs = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = [re.split("[<>=]", need)[0] for need in needs]
    return [name for name in names if importlib.util.find_spec(MODULES.get(name, name)) is None]


def scenes(plan: Plan, work: Path) -> Found:
    """Built-in scenes in Cityscapes' layout, with a camera's noise, so that files are as large."""
    from loading import make_tree

    tree = make_tree(work / "tree", plan.scenes, plan.size)
    images = list(tree.rglob("*_leftImg8bit.png"))
    return {"size": plan.size, "frames": len(images), "mb": _mean_mb(images)}


def tests(plan: Plan, work: Path) -> Found:
    """The tests marked `cuda`."""
    files = [path for path in sorted(ROOT.glob("tests/**/test_*.py")) if MARK in path.read_text()]
    report = work / "tests.xml"
    words = ["-q", "-m", "cuda", "-p", "no:cacheprovider", f"--junitxml={report}", *plan.tests]
    _run("pytest", *words, *map(str, files))
    cases = list(ET.parse(report).getroot().iter("testcase"))
    bad = [case for case in cases if {"failure", "error"} & {child.tag for child in case}]
    skipped = [case for case in cases if case.find("skipped") is not None]
    names = [f"{case.get('classname')}::{case.get('name')}" for case in bad]
    return {
        "passed": len(cases) - len(bad) - len(skipped),
        "skipped": len(skipped),
        "failed": names,
        "good": not bad and len(cases) > len(skipped),
    }


def latency(plan: Plan, work: Path, engine: str, precision: str) -> Found:
    """One engine at one precision, after it was compared with the plain network."""
    file = work / f"{engine}-{precision}.json"
    height, width = plan.size
    words = ["--backbone", plan.backbone, "--size", f"{height}x{width}", "--data", work / "tree"]
    words += ["--engine", engine, "--precision", precision, "--device", plan.device]
    _run("mtl_bench", "latency", *words, "--json", file, *plan.timing)
    row = json.loads(file.read_text())
    status, why, metric = row["status"], row["why"], row["metric"]
    return {"row": status, "why": why, **metric, "good": status in ("done", "unavailable")}


def training(plan: Plan, work: Path) -> Found:
    """Steps of the recipe cityscapes; those behind the first ones count."""
    runs = work / "runs"
    words = ["--recipe", "cityscapes", "--backbone", plan.backbone]
    words += [
        "--method",
        "fixed_uncertainty",
        "--data",
        work / "tree",
        "--runs",
        runs,
        "--device",
        plan.device,
    ]
    own = [f"recipe.optim.steps={plan.steps}", "recipe.evaluate.split=none"]
    own += ["recipe.latency.passes=5", "recipe.latency.warmup=1", *plan.training]
    _run("mtl_bench", "train", *words, *(word for value in own for word in ("--set", value)))
    (folder,) = runs.glob("*/row.json")
    row = json.loads(folder.read_text())
    from mtl_bench.train.curve import read

    curve = read(folder.parent / "curve.csv")
    step_ms, data_ms = ([float(line[key]) for line in curve] for key in ("step_ms", "data_ms"))
    first = min(WARM, len(curve) - 1)
    optim = json.loads((folder.parent / "cell.json").read_text())["recipe"]["optim"]
    return {
        "steps": len(curve),
        "counted": len(curve) - first,
        "step_ms": statistics.median(step_ms[first:]),
        "data_share": sum(data_ms[first:]) / sum(step_ms[first:]),
        "peak_mib": row["time"]["peak_mib"],
        **{key: optim[key] for key in ("precision", "batch", "micro_batch")},
    }


def methods(plan: Plan, work: Path) -> Found:
    """The table of `methods_cost.py`, a dictionary a method."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        _run(str(HERE / "methods_cost.py"), "--device", plan.device, *plan.costs)
    text = printed.getvalue()
    lines = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in text.splitlines()
        if line.startswith("| ") and not line.startswith("| ---")
    ]
    head, *rows = lines
    return {
        "about": text.partition("\n")[0],
        "methods": [dict(zip(head, row, strict=True)) for row in rows],
    }


def _run(name: str, *words: object) -> None:
    """A module or a file with these words, in this process; its exit code is the caller's affair,
    since what it wrote says more."""
    sys.argv = [name, *map(str, words)]
    with contextlib.suppress(SystemExit):
        if name.endswith(".py"):
            runpy.run_path(name, run_name="__main__")
        else:
            runpy.run_module(name, run_name="__main__", alter_sys=True)


def _mean_mb(paths: list[Path]) -> float:
    return sum(path.stat().st_size for path in paths) / len(paths) / 1e6


# --- one after another ----------------------------------------------------------------------------


def parts_of(plan: Plan) -> Iterator[tuple[str, float, Callable[[Plan, Path], Found]]]:
    """Name, seconds at most, what runs."""
    yield "environment", 30, environment
    yield "scenes", 80, scenes
    yield "tests", 80, tests
    for engine, precision in plan.engines:
        limit = 60 if engine in ("compile", "tensorrt") else 30
        yield (
            f"latency {engine} {precision}",
            limit,
            partial(latency, engine=engine, precision=precision),
        )
    yield "training", 90, training
    yield "methods", 110, methods


def take(run: Callable[[Plan, Path], Found], plan: Plan, work: Path, limit_s: float) -> Found:
    """What a part found, and how it ended: done, failed or late."""
    answer, log = work / "answer.json", work / "log"
    answer.unlink(missing_ok=True)
    start, cpu_s = time.monotonic(), _cpu_s()
    process = multiprocessing.get_context("fork").Process(target=_child, args=(run, plan, work))
    process.start()
    process.join(limit_s)
    late = process.is_alive()
    with contextlib.suppress(ProcessLookupError):  # the part's own children, too
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    found: Found = json.loads(answer.read_text()) if answer.is_file() and not late else {}
    good = bool(found) and found.pop("good", True)
    ended = {"status": "late" if late else "done" if good else "failed"}
    ended |= {"seconds": round(time.monotonic() - start, 1), "limit_s": round(limit_s)}
    ended["cpu_s"] = round(_cpu_s() - cpu_s, 1)
    if not good:
        ended["output"] = log.read_text(errors="replace")[-TAIL:]
    return ended | found


def _cpu_s() -> float:
    """Of all processes that were started here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _child(run: Callable[[Plan, Path], Found], plan: Plan, work: Path) -> None:
    os.setsid()
    os.chdir(ROOT)
    with (work / "log").open("w", buffering=1) as file:
        for number in (1, 2):
            os.dup2(file.fileno(), number)
        with contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                found = run(plan, work)
            except BaseException:
                traceback.print_exc()
                raise SystemExit(1) from None
    (work / "answer.json").write_text(json.dumps(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("out", nargs="?", type=Path, metavar="FOLDER", help="default: $OUT")
    parser.add_argument("--cpu-rehearsal", action="store_true", help="tiny, on the CPU")
    given = parser.parse_args()
    out = given.out or Path(os.environ.get("OUT") or parser.error("say where to: FOLDER, or $OUT"))
    out.mkdir(parents=True, exist_ok=True)
    plan = REHEARSAL if given.cpu_rehearsal else ON_GPU
    if given.cpu_rehearsal:
        os.environ["MTL_BENCH_REHEARSAL"] = "1"
    sys.path.insert(0, str(HERE))
    try:
        import mtl_bench.bench.run
        import mtl_bench.cli.app  # noqa: F401  # parts are forked with them
    except ImportError as error:
        sys.exit(f"{error}; not installed: {', '.join(lacking())}")

    start = time.monotonic()
    parts: dict[str, Found] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, limit, run in parts_of(plan):
            left = TOTAL_S * plan.patience - (time.monotonic() - start)
            found = take(run, plan, Path(folder), max(min(limit * plan.patience, left), 1))
            parts[name] = found
            bad = [part for part, one in parts.items() if one["status"] != "done"]
            result = {"rehearsal": given.cpu_rehearsal, "ok": not bad, "bad": bad, "parts": parts}
            result["seconds"] = round(time.monotonic() - start, 1)
            (out / "gpu.json").write_text(json.dumps(result, indent=1))
            print(f"{name}: {found['status']}, {found['seconds']} s", flush=True)
            if name == "environment" and bad:
                break  # without the device nothing else can run
    for part in bad:
        print(f"\n--- {part}: {parts[part]['status']}\n{parts[part]['output']}")
    print(out / "gpu.json")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
