"""Predictions that were made elsewhere -> the same metrics, by the same protocols."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import torch

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Results, Task, tasks_of
from mtl_bench.evaluate.walk import Evaluation, measure, open_walks, true_size


def score(
    recipe: Recipe,
    folders: Mapping[str, Path],
    root: Path,
    split: str | None = None,
) -> Evaluation:
    """Compare every frame's files with the truth, task by task.

    Args:
        folders: by task, where its predictions are.
        root: of the data set.
        split: in place of the protocols' own.

    Raises:
        ValueError: a task that reads no files, a frame without its file or with two, or a file that
            does not fit.
    """
    dataset = dataset_of(recipe)
    tasks = tasks_of(recipe, folders, dataset.labels)
    for task in tasks:
        if not task.scored:
            raise ValueError(f"task '{task.name}' reads no predictions that were made elsewhere")
    walks = open_walks(recipe, tasks, root, split)
    files: dict[tuple[str, str], Path] = {}
    for walk in walks:
        images = dataset.image_files(root, walk.split)
        for task in walk.tasks:
            found = _below(folders[task.name], task.scored)
            for name in walk.samples.names:
                file = _of_frame(name, images.get(name, Path(name)), found, folders[task.name])
                files[task.name, name] = file

    def results(batch: Batch, tasks: Sequence[Task]) -> dict[str, Results]:
        (name,) = batch.names
        size = true_size(batch)
        return {task.name: task.read_result(files[task.name, name], size) for task in tasks}

    cell = Cell(recipe, backbone="", method="", tasks=tuple(folders))
    return measure(cell, walks, results, torch.device("cpu"), batch_size=1)


def _below(folder: Path, endings: Sequence[str]) -> dict[str, dict[PurePosixPath, Path]]:
    """Files by their stem's last part, then by their whole path without the ending."""
    if not folder.is_dir():
        raise ValueError(f"no folder '{folder}' with predictions")
    found: dict[str, dict[PurePosixPath, Path]] = {}
    for path in sorted(folder.rglob("*")):
        own = path.relative_to(folder).as_posix()
        ending = next((ending for ending in endings if own.endswith(ending)), None)
        if ending is not None:
            key = PurePosixPath(own.removesuffix(ending))
            found.setdefault(key.name, {}).setdefault(key, path)
    return found


def _of_frame(
    name: str, image: Path, found: Mapping[str, Mapping[PurePosixPath, Path]], folder: Path
) -> Path:
    """The one file that is named as the frame or as its image, below the same folders or none."""
    wanted = [PurePosixPath(name), PurePosixPath(image.with_suffix("").as_posix())]
    fits = {
        path
        for full in wanted
        for key, path in found.get(full.name, {}).items()
        if all(own == other for own, other in zip(key.parts[::-1], full.parts[::-1], strict=False))
    }
    if len(fits) != 1:
        what = f"{len(fits)} files" if fits else "no file"
        raise ValueError(f"{folder}: {what} for the frame {name} (image {image.name})")
    return fits.pop()
