"""Figures of predictions: what is on them, that they are legible, and that they stay the same."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from kitti_tree import write_tree
from test_cloud_page import shown
from typer.testing import CliRunner

from mtl_bench.bench.results import write_json
from mtl_bench.cli.app import app
from mtl_bench.core.config import to_dict
from mtl_bench.core.device import Engine
from mtl_bench.data.labels import labels_of
from mtl_bench.show import figures
from mtl_bench.show.figures import printed
from mtl_bench.train import checkpoint
from mtl_bench.train.loop import build

ROAD, SKY = (128, 64, 128), (70, 130, 180)


def texts(figure):
    """Every text that is drawn, with its size in points."""
    found = [(text.get_text(), text.get_fontsize()) for text in figure.texts]
    for axes in figure.axes:
        ticks = axes.get_xticklabels() if axes.axison else []
        found += [(text.get_text(), text.get_fontsize()) for text in ticks]
    return found


def without(one, *fields):
    return replace(one, predicted=replace(one.predicted, **dict.fromkeys(fields)))


def drawn(figure, path):
    figures.write(figure, path)
    return cv2.imread(str(path))[..., ::-1]


def test_one_frame_has_four_panels_a_scale_and_a_legend(tmp_path):
    one = shown(64, 128)
    figure = figures.prediction(one, dpi=100)
    picture = drawn(figure, tmp_path / "a.png")
    assert picture.shape[1] == 700
    words = [text for text, _ in texts(figure)]
    assert words[:4] == ["Input", "Panoptic segmentation", "Depth [m]", "Point cloud"]
    assert {"road", "sky", "2", "5", "10", "20", "50"} <= set(words)
    assert "car" not in words
    for color in (ROAD, SKY):  # of the legend's swatches
        assert (picture == color).all(2).any()
    panels = [axes.images[0].get_array() for axes in figure.axes[:4]]
    assert [panel.shape for panel in panels] == [(174, 347, 3)] * 4
    assert (panels[2][0] == (110, 110, 110)).all(), "sky has no depth"
    assert panels[2][-1].sum() > panels[2][80].sum(), "near is bright"
    assert (panels[3] == 255).all(2).mean() > 0.1


def test_text_is_legible_on_a_printed_page_and_nothing_overlaps():
    rows = [shown(94, 310), shown(94, 310)]
    for figure in (
        figures.prediction(shown(64, 128), 60),
        figures.qualitative(rows, ["one\nrun", "another"], 60),
    ):
        assert figure.get_figwidth() == 7.0
        assert min(size for text, size in texts(figure) if text) >= 5.5
        figure.draw_without_rendering()
        boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
        boxes += [axes.get_window_extent() for axes in figure.axes]
        for index, box in enumerate(boxes):
            assert min(box.x0, box.y0) >= -1
            assert box.x1 <= figure.bbox.x1 + 1
            for other in boxes[:index]:
                apart = box.x1 <= other.x0 + 1 or other.x1 <= box.x0 + 1
                assert apart or box.y1 <= other.y0 + 1 or other.y1 <= box.y0 + 1


def test_rows_of_one_frame_show_their_input_once():
    rows = [shown(64, 128), shown(64, 128), replace(shown(64, 128), name="other")]
    figure = figures.qualitative(rows, ["a", "b", "a"], dpi=60)
    inputs = [figure.axes[index].images[0].get_array() for index in (0, 4, 8)]
    assert [(image == 255).all() for image in inputs] == [False, True, False]


@pytest.mark.parametrize(
    ("absent", "panels"),
    [
        (("depth_HW", "unit", "camera_height"), ["Input", "Panoptic segmentation"]),
        (("instance_ids_HW", "class_HW"), ["Input", "Depth [m]", "Point cloud"]),
    ],
)
def test_what_a_cell_lacks_has_no_panel(absent, panels, tmp_path):
    one = without(shown(64, 128), *absent)
    for figure in (figures.prediction(one, 60), figures.qualitative([one], [""], 60)):
        assert [text.get_text() for text in figure.texts][: len(panels)] == panels
        drawn(figure, tmp_path / "a.png")


def test_depth_without_a_scale_has_no_numbers():
    one = shown(64, 128)
    one = replace(one, predicted=replace(one.predicted, unit="network units", camera_height=None))
    words = [text for text, _ in texts(figures.prediction(one, 60))]
    assert {"near", "far"} <= set(words)
    assert "10" not in words


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a.png", "b.png", "a.pdf", "b.pdf"):
        figures.write(figures.prediction(shown(64, 128), 60), tmp_path / name)
    for kind in ("png", "pdf"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert b"/Type3" not in (tmp_path / "a.pdf").read_bytes(), "publishers refuse Type 3 fonts"


def test_panels_are_cut_to_the_inputs_shape():
    cloud = np.zeros((480, 960, 3), np.uint8)
    assert printed._cut(cloud, (310, 94)).shape == (291, 960, 3)
    assert printed._cut(cloud, (100, 100)).shape == (480, 480, 3)


# --- frames and runs ------------------------------------------------------------------------------


def test_frames_by_name_and_by_seed():
    names = [f"f{number}" for number in range(9)]
    assert figures.choose(names, ["f7", "f2"], 0, 4) == ["f7", "f2"]
    drawn = figures.choose(names, [], 3, 4)
    assert drawn == figures.choose(names, [], 3, 4)
    assert len(set(drawn)) == 4
    assert drawn != figures.choose(names, [], 4, 4)
    assert len(figures.choose(names, [], 0, 50)) == 9
    with pytest.raises(ValueError, match=r"no frame 'f77' in the split.*f7"):
        figures.choose(names, ["f77"], 0, 1)


def test_runs_are_told_apart_by_what_differs(smoke_cell):
    other = replace(smoke_cell, method="fixed", seed=3)
    assert figures.told_apart([smoke_cell]) == [""]
    assert figures.told_apart([smoke_cell, other]) == ["fixed_uncertainty\nseed 0", "fixed\nseed 3"]
    data = replace(smoke_cell.recipe.data, train_scenes=99)
    same = replace(smoke_cell, recipe=replace(smoke_cell.recipe, data=data))
    assert len(set(figures.told_apart([smoke_cell, same]))) == 2


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run of the smoke recipe that has learned nothing."""
    from mtl_bench.core.config import Cell, load_recipe

    cell = Cell(load_recipe("smoke"), backbone="tiny", method="fixed_uncertainty")
    folder = tmp_path_factory.mktemp("runs") / cell.slug
    folder.mkdir()
    model = build(cell, labels_of("synthetic"), Engine(torch.device("cpu"), "fp32"))[0]
    torch.save({"format": checkpoint.FORMAT, "model": model.state_dict()}, folder / "last.pt")
    write_json(folder / "cell.json", to_dict(cell))
    return folder


def call(*words):
    return CliRunner().invoke(app, [str(word) for word in ("figure", *words)])


def test_figures_from_the_command_line(run_dir, smoke_root, tmp_path):
    frames = list(figures.frames_in(smoke_root, "val"))
    options = ("--checkpoint", run_dir, "--data", smoke_root)
    out = ("--dpi", 60, "--out", tmp_path / "new" / "a.png", "--out", tmp_path / "a.pdf")
    done = call("prediction", *options, "--frame", frames[1], *out)
    assert done.exit_code == 0, done.output
    assert frames[1] in done.output
    assert (tmp_path / "new" / "a.png").is_file()
    twice = ("--checkpoint", run_dir)
    done = call("qualitative", *options, *twice, "--rows", 2, "--out", tmp_path / "q.png")
    assert done.exit_code == 0, done.output
    assert cv2.imread(str(tmp_path / "q.png")).shape[1] == 2100
    done = call("cloud", *options, "--seed", 2, "--out", tmp_path / "c.html")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "c.html").read_text()
    assert any(f"<h1>{name}</h1>" in page for name in frames)
    assert run_dir.name in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("prediction", "--out", "a.jpg"), "must end in .png or .pdf"),
        (("prediction", "--out", "a.png", "--dpi", "9"), "--dpi 9 is not between"),
        (("prediction", "--out", "a.png", "--frame", "none"), "no frame 'none' in the split"),
        (("qualitative", "--out", "a.png", "--split", "trial"), "no \\*_leftImg8bit.png in it"),
        (("cloud", "--out", "a.png"), "must end in .html"),
        (("cloud", "--out", "a.html", "--checkpoint", "nowhere"), "no run or checkpoint 'nowhere'"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    words, message, run_dir, smoke_root, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    given = () if "--checkpoint" in words else ("--checkpoint", run_dir)
    done = call(*words, *given, "--data", smoke_root)
    assert done.exit_code == 2
    assert re.search(message, done.output)
    assert done.output.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_kitti_frames_are_found_by_their_names(tmp_path):
    found = figures.frames_in(write_tree(tmp_path), "val")
    assert len(found) == 3
    assert all(path.is_file() and name.endswith(path.stem) for name, path in found.items())
    (tmp_path / "empty" / "2011_09_26").mkdir(parents=True)
    with pytest.raises(ValueError, match="no frame of split 'val' is there"):
        figures.frames_in(tmp_path / "empty", "val")
