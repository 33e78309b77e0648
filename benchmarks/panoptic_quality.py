"""Time of panoptic quality for one full-size image: ours, hotcoco's and cityscapesscripts'.

    OMP_NUM_THREADS=1 python benchmarks/panoptic_quality.py [--images 8 --rounds 5 --threads 2]

Truth and predictions are made up: `postprocess.py`'s scenes, the truth moved by a few pixels. All
decode both maps of every image: the others COCO's panoptic format, ours Cityscapes' 16-bit files.
"In memory" is what a frame takes in an evaluation of ours, whose predictions are no files: panoptic
quality, semantic IoU and the picture for the report, nothing decoded. Rounds take the evaluators in
turn; milliseconds an image on the wall and of all threads' CPU time, medians. hotcoco's threads are
RAYON_NUM_THREADS, ours a pool. PQ must agree.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from cityscapesscripts.evaluation import evalPanopticSemanticLabeling as csEval
from numpy.typing import NDArray
from postprocess import THINGS, scene

from mtl_bench.core.config import Evaluate
from mtl_bench.core.labels import DIVISOR
from mtl_bench.data import png
from mtl_bench.data.labels import CITYSCAPES20 as LABELS
from mtl_bench.tasks.panoptic import PanopticMetric, grouping
from mtl_bench.tasks.panoptic.files import write_panoptic
from mtl_bench.tasks.panoptic.metrics import PanopticQuality, Tally

try:
    from hotcoco import panoptic as hotcoco
except ImportError:
    hotcoco = None  # nothing to compare with

Frame = dict[str, NDArray[Any]]
INSTANCES = 50
THING_IDS = {label.label_id for label in LABELS.labels if label.is_thing}


def frame(seed: int, height: int, width: int) -> tuple[Frame, Frame]:
    """Truth and result of one image, as `PanopticMetric.update` takes them."""
    semantic, heat, offset, *_ = scene(INSTANCES, height, width, seed)
    class_1HW = grouping.classes(semantic)
    found_1HW = grouping.panoptic(class_1HW, heat, offset, THINGS, Evaluate())
    ids_HW = grouping.to_instance_ids(found_1HW, LABELS)[0].numpy()
    truth = np.roll(ids_HW, (3, 5), (0, 1))
    return {"instance_ids": truth}, {
        "panoptic": found_1HW[0].numpy(),
        "class": class_1HW[0].numpy(),
    }


def measured(frames: list[tuple[Frame, Frame]]) -> float:
    metric = PanopticMetric(LABELS, "val")
    for truth, result in frames:
        metric.update(truth, result)
    return metric.compute()["panoptic.pq"]


def write(folder: Path, frames: list[tuple[Frame, Frame]]) -> tuple[Path, Path]:
    """Files for all evaluators; the two JSON files for the others."""
    found, true = [], []
    for index, (truth, result) in enumerate(frames):
        panoptic = torch.from_numpy(result["panoptic"])
        found.append((str(index), grouping.to_instance_ids(panoptic, LABELS).numpy()))
        true.append((str(index), truth["instance_ids"]))
        for name, (_, ids_HW) in (("found", found[-1]), ("true", true[-1])):
            cv2.imwrite(str(folder / f"{index}_{name}.png"), ids_HW.astype(np.uint16))
    paths = []
    for name, maps in (("true", true), ("found", found)):
        paths.append(write_panoptic(folder / name, "val", maps))
        written = json.loads(paths[-1].read_text())
        for index, (annotation, (_, ids_HW)) in enumerate(
            zip(written["annotations"], maps, strict=True)
        ):
            annotation["image_id"] = index
            for segment in annotation["segments_info"]:
                crowd = segment["category_id"] in THING_IDS and segment["id"] < DIVISOR
                segment |= {"iscrowd": int(crowd), "area": int((ids_HW == segment["id"]).sum())}
        written["images"] = [{"id": i, "file_name": f"{i}.png"} for i in range(len(frames))]
        written["categories"] = [
            {"id": label.label_id, "name": label.name, "isthing": int(label.is_thing)}
            for label in LABELS.labels
            if label.evaluated
        ]
        paths[-1].write_text(json.dumps(written))
    return paths[0], paths[1]


def of_official(known: Path, found: Path) -> float:
    truth, results = (json.loads(path.read_text()) for path in (known, found))
    by_image = {one["image_id"]: one for one in results["annotations"]}
    pairs = [(one, by_image[one["image_id"]]) for one in truth["annotations"]]
    categories = {one["id"]: one for one in truth["categories"]}
    folders = (str(path.with_suffix("")) for path in (known, found))
    statistic = csEval.pq_compute_single_core(0, pairs, *folders, categories)
    return float(100 * csEval.average_pq(statistic, categories)["All"]["pq"])


def of_hotcoco(known: Path, found: Path) -> float:
    evaluator = hotcoco.PanopticEval(str(known), str(found))
    evaluator.evaluate()
    return float(100 * evaluator.results()["All"]["pq"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--width", type=int, default=2048)
    parser.add_argument("--images", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    os.environ["RAYON_NUM_THREADS"] = str(given.threads)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    frames = [frame(seed, given.height, given.width) for seed in range(given.images)]
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(given.threads) as pool:
        folder = Path(name)
        paths = write(folder, frames)

        def from_files(index: int) -> Tally:
            found, true = (png.read(folder / f"{index}_{x}.png", 16) for x in ("found", "true"))
            return PanopticQuality(LABELS).update(found, true)

        def ours(tallies: Iterable[Tally]) -> float:
            total = PanopticQuality(LABELS)
            for tally in tallies:
                total.tally += tally
            return float(total.compute()["pq"])

        indices = range(given.images)
        calls: dict[str, Callable[[], float]] = {
            "ours, in memory, 1 thread": lambda: measured(frames),
            "ours, 1 thread": lambda: ours(map(from_files, indices)),
            f"ours, {given.threads} threads": lambda: ours(pool.map(from_files, indices)),
            "cityscapesscripts, 1 thread": lambda: of_official(*paths),
        }
        if hotcoco is not None:
            calls[f"hotcoco, {given.threads} threads"] = lambda: of_hotcoco(*paths)
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
        quality = {name: call() for name, call in calls.items()}
        for _ in range(given.rounds):
            for name, call in calls.items():
                start, cpu = time.perf_counter(), time.process_time()
                call()
                both = (time.perf_counter() - start, time.process_time() - cpu)
                times[name].append(both)
    print(f"{given.height} x {given.width}, {given.images} images; ms an image\n")
    print(f"{'':30}{'wall':>8}{'CPU':>8}{'PQ':>12}")
    for name, taken in times.items():
        wall, cpu = (1000 * statistics.median(x) / given.images for x in zip(*taken, strict=True))
        print(f"{name:30}{wall:8.1f}{cpu:8.1f}{quality[name]:12.6f}")


if __name__ == "__main__":
    main()
