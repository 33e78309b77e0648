"""What every data set has to hold, tried on the example that it writes, or on what it renders."""

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Generator, Tensor

from mtl_bench.core.config import load_recipe
from mtl_bench.core.dataset import Dataset, Kind
from mtl_bench.core.labels import IGNORE, class_of_instance_id
from mtl_bench.core.recipe import Augment, Data
from mtl_bench.data.samples import Samples

RECIPE = "smoke"
DIMENSIONS = {Kind.NORMALS: 3, Kind.VECTOR: 1}  # of the other kinds: 2


def _with_files(check: Callable[[type[Dataset], Path, Data], None]) -> Callable[..., str | None]:
    """On a few frames, where there are some to be had."""

    def checked(kind: type[Dataset]) -> str | None:
        name = kind.name.replace("_", "-")
        data = dataclasses.replace(load_recipe(RECIPE).data, dataset=name)
        if kind.built_in:
            check(kind, kind.render(data, quiet=True), data)
            return None
        with tempfile.TemporaryDirectory() as folder:
            if not kind.example(Path(folder), data):
                return "not tried: it writes no example of its layout"
            check(kind, Path(folder), data)
        return None

    return checked


def _declared(kind: type[Dataset]) -> None:
    if not kind.fields or not all(isinstance(value, Kind) for value in kind.fields.values()):
        raise ValueError(f"fields {dict(kind.fields)}: name -> a Kind, one or more")
    stuff_first = [label.is_thing for label in kind.labels.labels]
    if stuff_first != sorted(stuff_first):
        raise ValueError("labels: stuff classes come before things")
    if not kind.layout or not (kind.marks or kind.built_in):
        raise ValueError("layout and marks say by what a folder is told; one is empty")


def _recognised(kind: type[Dataset], root: Path, data: Data) -> None:
    with tempfile.TemporaryDirectory() as empty:
        if not kind.recognises(root) or kind.recognises(Path(empty)):
            raise ValueError("recognises() is wrong about its own files or about an empty folder")


def _evaluation(kind: type[Dataset], root: Path, data: Data) -> None:
    """Frames have the declared fields, each of its kind, and every id is known."""
    dataset = kind(root, load_recipe(RECIPE).evaluate.split, data, needs=kind.fields)
    if not len(dataset) or len(set(dataset.names)) < len(dataset):
        raise ValueError(f"names {dataset.names[:3]}...: none, or one twice")
    sample = Samples(dataset).sample(0, None)
    if sample.image_B3HW.shape != (3, data.height, data.width):
        raise ValueError(f"an image of {tuple(sample.image_B3HW.shape)} is not of the input's size")
    for name, field in kind.fields.items():
        if name not in sample.fields:
            raise ValueError(f"a frame has no '{name}', which is declared")
        value = sample.fields[name]
        if value.dim() != DIMENSIONS.get(field, 2):
            raise ValueError(f"'{name}' {tuple(value.shape)} is no {field.value}")
        if field is Kind.IDS and (class_of_instance_id(kind.labels)[value] == IGNORE).all():
            raise ValueError(f"no id of '{name}' belongs to a class of {kind.labels.name}")


def _training(kind: type[Dataset], root: Path, data: Data) -> None:
    """A training sample is a function of its seed, at the input's size."""
    dataset = kind(root, "train", data, needs=kind.fields, training=True)
    augment = Augment(scales=(0.75, 1.5), crop=(data.height, data.width))
    samples = Samples(dataset, augment, keep=kind.fields)
    one, two, other = (
        samples.sample(0, Generator().manual_seed(seed)).map(_no_nan).tensors()
        for seed in (1, 1, 2)
    )
    if any(not torch.equal(one[name], two[name]) for name in one):
        raise ValueError("two samples of one seed differ")
    if all(torch.equal(one[name], other[name]) for name in one):
        raise ValueError("samples of two seeds are the same")
    for name, field in kind.fields.items():
        size = tuple(one[f"fields.{name}"].shape[-2:])
        if field is not Kind.VECTOR and size != (data.height, data.width):
            raise ValueError(f"'{name}' of a training sample is {size}, not of the input's size")


def _no_nan(value: Tensor) -> Tensor:
    """Of a camera that a data set does not have, too: NaN is not equal to itself."""
    return value.nan_to_num() if value.is_floating_point() else value


DATASET_CHECKS: dict[str, Callable[[type[Dataset]], str | None]] = {
    "declared": lambda kind: _declared(kind),
    "recognises its files": _with_files(_recognised),
    "frames as declared": _with_files(_evaluation),
    "training samples": _with_files(_training),
}
