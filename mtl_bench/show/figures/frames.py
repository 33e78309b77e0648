"""Which frames a figure shows, chosen by name or by seed, and what a run predicts on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mtl_bench.bench.jobs import load_run
from mtl_bench.bench.stored import load_model
from mtl_bench.core.config import Cell, did_you_mean
from mtl_bench.core.dataset import dataset_in, layouts
from mtl_bench.core.device import Compute, choose_device
from mtl_bench.core.labels import LabelSet
from mtl_bench.data import pictures
from mtl_bench.data.cameras import Mounted
from mtl_bench.show.predict import Predicted, Predictor
from mtl_bench.show.predict.cameras import Given, camera_of


@dataclass(frozen=True)
class Shown:
    """One frame and what one run sees in it."""

    name: str
    predicted: Predicted
    camera: Mounted
    labels: LabelSet


def load(run: Path, device: str = "auto") -> Predictor:
    """The model of a run's folder or of a checkpoint in it.

    Raises:
        ValueError: nothing there, or no readable checkpoint.
    """
    cell, weights = load_run(run)
    compute = Compute(choose_device(device), cell.recipe.optim.precision)
    return Predictor(load_model(cell, weights, compute), cell, compute.device)


def frames_in(root: Path, split: str) -> dict[str, Path]:
    """Names and image files of a split's frames, in order; no ground truth is needed.

    Raises:
        ValueError: no known data set, no such split, or none of its frames.
    """
    dataset = dataset_in(root)
    if dataset is None:
        raise ValueError(f"{root} has none of {', '.join(layouts())}")
    return dataset.image_files(root, split)


def choose(names: Sequence[str], wanted: Sequence[str], seed: int, count: int) -> list[str]:
    """The wanted names, or as many as asked for (or as there are), drawn by seed.

    Raises:
        ValueError: a wanted name that is not there.
    """
    for name in wanted:
        if name not in names:
            raise ValueError(f"no frame '{name}' in the split{did_you_mean(name, names)}")
    if wanted:
        return list(wanted)
    drawn = np.random.default_rng(seed).permutation(len(names))[:count]
    return [names[index] for index in drawn]


def look(predictor: Predictor, name: str, path: Path) -> Shown:
    """Predict a frame of a data set at its own size, by its own camera.

    Raises:
        ValueError: a damaged image or camera file.
    """
    image_HW3 = pictures.read(path)
    camera = camera_of(path, (image_HW3.shape[0], image_HW3.shape[1]), Given())
    predicted = predictor(image_HW3, camera.K_33, camera.height_m, camera.pitch_rad)
    return Shown(name, predicted, camera, predictor.labels)


def told_apart(cells: Sequence[Cell]) -> list[str]:
    """A label a cell, of what differs between them; none where there is but one."""
    if len(cells) < 2:
        return [""]
    facts = [
        {
            "method": cell.method,
            "backbone": cell.backbone,
            "tasks": " + ".join(cell.tasks),
            "single_task": "single-task" if cell.single_task else "multi-task",
            "video": "video" if cell.video else "no video",
            "recipe": cell.recipe.name,
            "seed": f"seed {cell.seed}",
        }
        for cell in cells
    ]
    differing = [key for key in facts[0] if len({fact[key] for fact in facts}) > 1]
    labels = ["\n".join(fact[key] for key in differing) for fact in facts]
    unique = len(set(labels)) == len(labels)
    return labels if unique else [cell.slug.replace("-", "\n") for cell in cells]
