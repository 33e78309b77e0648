"""Time and memory of post-processing, step by step, for 5, 50 and 200 instances in one image.

    OMP_NUM_THREADS=1 python benchmarks/postprocess.py [--height 1024 --width 2048] [--rounds 20]

The image is made up: ellipses of thing classes over a quarter of it, whatever their number, with
noisy offsets to their middles and a heat map with a peak on each; road below, sky above. `nearest`
is a part of `grouping`; `table` is what it replaces, in the same run: a table of points x centers,
in pieces that fit the cache. Rounds take the numbers in turn, so that what else the machine does
hits them alike; medians. On one CPU thread the process' own CPU time is taken, else time on the
wall. Peak memory is what torch's allocator hands out beyond the inputs, by the profiler's record.
"""

import argparse
import itertools
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mtl_bench.core.config import Evaluate
from mtl_bench.core.geometry import back_project, depth_from_inverse
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.tasks.finish import Finish
from mtl_bench.tasks.panoptic import postprocess
from mtl_bench.tasks.panoptic.grouping import nearest

COUNTS = (5, 50, 200)
THINGS = CITYSCAPES20.things
ROAD, SKY, EGO = (CITYSCAPES20.index(name) for name in ("road", "sky", "ego vehicle"))
PIECE = 2**17  # distances of the table held at once
Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def scene(instances: int, height: int = 1024, width: int = 2048, seed: int = 0) -> Inputs:
    """Finish's arguments: classes, heat map, offsets, inverse depth, K, camera height, pitch."""
    rng = np.random.default_rng(seed)
    scale = width / 2048
    y_HW, x_HW = np.mgrid[:height, :width].astype(np.float32)
    class_HW = np.full((height, width), ROAD, np.int64)
    class_HW[: height // 3] = SKY
    class_HW[-height // 16 :] = EGO
    offset_2HW = rng.normal(0, 3, (2, height, width)).astype(np.float32)
    heat_HW = np.zeros((height, width), np.float32)
    usual = np.sqrt(0.25 * height * width / instances / np.pi)
    for _ in range(instances):
        at = rng.uniform((0.2 * height, 0.02 * width), (0.95 * height, 0.98 * width))
        radii = usual * rng.uniform(0.5, 1.4) * rng.uniform((0.6, 0.8), (1.0, 1.3))
        reach = np.maximum(radii, 40 * scale)
        low, high = np.maximum(at - reach, 0).astype(int), (at + reach + 1).astype(int)
        window = np.s_[low[0] : high[0], low[1] : high[1]]
        dy, dx = y_HW[window] - at[0], x_HW[window] - at[1]
        inside = (dy / radii[0]) ** 2 + (dx / radii[1]) ** 2 < 1
        class_HW[window][inside] = rng.choice(THINGS)
        for axis, d in enumerate((dy, dx)):
            noise = rng.normal(0, 2 * scale + 0.1 * radii[axis], d.shape)
            offset_2HW[axis][window][inside] = (noise - d)[inside]
        bump = rng.uniform(0.5, 1) * np.exp(-(dy**2 + dx**2) / (2 * (8 * scale) ** 2))
        heat_HW[window] = np.maximum(heat_HW[window], bump)
    focal = 1.1 * width
    inverse_HW = np.maximum((y_HW - height / 2) / focal / 1.4, 0.01)
    inverse_HW *= rng.normal(1, 0.05, (height, width))
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    maps = (torch.from_numpy(x)[None].float() for x in (heat_HW[None], offset_2HW))
    inverse = torch.from_numpy(inverse_HW)[None, None].float()
    classes = torch.from_numpy(class_HW)[None]
    return (classes, *maps, inverse, K, torch.tensor([1.4]), torch.tensor([0.01]))  # type: ignore


def finish() -> Finish:
    return Finish(THINGS, ROAD, Evaluate(), (EGO, SKY))


def steps(inputs: Inputs, settings: Evaluate) -> dict[str, Callable[[], object]]:
    """The parts of `finish()(*inputs)`, and the whole."""
    semantic, heat, offset, inverse, K, camera_height, pitch = inputs
    class_1HW = postprocess.classes(semantic)
    centers, count = postprocess.find_centers(heat, settings)
    _, y_N, x_N = postprocess.member(class_1HW, THINGS).nonzero(as_tuple=True)
    point_2N = torch.stack([y_N, x_N]) + offset[0][:, y_N, x_N]
    image_N = torch.zeros_like(y_N)
    depth = depth_from_inverse(inverse)
    road = class_1HW == ROAD
    size = (heat.shape[2], heat.shape[3])
    scaling = (depth, K, camera_height, road, 0.0, pitch)
    whole = finish()
    return {
        "NMS, centers": lambda: postprocess.find_centers(heat, settings),
        "stuff filter": lambda: postprocess._stuff(class_1HW, THINGS, settings.stuff_area),
        "grouping, vote": lambda: postprocess.group(
            class_1HW, centers, count, offset, THINGS, settings.stuff_area
        ),
        "- nearest": lambda: nearest(point_2N, image_N, centers, count, size),
        "(table)": lambda: nearest_by_table(point_2N, centers[0]),
        "DGC scale": lambda: postprocess.dgc_scale(*scaling),
        "points": lambda: back_project(depth, K),
        "whole": lambda: whole(*inputs),
    }


def nearest_by_table(point_2N: Tensor, center_K2: Tensor) -> Tensor:
    parts = []
    for point_2p in point_2N.split(max(PIECE // len(center_K2), 1), 1):
        distance_pK = (point_2p[0][:, None] - center_K2[:, 0]).square_()
        distance_pK += (point_2p[1][:, None] - center_K2[:, 1]).square_()
        parts.append(distance_pK.argmin(1))
    return torch.cat(parts)


def clock() -> float:
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def milliseconds(call: Callable[[], object]) -> float:
    start = clock()
    call()
    return 1000 * (clock() - start)


def peak_mib(call: Callable[[], object]) -> float:
    """Most that torch holds at once beyond what it held before, results included."""
    with torch.autograd.profiler.profile(profile_memory=True) as profiler:
        call()
    events = [e for e in profiler.kineto_results.events() if e.name() == "[memory]"]
    changes = [e.nbytes() for e in sorted(events, key=lambda event: event.start_ns())]
    return max(itertools.accumulate(changes)) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--width", type=int, default=2048)
    parser.add_argument("--rounds", type=int, default=20)
    given = parser.parse_args()
    with torch.inference_mode():
        scenes = {n: scene(n, given.height, given.width) for n in COUNTS}
        parts = {n: steps(inputs, Evaluate()) for n, inputs in scenes.items()}
        times: dict[tuple[str, int], list[float]] = {}
        for _ in range(given.rounds):
            for n, of_n in parts.items():
                for name, call in of_n.items():
                    times.setdefault((name, n), []).append(milliseconds(call))
    print(f"{given.height} x {given.width}, {torch.get_num_threads()} threads; ms, MiB\n")
    print(f"{'instances':16}" + "".join(f"{n:9}" for n in COUNTS))
    for name in parts[COUNTS[0]]:
        row = [statistics.median(times[name, n]) for n in COUNTS]
        print(f"{name:16}" + "".join(f"{value:9.1f}" for value in row))
    peaks = [peak_mib(lambda n=n: finish()(*scenes[n])) for n in COUNTS]  # type: ignore[misc]
    print(f"{'whole, peak MiB':16}" + "".join(f"{value:9.0f}" for value in peaks))
    peaks = [peak_mib(parts[n]["grouping, vote"]) for n in COUNTS]
    print(f"{'grouping, peak':16}" + "".join(f"{value:9.0f}" for value in peaks))


if __name__ == "__main__":
    main()
