"""How much longer a training step takes beside a busy process: with one thread, and with all cores.

Each setting runs the default recipe's ResNet18 twice in one process of its own, alone and beside a
loop that keeps one core busy, in turns; the ratio of the medians is what a busy laptop costs.

    python benchmarks/busy.py --steps 40
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

BUSY = "while True: pass"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="of which the median is taken")
    parser.add_argument("--rounds", type=int, default=2, help="alone and beside it, in turns")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.steps, arguments.rounds)))
        return
    every = len(os.sched_getaffinity(0))
    print(f"{'threads':>7}  {'spin':>8}  {'alone':>8}  {'busy':>8}  ratio")
    for threads, spin in ((1, None), (every, "1000"), (every, None)):
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        environment |= {"GOMP_SPINCOUNT": spin} if spin else {}
        words = [sys.executable, __file__, "--measure", "--steps", str(arguments.steps)]
        words += ["--rounds", str(arguments.rounds)]
        output = subprocess.check_output(words, env=environment, text=True)
        alone, busy = json.loads(output.splitlines()[-1])
        name = spin or "default"
        ratio = busy / alone
        print(
            f"{threads:>7}  {name:>8}  {alone:>5.0f} ms  {busy:>5.0f} ms  {ratio:.2f}", flush=True
        )


def measure(steps: int, rounds: int) -> tuple[float, float]:
    """Median ms of a step alone and beside a busy process."""
    sys.path.insert(0, str(Path(__file__).parent))
    import torch
    from steps import open_bench

    from mtl_bench.core.device import Compute
    from mtl_bench.train.backward import backward
    from mtl_bench.train.loop import build

    cpu = torch.device("cpu")
    bench = open_bench("terms", cpu)
    _, method, _ = build(bench.cell, Compute(cpu))
    times: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(2 * rounds):
        busy = turn % 2 == 1
        neighbour = subprocess.Popen([sys.executable, "-c", BUSY]) if busy else None
        time.sleep(1)
        try:
            for step in range(steps + 3):
                start = time.perf_counter()
                bench.clear()
                parts = [bench.forwards[step % len(bench.forwards)]]
                backward(method, [parts], bench.model, scale=1.0, lr=1e-3, cosines=False)
                if step >= 3:  # the first ones warm up
                    times[busy].append(1000 * (time.perf_counter() - start))
        finally:
            if neighbour is not None:
                neighbour.kill()
    return statistics.median(times[False]), statistics.median(times[True])


if __name__ == "__main__":
    main()
