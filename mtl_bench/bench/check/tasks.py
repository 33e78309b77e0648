"""What every task has to hold, tried on data at hand with a small network."""

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from mtl_bench.core.batch import Batch
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.dataset import NEIGHBOURS, DecodedFrame, Kind, dataset_of
from mtl_bench.core.labels import OUTSIDE
from mtl_bench.core.plugins import files, load
from mtl_bench.core.quality import columns_of
from mtl_bench.core.recipe import Recipe
from mtl_bench.core.task import Results, Task, tasks_of, terms_of
from mtl_bench.data.augment import OUTSIDE_OF
from mtl_bench.data.loader import eval_batches, train_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate.walk import evaluating, frame_of, frame_truth, predict, true_size
from mtl_bench.model import Model, build_model

RECIPE, BACKBONE = "smoke", "tiny"


def _recipe(kind: type[Task]) -> tuple[Recipe, str] | None:
    """The smoke recipe with a data set at hand that has what a task needs, and the task's field."""
    smoke, wanted = load_recipe(RECIPE), kind.needs | kind.truth
    first = smoke.data.dataset.replace("-", "_")
    for name in (first, *(name for name in files("datasets") if name != first)):
        dataset = load("datasets", name)
        fields = dataset.predicts.get(kind.name, ()) if kind.of_field else ("",)
        has = dataset.fields.keys() | ({NEIGHBOURS} if name == first else set())
        if fields and wanted <= has:
            data = replace(smoke.data, dataset=name.replace("_", "-"))
            recipe = replace(smoke, data=data)
            if _root(recipe) is not None:
                return recipe, fields[0]
    return None


@functools.cache
def _root(recipe: Recipe) -> Path | None:
    """A few frames: rendered, or the example that the data set writes, where it does."""
    dataset = dataset_of(recipe)
    if dataset.built_in:
        return dataset.render(recipe.data, quiet=True)
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    return folder if dataset.example(folder, recipe.data) else None


def _model(kind: type[Task]) -> Model:
    """A network with this task and those whose results it reads."""
    found = _recipe(kind)
    assert found is not None
    recipe, field = found
    own = f"{kind.name}:{field}" if field else kind.name
    names = (own, *(name for name in kind.after if name in files("tasks")))
    tasks = tasks_of(recipe, names, dataset_of(recipe).labels)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return build_model(Cell(recipe, BACKBONE, "", names), tasks)


def _on_data(check: Callable[[type[Task]], str | None]) -> Callable[[type[Task]], str | None]:
    """Only where some data have what the task needs."""

    def checked(kind: type[Task]) -> str | None:
        if _recipe(kind) is None:
            lacking = sorted(
                (kind.needs | kind.truth) - dataset_of(load_recipe(RECIPE)).fields.keys()
            )
            return f"not tried: no data set at hand has {', '.join(lacking) or 'a field for it'}"
        return check(kind)

    return checked


def _batch(model: Model, training: bool) -> Batch:
    recipe = model.tasks[0].recipe
    split, root = "train" if training else recipe.evaluate.split, _root(recipe)
    assert root is not None
    samples = open_samples(recipe, model.tasks, split, root, training)
    if training:
        for task in model.tasks:
            task.begin(samples.dataset)
        return next(train_batches(samples, 2, seed=0))
    return next(eval_batches(samples, 2))


def _own(model: Model, kind: type[Task]) -> Task:
    return next(task for task in model.tasks if isinstance(task, kind))


def _declared(kind: type[Task]) -> None:
    names = [term.name for term in kind.terms]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"terms {names}: a task has one or more, of different names")
    kinds = {term.kind for term in kind.terms} | {kind.kind}
    if not kinds <= {"classification", "regression"}:
        raise ValueError(f"kinds {sorted(kinds)} are not classification or regression")
    if not columns_of(kind.name):
        raise ValueError("no columns: nothing of what it measures would stand in a table")


def _losses(kind: type[Task]) -> None:
    """Each term is a finite scalar, and together they train the task's own head."""
    model = _model(kind).train()
    batch = _batch(model, training=True)
    losses = model.losses(model(batch), batch)
    wanted = {term.name for term in terms_of(model.tasks)}
    if set(losses) != wanted:
        raise ValueError(f"losses {sorted(losses)} are not the terms {sorted(wanted)}")
    task = _own(model, kind)
    own = [losses[term.name] for term in task.terms]
    if not all(loss.dim() == 0 and torch.isfinite(loss) for loss in own):
        raise ValueError(f"losses {[loss.tolist() for loss in own]} are no finite scalars")
    torch.stack(own).sum().backward()
    heads = task.head((8, 8, 8), task.recipe.network).heads
    trained = {
        name.split(".")[1]
        for name, parameter in model.net.named_parameters()
        if name.startswith("heads.") and parameter.grad is not None
    }
    if not heads.keys() <= trained:
        raise ValueError(f"no loss trains {', '.join(heads.keys() - trained)}")


_BLANK = {Kind.IDS, Kind.DEPTH, Kind.INVERSE_DEPTH, Kind.NORMALS}  # their padding has no value


def _no_pixels(kind: type[Task]) -> str | None:
    """Of a sample that is all padding, no term is there: a loss of 0 would call it solved."""
    model = _model(kind).train()
    task, root = _own(model, kind), _root(model.tasks[0].recipe)
    assert root is not None
    samples = open_samples(task.recipe, model.tasks, "train", root, training=True)
    kinds, read = samples.dataset.fields, samples.dataset.read
    valued = sorted(name for name in task.needs & kinds.keys() if kinds[name] not in _BLANK)
    if valued:
        return f"not tried: padding has a value in {', '.join(valued)}"

    def padding(name: str) -> DecodedFrame:
        frame = read(name)
        fields = {
            key: torch.full_like(value, OUTSIDE_OF.get(kinds[key], 0))
            for key, value in frame.fields.items()
        }
        outside = torch.full(frame.images_N3HW[0].shape[-2:], OUTSIDE, dtype=torch.int32)
        return replace(frame, fields=fields, static=outside)

    samples.dataset.read = padding  # type: ignore[method-assign]
    for each in model.tasks:
        each.begin(samples.dataset)
    batch = next(train_batches(samples, 2, seed=0))
    found = task.losses(model(batch).maps[task.name], batch)
    if found:
        raise ValueError(
            f"a sample without a valid pixel has the terms {', '.join(found)}: leave out a term "
            f"that has no pixels"
        )
    return None


def _results(model: Model, batch: Batch) -> dict[str, Results]:
    with evaluating(model), torch.inference_mode():
        return predict(model, batch, model.tasks, true_size(batch))


def _measures(kind: type[Task]) -> None:
    """Results have one entry a frame; the metrics have the columns; states add up."""
    model = _model(kind)
    batch = _batch(model, training=False)
    task = _own(model, kind)
    found = _results(model, batch)[task.name]
    uneven = [name for name, value in found.items() if len(value) != len(batch.names)]
    if uneven:
        raise ValueError(f"results {', '.join(uneven)} have not one entry a frame")
    whole, added = task.metrics()[0], task.metrics()[0]
    for slot in range(len(batch.names)):
        alone = task.metrics()[0]
        for metric in (whole, alone):
            metric.update(frame_truth(task, batch, slot), frame_of(found, slot))
        added.add(alone.state())
    numbers = whole.compute()
    pairs = ((numbers, added.compute()), (whole.record(), added.record()))
    for expected, other in pairs:  # ranks that share an evaluation add frames up in this way
        if repr(other) != repr(expected):
            raise ValueError(
                f"states added frame by frame give {other}, not {expected}: a metric's `add` makes "
                f"the same additions as its `update`"
            )
    missing = [c.key for c in columns_of(kind.name) if c.key not in numbers]
    if len(missing) == len(columns_of(kind.name)):
        raise ValueError(f"no column has a number: {', '.join(missing)} are not in {numbers}")


def _batched(kind: type[Task]) -> None:
    """A frame's results do not depend on its neighbours in the batch."""
    model = _model(kind)
    batch = _batch(model, training=False)
    task = _own(model, kind)
    together = _results(model, batch)[task.name]
    for slot, part in enumerate(batch.split(1)):
        for name, value in _results(model, part)[task.name].items():
            if not _near(value[0], together[name][slot]):
                raise ValueError(f"'{name}' of a frame differs in a batch of two")


def _near(a: Tensor, b: Tensor) -> bool:
    if a.is_floating_point():
        return torch.allclose(a, b, rtol=1e-3, atol=1e-4, equal_nan=True)
    return float((a == b).float().mean()) > 0.99  # a tie may go either way


TASK_CHECKS: dict[str, Callable[[type[Task]], str | None]] = {
    "declared": lambda kind: _declared(kind),
    "losses train it": _on_data(_losses),
    "no pixels, no terms": _on_data(_no_pixels),
    "metrics have its columns": _on_data(_measures),
    "frames alone and together": _on_data(_batched),
}
