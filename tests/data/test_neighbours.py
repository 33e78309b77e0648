"""Which frames train: neighbours further away, and none that stands still; a plain video."""

import json
from dataclasses import replace

import cityscapes_tree
import cv2
import kitti_tree
import numpy as np
import pytest
import torch
from kitti_tree import TRAIN
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core.config import Cell, Data, load_recipe
from mtl_bench.data import filmed, motion, pictures, scenes, video
from mtl_bench.data.cameras import Mounted, from_calibration, matrix
from mtl_bench.data.cityscapes_files import SEQUENCE, file_of, read_image

SIZE = {"height": cityscapes_tree.HEIGHT, "width": cityscapes_tree.WIDTH}
WORLD = cv2.GaussianBlur(
    np.random.default_rng(0).integers(0, 256, (96, 400, 3)).astype(np.uint8), (0, 0), 3
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A user's cache of the test's own."""
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / "cache" / name)
    return tmp_path / "cache/mtl-bench"


def view(left: int, width: int = 192) -> np.ndarray:
    return np.ascontiguousarray(WORLD[:, left : left + width])


def first(samples):
    return samples.sample(0, torch.Generator().manual_seed(0))


# --- stride ---------------------------------------------------------------------------------------


def write_sequence(root, frames, left=lambda number: 3 * number):
    """One annotated frame, 19, and others of its sequence."""
    cityscapes_tree.write_tree(root, 1, size=WORLD[:, :192].shape[:2])
    for number in frames:
        name = f"aachen_000000_{number:06d}"
        path = file_of(root / SEQUENCE.folder / "train", SEQUENCE, name)
        cityscapes_tree.put_png(path, view(left(number))[..., ::-1])
    for path in root.glob("leftImg8bit/*/*/*.png"):
        cityscapes_tree.put_png(path, view(left(19))[..., ::-1])
    return root


def test_neighbours_are_a_stride_away(tmp_path):
    root = write_sequence(tmp_path / "cs", range(16, 23))
    data = Data(height=96, width=192, stride=3)
    frame = cityscapes_tree.open_tree(root, data=data).dataset.read("aachen_000000_000019")
    shown = [image.permute(1, 2, 0).numpy() for image in frame.images_N3HW]
    for image, number in zip(shown, (19, 16, 22), strict=True):
        assert (image == view(3 * number)).all()
    with pytest.raises(ValueError, match=r"_000015_.* missing, .* at recipe\.data\.stride = 4"):
        cityscapes_tree.open_tree(root, data=replace(data, stride=4))
    with pytest.raises(ValueError, match="must be >= 1, not 0"):
        cityscapes_tree.open_tree(root, data=replace(data, stride=0))


def test_kitti_neighbours_are_a_stride_away(tmp_path):
    root = kitti_tree.write_tree(tmp_path / "kitti")
    data = Data(dataset="kitti", height=kitti_tree.HEIGHT, width=kitti_tree.WIDTH, stride=2)
    samples = kitti_tree.open_tree(root, data=data)
    assert samples.names == kitti_tree.names(TRAIN, 4)
    images = samples.dataset.read(samples.names[0]).images_N3HW
    for image, number in zip(images, (4, 2, 6), strict=True):
        path = kitti_tree.file(root, TRAIN, "image_02", number)
        assert (image.permute(1, 2, 0).numpy() == read_image(path)).all()
    with pytest.raises(ValueError, match=r"lower recipe\.data\.stride = 3"):
        kitti_tree.open_tree(root, data=replace(data, stride=3))


def test_the_built_in_scenes_are_long_enough_or_say_so():
    with pytest.raises(ValueError, match=r"at a stride of 2; set 5 or more"):
        scenes.ensure(Data(frames=3, stride=2))


def test_new_settings_change_no_id():
    cell = Cell(load_recipe("medium"), backbone="tiny", method="fixed")
    for change in ({"stride": 2}, {"min_flow": 1.0}):
        data = replace(cell.recipe.data, **change)
        assert replace(cell, recipe=replace(cell.recipe, data=data)).id != cell.id
    optim = replace(cell.recipe.optim, method_lr=1e-3)  # the recipe's, then
    cell = replace(cell, recipe=replace(cell.recipe, optim=optim))
    assert cell.id == "6e84de03340d", "as before there were these keys"


# --- frames that stand still ----------------------------------------------------------------------


@pytest.mark.parametrize("pixels", [0, 2, 4])
def test_flow_is_in_pixels_of_the_image(pixels):
    assert motion.flow_px(view(50), view(50 + pixels)) == pytest.approx(pixels, abs=0.3)
    wide = [cv2.resize(view(left), (1536, 768)) for left in (50, 50 + pixels)]
    assert motion.flow_px(*wide) == pytest.approx(8 * pixels, abs=2)


def test_frames_that_stand_still_are_left_out_and_counted(tmp_path, cache):
    root = tmp_path / "kitti"
    kitti_tree.write_drive(root, TRAIN, range(2, 9))
    size = (96, 192)
    lefts = [0, 0, 0, 0, 4, 8, 12]  # 3 and 4 stand still, 5 begins to move
    for number, left in zip(range(2, 9), lefts, strict=True):
        kitti_tree.put_png(kitti_tree.file(root, TRAIN, "image_02", number), view(left)[..., ::-1])
    calibration = root / "2011_09_26/calib_cam_to_cam.txt"
    text = calibration.read_text().replace("S_rect_02: 48 16", "S_rect_02: 192 96")
    calibration.write_text(text)
    data = Data(dataset="kitti", height=size[0], width=size[1], min_flow=1.0)
    dataset = kitti_tree.open_tree(root, data=data, panoptic=False).dataset
    assert dataset.names == kitti_tree.names(TRAIN, 5, 6, 7)
    assert dataset.described["left_out"]["standing"] == 2
    (kept,) = (cache / "flow").glob("*.txt")
    lines = kept.read_text()
    assert len(lines.splitlines()) == 6, "every pair once"
    kept.write_text(lines[:-4])  # as a kill leaves it
    again = kitti_tree.open_tree(root, data=data, panoptic=False).dataset
    assert again.names == dataset.names
    assert kept.read_text() == lines
    with pytest.raises(ValueError, match=r"min_flow = 9 leaves none of 5 frames: the flow is 4"):
        kitti_tree.open_tree(root, data=replace(data, min_flow=9.0), panoptic=False)
    plain = kitti_tree.open_tree(root, data=replace(data, min_flow=0.0), panoptic=False)
    assert len(plain) == 5


def test_cityscapes_frames_that_stand_still_are_left_out(tmp_path):
    root = write_sequence(tmp_path / "cs", range(18, 21), left=lambda number: 0)
    cityscapes_tree.write_frame(root, "bochum_000001_000019", size=(96, 192))  # noise: it moves
    data = Data(height=96, width=192, min_flow=0.5)
    dataset = cityscapes_tree.open_tree(root, data=data).dataset
    assert dataset.names == ["bochum_000001_000019"]
    assert dataset.described == {"frames": 1, "left_out": {"standing": 1}}


# --- a plain video --------------------------------------------------------------------------------


def write_video(path, frames=6):
    with video.Writer(path, 10.0) as writer:
        for number in range(frames):
            writer.write(view(3 * number))
    return path


def test_a_video_becomes_a_tree(tmp_path, cache):
    path = write_video(tmp_path / "drive.mp4")
    camera = Mounted(matrix(150, 151, 96, 48), 1.5, 0.1, "told")
    told = []
    root = filmed.tree_of(path, camera, progress=lambda done, of: told.append((done, of)))
    assert told[-1] == (6, 6)
    assert root.parent == cache
    data = Data(height=96, width=192)
    samples = cityscapes_tree.open_tree(root, data=data, panoptic=False)
    assert len(samples) == 4, "those with both neighbours"
    sample = first(samples)
    assert sample.camera.K_B33.tolist() == [[150, 0, 96], [0, 151, 48], [0, 0, 1]]
    assert float(sample.camera.height_m_B) == 1.5
    shown = sample.image_B3HW.permute(1, 2, 0).numpy() * 255
    assert np.abs(shown - view(3)).mean() < 4, "a lossy video, a lossy file"
    told.clear()
    assert filmed.tree_of(path, camera, progress=lambda *_: told.append(1)) == root
    assert not told, "decoded once"
    other = filmed.tree_of(path, Mounted(matrix(99, 99, 96, 48), None, 0.0, "told"))
    assert other != root
    with pytest.raises(ValueError, match=r"2 frames, but training compares a frame"):
        filmed.tree_of(write_video(tmp_path / "short.mp4", 2), camera)
    assert {p.name for p in cache.iterdir() if p.suffix != ".lock"} == {root.name, other.name}


def train(*words):
    words = ["train", "--recipe", "smoke", "--backbone", "tiny", "--method", "fixed", *words]
    return CliRunner().invoke(app, [str(word) for word in words])


def test_depth_trains_on_a_video_and_nothing_is_measured(tmp_path):
    path, runs = write_video(tmp_path / "drive.mp4"), tmp_path / "runs"
    short = ["steps=2", "batch=2", "warmup_steps=1"]
    settings = [word for value in short for word in ("--set", f"recipe.optim.{value}")]
    camera = ["--fx", 150, "--fy", 150, "--cx", 96, "--cy", 48]
    result = train("--tasks", "depth", "--data", path, *camera, "--runs", runs, *settings)
    assert result.exit_code == 0, result.output
    (row,) = (json.loads(file.read_text()) for file in runs.glob("*/row.json"))
    assert row["protocol"]["split"] == "none"
    assert {key.partition(".")[0] for key in row["metric"]} == {"latency"}
    assert row["cell"]["recipe"]["data"]["dataset"] == "cityscapes"
    for words, message in (
        ([], "takes its camera's intrinsics: give --fx --fy --cx --cy, --calib or --camera"),
        (["--fx", 150], "give all of --fx --fy --cx --cy"),
        (["--fx", 150, "--fy", 150, "--cx", 960, "--cy", 48], "they are another camera's"),
    ):
        result = train("--tasks", "depth", "--data", path, *words, "--runs", runs)
        assert result.exit_code == 2
        assert message in result.stderr
    result = train("--tasks", "depth", *camera, "--runs", runs)
    assert "are for --data VIDEO: a data set has its own" in result.stderr


# --- OpenCV's calibration -------------------------------------------------------------------------

OPENCV = """%YAML:1.0
---
image_width: 192
image_height: 96
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 150., 0., 95.5, 0., 151., 47.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0., 0., 0., 0. ]
"""


def test_a_calibration_of_opencv(tmp_path):
    path = tmp_path / "calib.yaml"
    straight = OPENCV.replace("0.1,", "0.,")
    of_ros = OPENCV.replace(" !!opencv-matrix", "").replace("%YAML:1.0\n---\n", "")
    for text, bent in ((OPENCV, True), (straight, False), (of_ros, True)):
        path.write_text(text)
        camera = from_calibration(path, tmp_path / "a.png", (96, 192))
        assert camera.K_33.tolist() == [[150, 0, 95.5], [0, 151, 47.5], [0, 0, 1]]
        assert (camera.height_m, camera.pitch_rad) == (None, 0)
        assert ("distortion is not undone: undistort" in camera.source) == bent
    for text, message in (
        (OPENCV, "for images of 96x192 pixels, not 96x191; take the image's own"),
        ("", "not a calibration file as OpenCV writes it"),
        ("%YAML:1.0\n---\ncamera_matrix: 3\n", "not a calibration file as OpenCV writes it"),
        ("%YAML:1.0\n---\nx: 3\n", "no camera_matrix with data of 3x3 numbers"),
        (OPENCV.replace("150.", "-1."), "impossible camera_matrix"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message) as error:
            from_calibration(path, tmp_path / "a.png", (96, 191))
        assert str(error.value).startswith(str(path))
        assert "\n" not in str(error.value)
    assert pictures.is_image(path) is False
