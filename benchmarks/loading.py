"""Training samples a second at 1024x2048 with the recipe cityscapes, with and without the cache.

    python benchmarks/loading.py [--scenes 4] [--batches 4] [--workers 0,1,2] [--step-ms 1000]

Renders a few built-in scenes (half a minute each), adds a camera's noise until a frame's PNG is as
large as Cityscapes' are (2.3 MB), and takes batches from `train_batches`, as training does. The
share is that of time that training would wait if a step of 12 samples took that long on a device
beside the CPU: here a pause. The processor time of a sample says what a core would do, also on
a busy machine. Files lie in the system's page cache in either case.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import frame_cache, loader, scenes
from mtl_bench.data.samples import Samples, open_samples

NOISE = 0.62  # of 255, standard deviation


def make_tree(out: Path, count: int, size: tuple[int, int] = (1024, 2048)) -> Path:
    scenes.write(out, *size, count, 1, 0, frames=3)
    random, sizes = np.random.default_rng(0), []
    for path in sorted(out.rglob("*_leftImg8bit.png")):
        image = cv2.imread(str(path))
        noisy = np.rint(image + random.normal(0, NOISE, image.shape)).clip(0, 255)
        cv2.imwrite(str(path), noisy.astype(np.uint8))
        sizes.append(path.stat().st_size)
    print(f"{len(sizes)} frames of {np.mean(sizes) / 1e6:.2f} MB")
    return out


def open_tree(root: Path) -> Samples:
    cell = Cell(load_recipe("cityscapes"), backbone="", method="")
    return open_samples(cell.recipe, tasks_of_cell(cell), "train", root, training=True)


def measure(batches: Iterator[Batch], count: int, step_s: float) -> tuple[float, float]:
    """Samples a second with nothing between batches, and the share waited with a pause between."""
    samples = len(next(batches).names)  # and the workers have started
    next(batches)
    start = time.perf_counter()
    for _ in range(count):
        next(batches)
    rate = count * samples / (time.perf_counter() - start)
    start, pause = time.perf_counter(), step_s * samples / 12
    for _ in range(count):
        next(batches)
        time.sleep(pause)
    took = time.perf_counter() - start
    return rate, max(1 - count * pause / took, 0)


def processor_ms(samples: Samples, count: int = 16) -> float:
    """Of one sample, as a worker makes it: with one thread."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    start = time.process_time()
    for number in range(count):
        samples.sample(number % len(samples), torch.Generator().manual_seed(number))
    return 1000 * (time.process_time() - start) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="a tree of 1024x2048 in place of the rendered")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--batches", type=int, default=4)
    parser.add_argument("--workers", default="0,1,2")
    parser.add_argument("--ahead", type=int, default=loader.AHEAD, help="batches a worker prepares")
    parser.add_argument("--step-ms", type=float, default=1000.0)
    given = parser.parse_args()
    loader.AHEAD = given.ahead
    with tempfile.TemporaryDirectory() as folder:
        root = given.data or make_tree(Path(folder) / "tree", given.scenes)
        for cached in (False, True):
            os.environ[frame_cache.PLACE] = str(Path(folder) / "cache")
            samples = open_tree(root)
            frames = samples.dataset
            if cached:
                start = time.perf_counter()
                files = sum(1 for _ in frame_cache.build(frames.on_disk, frames.sources()))
                print(f"cache: {files} files in {time.perf_counter() - start:.1f} s")
            print(f"one sample: {processor_ms(samples):.0f} ms of a core", flush=True)
            for workers in map(int, given.workers.split(",")):
                batches = loader.train_batches(samples, len(samples), 0, workers=workers)
                rate, share = measure(batches, given.batches, given.step_ms / 1000)
                what = f"{'with' if cached else 'without'} cache, {workers} workers"
                waits = f"waits {share:.0%} of the time beside {given.step_ms:.0f} ms steps"
                print(f"{what}: {rate:.2f} samples/s, {waits}", flush=True)


if __name__ == "__main__":
    main()
