"""Tasks of one field, against scikit-learn; and what a cell says of their fields."""

import numpy as np
import pytest
import torch
from sklearn.metrics import accuracy_score, f1_score, r2_score, root_mean_squared_error

from mtl_bench.core import plugins
from mtl_bench.core.config import Cell, check_cells, load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.quality import columns_of
from mtl_bench.core.task import tasks_of
from mtl_bench.data.samples import open_samples


def task_of(name: str, recipe: str):
    found = load_recipe(recipe)
    return tasks_of(found, [name], dataset_of(found).labels)[0]


def measured(task, true_N, results: dict[str, torch.Tensor]) -> dict[str, float]:
    """By two metrics that are added up."""
    first, second = task.metrics()[0], task.metrics()[0]
    for index, true in enumerate(true_N):
        result = {name: value[index].numpy() for name, value in results.items()}
        (first if index % 3 else second).update({task.field: true}, result)
    first.add(second.state())
    return first.compute()


def test_regress():
    task = task_of("regress:y3", "scales")
    draw = torch.Generator().manual_seed(0)
    true, found = (torch.randn(40, 1, generator=draw) for _ in range(2))
    assert measured(task, true.numpy(), task.finish({"number": found}, None, {})) == pytest.approx(
        {
            "regress.y3.unexplained": 1 - r2_score(true, found),
            "regress.y3.rmse": root_mean_squared_error(true, found),
        }
    )


def test_classify():
    task = task_of("classify:left", "digits")
    draw = torch.Generator().manual_seed(0)
    true = torch.randint(10, (60, 1), generator=draw)
    logits = torch.randn(60, 10, generator=draw) + 2 * torch.eye(10)[true[:, 0]]
    results = task.finish({"logits": logits}, None, {})
    expected = accuracy_score(true[:, 0], logits.argmax(1))
    assert measured(task, true.numpy(), results) == {"classify.left.accuracy": expected}


def test_attributes():
    task = task_of("attributes:Bald", "celeba-cnn9")
    draw = torch.Generator().manual_seed(0)
    true = (torch.rand(80, 1, generator=draw) < 0.3).float()
    logit = torch.randn(80, 1, generator=draw) + true
    found = measured(task, true.numpy(), task.finish({"logit": logit}, None, {}))
    assert found == pytest.approx(
        {
            "attributes.Bald.f1": f1_score(true, logit > 0),
            "attributes.Bald.accuracy": accuracy_score(true, logit > 0),
        }
    )
    nobody = measured(task, np.zeros((5, 1)), {"has": torch.zeros(5, dtype=torch.bool)})
    assert nobody == {"attributes.Bald.accuracy": 1}


def test_reconstruct():
    task = task_of("reconstruct:right_picture", "digits")
    draw = torch.Generator().manual_seed(0)
    true = torch.rand(20, 16, 16, generator=draw)
    found = torch.rand(20, 1, 16, 16, generator=draw)
    results = task.finish({"grey": found}, None, {}, (16, 16))
    flat = true.flatten(1), found.flatten(1)
    assert measured(task, true.numpy(), results) == pytest.approx(
        {
            "reconstruct.right_picture.unexplained": 1
            - r2_score(*flat, multioutput="variance_weighted"),
            "reconstruct.right_picture.rmse": (flat[0] - flat[1]).square().mean().sqrt().item(),
        }
    )


@pytest.mark.parametrize("recipe", ["scales", "conflict", "digits"])
def test_the_trivial_predictor_explains_nothing(recipe):
    recipe = load_recipe(recipe)
    kind = dataset_of(recipe)
    tasks = tasks_of(recipe, recipe.tasks, kind.labels)
    samples = open_samples(recipe, tasks, "val", kind.render(recipe.data), training=False)
    frames = [samples.sample(index, None).fields for index in range(200)]
    for task in tasks:
        trivial = task.trivial((16, 16))
        for fields in frames:
            trivial.add({task.field: fields[task.field].numpy()})
        truth = [fields[task.field].numpy() for fields in frames]
        found = measured(task, truth, trivial.result(200, (16, 16)))
        name = columns_of(plugins.stem_and_field(task.name)[0])[0].key.rpartition(".")[2]
        value = next(v for key, v in found.items() if key.endswith(name))
        assert value == pytest.approx(1, abs=1e-5) if name == "unexplained" else value < 0.2


def test_columns_are_of_every_field_that_a_data_set_has():
    found = {column.key: column for column in columns_of("attributes")}
    assert len(found) == 40
    column = found["attributes.No_Beard.f1"]
    assert (column.title, column.task) == ("No Beard F1", "attributes:No_Beard")
    assert {c.key for c in columns_of("regress")} >= {"regress.y9.rmse", "regress.c3.unexplained"}


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        (("regress",), "task 'regress' is of one field of the data set: regress:FIELD"),
        (("panoptic:y0",), "task 'panoptic' is of no one field: 'panoptic', not 'panoptic:y0'"),
        (("regres:y0",), "no task called 'regres'.*did you mean 'regress'"),
    ],
)
def test_tasks_with_and_without_a_field(tasks, message):
    cell = Cell(load_recipe("scales"), "mlp", "fixed", tasks)
    with pytest.raises(ValueError, match=message):
        check_cells([cell])


def test_a_field_that_the_data_set_has_not():
    recipe = load_recipe("scales")
    tasks = tasks_of(recipe, ["regress:y10"], dataset_of(recipe).labels)
    with pytest.raises(ValueError, match="scales has no y10: it has y0, y1"):
        open_samples(recipe, tasks, "train", dataset_of(recipe).render(recipe.data), True)


def test_a_task_that_reads_a_camera():
    recipe = load_recipe("scales")
    tasks = tasks_of(recipe, ["depth"], dataset_of(recipe).labels)
    with pytest.raises(ValueError, match="task 'depth' reads the camera, and scales has none"):
        open_samples(recipe, tasks, "train", dataset_of(recipe).render(recipe.data), True)
