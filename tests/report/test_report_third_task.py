"""A task that brings a column stands in every table, plot and delta, with no edit in the report."""

import csv
import io
import re
from types import SimpleNamespace

import fake_latency
import numpy as np
import pytest
from fake_rows import GRID, make_row, write_runs

from mtl_bench.bench.jobs import CELLS
from mtl_bench.core import config, plugins, quality
from mtl_bench.core.columns import Column
from mtl_bench.report import delta, footnotes, grid, latency, readme

NORMALS = """
from dataclasses import dataclass

import numpy as np

from mtl_bench.core.columns import Column
from mtl_bench.core.task import Task
from mtl_bench.core.view import View


@dataclass(frozen=True)
class Angles(View):
    normals_HW3: np.ndarray

    def picture(self, image_HW3):
        return np.uint8(self.normals_HW3 * 127 + 128)


class Normals(Task):
    after = ("panoptic",)
    columns = (
        Column(
            *("mean_angle", "slopes.mean_angle", "mean angle", -1, 1, "deg"),
            in_delta=True,
            headline=True,
            words="angular error",
        ),
    )
    drawn = {"slopes": "slopes"}
    words = {"trivial": "mean normal"}

    @classmethod
    def drawn_view(cls, name, map_HW, labels):
        return Angles(map_HW)
"""
ANGLE = Column(
    *("mean_angle", "slopes.mean_angle", "mean angle", -1, 1, "deg"),
    task="slopes",
    in_delta=True,
    headline=True,
    words="angular error",
)
OWN = {"semantic.miou": 60.0, "depth_median.abs_rel": 0.2, "depth_median.delta1": 0.8}
OWN |= {"slopes.class.road.mean_angle": 12.0, "slopes.class.hut.mean_angle": 30.0}


@pytest.fixture(autouse=True)
def third_task(monkeypatch, tmp_path_factory):
    """The task in a user's folder, with what reports need."""
    file = tmp_path_factory.mktemp("plugins") / "tasks" / "slopes.py"
    file.parent.mkdir()
    file.write_text(NORMALS)
    monkeypatch.setenv(plugins.VARIABLE, str(file.parent.parent))


def rows():
    """Two backbones, two seeds; single-task ones with an angle of 40 are the baseline."""
    angles = {("a", 0): 20.0, ("a", 1): 21.0, ("b", 0): 30.0, ("b", 1): 32.0}
    made = [
        make_row(name, seed, metric=OWN | {"slopes.mean_angle": angle})
        for (name, seed), angle in angles.items()
    ]
    base = make_row("a", single_task=True, metric=OWN | {"slopes.mean_angle": 40.0})
    return delta.with_delta(made, lambda row: base)


@pytest.fixture
def built(tmp_path):
    made = rows()
    runs = write_runs(tmp_path / "runs", made)
    for row in made:
        path = runs / row["slug"] / "samples.npz"
        normals = np.zeros((2, 16, 32, 3), np.float16)
        np.savez(path, **np.load(path), slopes=normals, true_slopes=normals)
    chosen = SimpleNamespace(**{**vars(GRID), "report": {"readme": ["mean_angle_fps"]}})
    grid.build(chosen, made, tmp_path / "out", runs)
    return tmp_path / "out"


def test_every_table_has_its_column(built):
    lines = list(csv.DictReader(io.StringIO((built / "table.csv").read_text())))
    assert [line["mean_angle"] for line in lines[:2]] == ["20.5", "31"]
    assert lines[0]["mean_angle_std"] == "0.707107"
    for name in ("table.md", "readme.md"):
        text = (built / name).read_text()
        assert "mean angle\u00a0\u2193<br>deg" in text
        assert "**20.5 \u00b1 0.7**" in text  # it leads
    tex = (built / "table.tex").read_text()
    assert r"mean angle $\downarrow$" in tex
    assert r"\textbf{20.5}{\scriptsize\,$\pm$ 0.7}" in tex
    page = (built / "index.html").read_text()
    assert '<th scope="col">mean angle</th>' in page  # of every cell on its own
    assert "<small>deg</small>" in page


def test_every_plot_is_drawn(built):
    page = (built / "index.html").read_text()
    for stem, heading in {
        "mean_angle_fps": "Angular error against frames per second",
        "pq_mean_angle": "Panoptic quality against angular error",
        "rmse_mean_angle": "Depth error against angular error",
        "mean_angle_classes": "Angular error per class",
    }.items():
        assert (built / f"{stem}.png").is_file()
        assert f"<h3>{heading}</h3>" in page
    assert "mean angle, deg" in (built / "mean_angle_fps.svg").read_text()
    classes = (built / "mean_angle_classes.svg").read_text()
    assert classes.index("road") < classes.index("hut")
    assert "and depth (median" in page
    assert "without value) and slopes." in page


def test_a_trivial_predictor_says_what_it_is():
    assert footnotes._trivial({"panoptic", "depth", "slopes"}).startswith(
        "Trivial predictor: the training split's mean depth image and mean normal and most "
        "frequent class per pixel."
    )


def test_it_counts_in_the_delta():
    (row, *_) = rows()
    assert row["metric"]["delta.flat"] == pytest.approx(-50 / 6)  # of six metrics one is better
    assert row["metric"]["delta.task"] == pytest.approx(50 / 3)
    (note,) = [n for n in grid.footnotes(grid.tabulate(rows())) if n.startswith("Delta")]
    assert "median-scaled AbsRel, RMSE and delta1, and mean angle, relative" in note
    assert "over the six metrics" in note
    assert "over the three tasks" in note


def test_rows_without_it_are_as_before(monkeypatch):
    two = [make_row("a", metric=OWN), make_row("b", metric=OWN)]
    base = make_row("c", metric=OWN | {"panoptic.pq": 15.0})
    found = [row["metric"]["delta.flat"] for row in delta.with_delta(two, lambda row: base)]
    assert found == [pytest.approx(-20)] * 2
    assert ANGLE not in grid.tabulate(two).columns()


def test_one_task_alone_has_no_delta():
    alone = [make_row(name, metric={"panoptic.pq": None} | OWN) for name in "ab"]
    for row in alone:
        row["metric"] = {"slopes.mean_angle": 20.0}
    assert delta.with_delta(alone, lambda row: alone[0]) == alone


def test_headline_readme_and_latency(tmp_path):
    metric = {"slopes.mean_angle": 20.0, "panoptic.pq": 30.0, "latency.fps": 5.0}
    assert CELLS.headline(metric) == "PQ 30.0  mean angle 20.0  FPS 5.0"
    assert {"pq_fps", "rmse_fps", "mean_angle_fps"} <= set(grid.Layout().pictures)
    assert "mean_angle_fps" in grid.Layout.of({"readme": ["mean_angle_fps"]}).pictures
    trained = [{**row, "tasks": row["cell"]["tasks"]} for row in rows()]
    timed = [fake_latency.make_row("plain", backbone=name) for name in "ab"]
    html = latency.build(
        SimpleNamespace(name="x", question="", recipe="y"), timed, tmp_path, trained
    )
    assert (tmp_path / "mean_angle_fps.png").is_file()
    assert "<td>20.5</td>" in html.read_text()
    assert set(readme.figures()) >= {"mean_angle_fps", "pq_mean_angle"}


NAMES = re.compile(r"panoptic|depth|semantic|cityscapes|kitti|synthetic|rmse|\bpq\b", re.IGNORECASE)


@pytest.mark.parametrize(
    "path",
    [p for p in (plugins.PACKAGE / "report").iterdir() if p.is_file()],
    ids=lambda path: path.name,
)
def test_no_module_names_a_task(path):
    if path.suffix != ".toml":
        assert NAMES.findall(path.read_text(encoding="utf-8")) == []


def test_columns_are_of_tasks_that_exist():
    assert {plugins.stem_and_field(c.task)[0] for c in quality.quality()} == set(
        plugins.files("tasks")
    )
    assert {column.task for column in quality.agreement()} <= set(plugins.files("tasks"))


def test_columns_of_the_default_tasks_come_first():
    """A task whose name comes before theirs changes no report without it."""
    first = list(dict.fromkeys(column.task for column in quality.quality()))
    assert first[: len(config.Recipe.tasks)] == list(config.Recipe.tasks)
    assert quality.words("trivial", ["depth"]) == ["mean depth image"]
