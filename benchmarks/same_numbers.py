"""Does a change move any number? Record what a checkout computes; compare two records bit for bit.

    python benchmarks/same_numbers.py record --checkout . --out before.json
    python benchmarks/same_numbers.py record --checkout . --out after.json
    python benchmarks/same_numbers.py compare before.json after.json

A record holds the metrics of every row of three smoke grids, the ids of every shipped grid's
cells and timings, a digest of every tensor of `last.pt` after 60 steps of four methods, and the
outputs of an exported ONNX file. Times are left out. Only the command line is used, so that a
record of an older checkout can be compared with one of a newer. Takes about 12 minutes on a core.

Numbers depend on the machine and on the number of threads: compare records of one machine.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

GRIDS = (
    ("ablation", ["--smoke"]),
    ("kitti", ["--smoke"]),
    ("methods", ["--recipe", "smoke"]),
)
TRAINED = ("fixed_uncertainty", "pcgrad", "fixed_uncertainty+nash", "mgda_ub")
STEPS = 60


def record(checkout: Path, work: Path) -> dict[str, str]:
    """Every number of a checkout, as text."""
    found: dict[str, str] = {}
    for path in sorted((checkout / "mtl_bench").rglob("grids/*.toml")):
        found |= ids(checkout, path.stem, work)
    for grid, options in GRIDS:
        runs = work / grid
        words = ["ablate", "--grid", grid, *options, "--runs", runs, "--reports", work / "reports"]
        run(checkout, *words)
        found |= metrics(grid, runs)
    for method in TRAINED:
        words = ["train", "--backbone", "resnet18", "--method", method, "--runs", work / method]
        words += ["--set", f"recipe.optim.steps={STEPS}", "--set", "recipe.data.val_scenes=4"]
        run(checkout, *words, "--set", "recipe.latency.passes=1")
        (checkpoint,) = (work / method).glob("*/last.pt")
        found |= tensors(f"{method} last.pt", checkpoint)
        found |= metrics(method, work / method)
        if method == TRAINED[0]:
            net = work / "net.onnx"
            run(
                checkout,
                "export",
                "--checkpoint",
                checkpoint.parent,
                "--size",
                "64x128",
                "--out",
                net,
            )
            found |= exported(net)
    return found


def run(checkout: Path, *words: object) -> str:
    command = [sys.executable, "-m", "mtl_bench", *map(str, words)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return done.stdout


def ids(checkout: Path, grid: str, work: Path) -> dict[str, str]:
    """Of all jobs that a status lists, in its order."""
    text = run(checkout, "status", "--grid", grid, "--runs", work / "none")
    found = re.findall(r"\b[0-9a-f]{12}\b", text)
    assert found, f"no id in\n{text}"
    return {f"ids of {grid}": " ".join(found)}


def metrics(title: str, runs: Path) -> dict[str, str]:
    found = {}
    for path in sorted(runs.glob("*/row.json")):
        row = json.loads(path.read_text())
        for key, value in sorted(row["metric"].items()):
            if not key.startswith("latency.") or key in ("latency.params_m", "latency.gmacs"):
                found[f"{title} {row['slug']} {key}"] = repr(value)
    return found


def tensors(title: str, checkpoint: Path) -> dict[str, str]:
    import torch

    found: dict[str, str] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, torch.Tensor):
            content = value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy()
            digest = hashlib.sha256(content.tobytes()).hexdigest()[:16]
            found[name] = f"{value.dtype} {list(value.shape)} {digest}"
        elif isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{name}.{key}")
        elif isinstance(value, (list, tuple)):
            for index, inner in enumerate(value):
                walk(inner, f"{name}.{index}")
        else:
            found[name] = repr(value)

    walk(torch.load(checkpoint, weights_only=True), title)
    return found


def exported(net: Path) -> dict[str, str]:
    """Digests of what the graph answers to images of noise."""
    import numpy as np
    import onnxruntime

    session = onnxruntime.InferenceSession(str(net), providers=["CPUExecutionProvider"])
    draw = np.random.default_rng(0)
    given: dict[str, Any] = {}
    for item in session.get_inputs():
        if item.type == "tensor(uint8)":
            given[item.name] = draw.integers(0, 256, item.shape, np.uint8)
        elif item.shape[-2:] == [3, 3]:
            given[item.name] = np.array([[[70, 0, 64], [0, 70, 32], [0, 0, 1]]], np.float32)
        else:
            given[item.name] = np.full(item.shape, 1.5, np.float32)
    found = {}
    for item, value in zip(session.get_outputs(), session.run(None, given), strict=True):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
        found[f"onnx {item.name}"] = f"{value.dtype} {list(value.shape)} {digest}"
    return found


def compare(before: dict[str, str], after: dict[str, str]) -> int:
    """Print what differs; how many lines that are."""
    wrong = 0
    for key in sorted(before.keys() | after.keys()):
        one, two = before.get(key, "absent"), after.get(key, "absent")
        if one != two:
            wrong += 1
            if wrong <= 40:
                print(f"{key}\n  before {one}\n  after  {two}")
    print(f"{len(before)} values before, {len(after)} after, {wrong} differ")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("record")
    one.add_argument("--checkout", type=Path, required=True)
    one.add_argument("--out", type=Path, required=True)
    two = commands.add_parser("compare")
    two.add_argument("before", type=Path)
    two.add_argument("after", type=Path)
    words = parser.parse_args()
    if words.command == "record":
        with tempfile.TemporaryDirectory() as work:
            found = record(words.checkout.resolve(), Path(work))
        words.out.write_text(json.dumps(found, indent=1))
    else:
        before, after = (json.loads(path.read_text()) for path in (words.before, words.after))
        sys.exit(1 if compare(before, after) else 0)


if __name__ == "__main__":
    main()
