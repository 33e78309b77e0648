"""`mtl-bench predict`: images and videos in, pictures and numbers out, one line for bad input."""

import importlib.util
import json
import math
import resource
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from conftest import SHARED
from torch import nn
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core.config import Cell, load_recipe, to_dict
from mtl_bench.core.files import write_json
from mtl_bench.core.geometry import scale_intrinsics
from mtl_bench.core.labels import IGNORE
from mtl_bench.core.task import tasks_of, tasks_of_cell
from mtl_bench.core.view import METRES
from mtl_bench.data import video
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.model import Outputs, build_model
from mtl_bench.show.predict import Predictor
from mtl_bench.show.predict import job as predictions
from mtl_bench.show.predict.cameras import Given, camera_of
from mtl_bench.tasks.depth.picture import HEIGHTS, UNSCALED, DepthView

ROAD, SKY, EGO = (CITYSCAPES20.index(name) for name in ("road", "sky", "ego vehicle"))
RUNNER = CliRunner()


def small_cell(**changes) -> Cell:
    return Cell(load_recipe("small"), backbone="tiny", method="fixed", **changes)


# --- a network that knows the scene ---------------------------------------------------------------


class Street(nn.Module):
    """Predicts a flat road below the horizon, sky above, in an arbitrary unit of depth."""

    def __init__(self, K_33, height_m, unit=0.37, wall=False):
        super().__init__()
        self.K_33, self.height_m, self.unit, self.wall = K_33, height_m, unit, wall
        self.seen = torch.empty(0)

    def forward(self, image_B3HW):
        self.seen = image_B3HW
        height, width = image_B3HW.shape[2:]
        rows = torch.arange(height)[:, None].expand(height, width)
        ray_y = (rows - self.K_33[1, 2]) / self.K_33[1, 1]
        inverse = (ray_y / self.height_m).clamp(min=1e-3) / self.unit
        classes = torch.where(ray_y > 0, ROAD, SKY)
        classes[-2:] = EGO
        if self.wall:
            classes, inverse = torch.full_like(classes, 3), torch.full_like(inverse, 0.1)
        semantic = nn.functional.one_hot(classes, len(CITYSCAPES20)).permute(2, 0, 1)[None].float()
        flat = torch.zeros(1, 1, height, width)
        panoptic = {"semantic": semantic, "center": flat, "offset": flat.expand(-1, 2, -1, -1)}
        return Outputs({"panoptic": panoptic, "depth": {"inverse": inverse[None, None]}})


def street_predictor(size, own, K_33, **options):
    net_K = scale_intrinsics(torch.tensor(K_33)[None], size[1] / own[1], size[0] / own[0])[0]
    street = Street(net_K.numpy(), 1.4, **options)
    model = nn.Module()
    model.net, model.tasks = street, tasks_of_cell(small_cell())
    return Predictor(model, small_cell(), torch.device("cpu"), size), street


OWN, SIZE = (150, 400), (64, 160)
K = np.array([[300.0, 0, 190], [0, 280, 70], [0, 0, 1]])
PHOTO = np.random.default_rng(0).integers(0, 255, (*OWN, 3)).astype(np.uint8)


def test_depth_is_in_metres_at_the_images_own_size():
    predictor, street = street_predictor(SIZE, OWN, K)
    predicted = predictor(PHOTO, K, camera_height_m=1.4)
    assert tuple(street.seen.shape) == (1, 3, *SIZE)
    assert 0 <= street.seen.min() < street.seen.max() <= 1
    surface = predicted.surface
    assert (surface.unit, surface.source) == (METRES, "road")
    assert surface.camera_height == 1.4
    rows = np.arange(90, 140)
    true_m = 1.4 * 280 / (rows - 70)
    assert np.allclose(surface.depth_HW[90:140], true_m[:, None], rtol=0.02)
    assert surface.depth_HW.shape == OWN
    assert predicted.image_HW3 is PHOTO


def test_sky_and_ego_vehicle_have_no_depth_but_a_class():
    predicted = street_predictor(SIZE, OWN, K)[0](PHOTO, K, camera_height_m=1.4)
    assert (predicted.surface.depth_HW[:66] == 0).all()
    assert (predicted.surface.depth_HW[-3:] == 0).all()
    segments = predicted.segments
    assert (segments.ids_HW[[20, 100, -1], 200] == (23, 7, 1)).all()
    assert (segments.class_HW[[20, 100, -1], 200] == (SKY, ROAD, EGO)).all()
    assert segments.ids_HW.dtype == np.int32


def test_without_a_height_depth_is_in_camera_heights():
    metric = street_predictor(SIZE, OWN, K)[0](PHOTO, K, camera_height_m=1.4).surface
    relative = street_predictor(SIZE, OWN, K, unit=9.0)[0](PHOTO, K).surface
    assert relative.unit == HEIGHTS
    assert relative.camera_height == 1
    assert np.allclose(relative.depth_HW * 1.4, metric.depth_HW, rtol=1e-3)


def test_without_ground_depth_stays_in_the_networks_unit():
    predicted = street_predictor(SIZE, OWN, K, wall=True)[0](PHOTO, K, camera_height_m=1.4)
    surface = predicted.surface
    assert (surface.unit, surface.source) == (UNSCALED, "failed")
    assert surface.camera_height is None
    assert np.allclose(surface.depth_HW, 10)


def test_depth_without_a_scale_is_written_with_enough_digits():
    near = np.linspace(0.96, 1.04, 10_000, dtype=np.float32).reshape(100, 100)
    for farthest in (1.04, 70.0, 65535.0):
        view = DepthView(np.where(near < 1.04, near, np.float32(farthest)), UNSCALED)
        written = view.files("depth", PHOTO)["depth"]
        assert np.abs(written / view.steps - view.depth_HW).max() <= 0.5 / view.steps
        assert written.max() > 2**15 - 1
    assert len(np.unique(DepthView(near, UNSCALED).files("depth", PHOTO)["depth"])) > 2000
    assert DepthView(near, HEIGHTS).steps == DepthView(near, METRES).steps == 256


def test_what_is_void_has_no_class():
    predictor = street_predictor(SIZE, OWN, K)[0]
    recipe = predictor.cell.recipe
    recipe = replace(recipe, evaluate=replace(recipe.evaluate, stuff_area=10**6))
    predictor.model.tasks = tasks_of(recipe, predictor.cell.tasks, CITYSCAPES20)
    predicted = predictor(PHOTO, K)
    assert set(np.unique(predicted.segments.class_HW)) == {EGO, IGNORE}
    assert (predicted.surface.depth_HW[:66] == 0).all(), "a small sky is still no surface"


def test_pixels_of_the_post_processing_are_the_recipes():
    (task,) = tasks_of_cell(small_cell(tasks=("panoptic",)))
    ev = task.recipe.evaluate
    assert task.at_size((64, 128)).recipe == task.recipe
    larger = task.at_size((512, 1024)).recipe.evaluate
    assert larger.stuff_area == 64 * ev.stuff_area
    assert larger.nms_kernel % 2 == 1
    assert abs(larger.nms_kernel - 8 * ev.nms_kernel) <= 1
    assert task.at_size((16, 16)).recipe.evaluate.nms_kernel == 3


def test_the_size_must_suit_the_network():
    with pytest.raises(ValueError, match=r"65x128 is not divisible .* stride 16: try 64x128"):
        Predictor(nn.Module(), small_cell(), torch.device("cpu"), (65, 128))
    predictor = Predictor(nn.Module(), small_cell(), torch.device("cpu"))
    assert predictor.size == (64, 128)
    assert predictor.unsqueezed(540, 960) is None
    assert predictor.unsqueezed(375, 1242) == (64, 208)


# --- cameras --------------------------------------------------------------------------------------

CALIBRATION = """R_rect_00: 1 0 0 0 1 0 0 0 1
S_rect_02: 4.0e+02 1.5e+02
P_rect_02: 700 0 190 44.8 0 710 70 0.2 0 0 1 0.002
S_rect_03: 4.0e+02 1.5e+02
P_rect_03: 720 0 180 -339 0 730 75 2.2 0 0 1 0.002
"""
CAMERA_JSON = {
    "extrinsic": {"baseline": 0.22, "z": 1.22, "pitch": 0.04},
    "intrinsic": {"fx": 500.0, "fy": 510.0, "u0": 200.0, "v0": 80.0},
}


@pytest.fixture
def tree(tmp_path):
    """A Cityscapes and a KITTI image with their calibration, and one that has none."""
    for path in ("city/leftImg8bit/val/aachen", "city/camera/val/aachen"):
        (tmp_path / path).mkdir(parents=True)
    drive = tmp_path / "kitti/2011_09_26/2011_09_26_drive_0002_sync"
    (drive / "image_03/data").mkdir(parents=True)
    (drive.parent / "calib_cam_to_cam.txt").write_text(CALIBRATION)
    name = "val/aachen/aachen_000000_000019"
    camera = tmp_path / "city/camera" / f"{name}_camera.json"
    camera.write_text(json.dumps(CAMERA_JSON))
    images = SimpleNamespace(
        city=tmp_path / "city/leftImg8bit" / f"{name}_leftImg8bit.png",
        kitti=drive / "image_03/data/0000000003.png",
        plain=tmp_path / "plain.png",
    )
    for path in vars(images).values():
        assert cv2.imwrite(str(path), PHOTO)
    return SimpleNamespace(**vars(images), camera=camera, root=tmp_path, drive=drive)


def test_a_data_set_knows_its_cameras(tree):
    city = camera_of(tree.city, OWN, Given())
    assert city.K_33[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [500, 510, 200, 80]
    assert (city.height_m, city.pitch_rad, city.source) == (1.22, 0.04, str(tree.camera))
    neighbour = tree.root / "city/leftImg8bit_sequence/val/aachen/aachen_000000_000020_leftImg8bit"
    assert camera_of(neighbour.with_suffix(".png"), OWN, Given()).source == str(tree.camera)
    kitti = camera_of(tree.kitti, OWN, Given())
    assert kitti.K_33[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [720, 730, 180, 75]
    assert kitti.height_m == 1.65
    assert "camera 03" in kitti.source


def test_what_the_user_says_comes_first(tree):
    calibration = tree.drive.parent / "calib_cam_to_cam.txt"
    named = camera_of(tree.plain, OWN, Given(calibration=calibration, height_m=2.0))
    assert named.K_33[0, 0] == 700, "camera 02 where no folder says another"
    assert named.height_m == 2.0
    assert "height from --camera-height" in named.source
    assert camera_of(tree.kitti, OWN, Given(calibration=calibration)).K_33[0, 0] == 720
    numbers = camera_of(tree.city, OWN, Given(focal_and_center=(9, 8, 7, 6)))
    assert numbers.K_33.tolist() == [[9, 0, 7], [0, 8, 6], [0, 0, 1]]
    assert numbers.height_m is None
    assert camera_of(tree.plain, OWN, Given(camera=tree.camera)).K_33[0, 0] == 500


def test_a_guess_is_called_one(tree):
    guess = camera_of(tree.plain, OWN, Given())
    assert guess.guessed
    assert "guessed: 60 degrees" in guess.source
    assert 2 * math.degrees(math.atan(200 / guess.K_33[0, 0])) == pytest.approx(60)
    assert guess.K_33[:2, 2].tolist() == [199.5, 74.5]
    assert guess.height_m is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"height_m": 1.5}, "--camera-height asks for metres, which takes the camera's intrin"),
        ({"height_m": -1.0}, "no height in metres"),
        ({"focal_and_center": (1, 0, 1, 1)}, "impossible intrinsics"),
        ({"focal_and_center": (900, 900, 1024, 512)}, "they are another camera's"),
        ({"focal_and_center": (9, 8, 7, 6), "camera": Path("x")}, "exclude each other"),
        ({"camera": Path("nowhere.json")}, r"nowhere\.json: cannot be read"),
        ({"calibration": Path("no/calib_cam_to_cam.txt")}, r"no/calib_cam_to_cam\.txt: missing"),
        ({"calibration": Path("other.txt")}, "neither a calibration of OpenCV .* nor KITTI's"),
    ],
)
def test_impossible_cameras(tree, given, message):
    with pytest.raises(ValueError, match=message) as error:
        camera_of(tree.plain, OWN, Given(**given))
    assert "\n" not in str(error.value)


def test_a_calibration_for_other_images(tree):
    path = tree.drive.parent / "calib_cam_to_cam.txt"
    path.write_text(CALIBRATION.replace("4.0e+02", "5.0e+02"))
    with pytest.raises(ValueError, match="for images of 150x500 pixels, not 150x400"):
        camera_of(tree.kitti, OWN, Given())
    path.write_text("no calibration")
    with pytest.raises(ValueError, match="no P_rect_03"):
        camera_of(tree.kitti, OWN, Given())


# --- files in and out -----------------------------------------------------------------------------


def test_inputs_are_files_folders_and_patterns(tree):
    assert predictions.find([str(tree.plain)]) == [tree.plain]
    assert predictions.find([str(tree.root)]) == [tree.city, tree.kitti, tree.plain]
    pattern = str(tree.root / "kitti/*/*/image_03/data/*.png")
    assert predictions.find([pattern, str(tree.plain)]) == [tree.kitti, tree.plain]
    with pytest.raises(ValueError, match="no image in this folder"):
        predictions.find([str(tree.camera.parent)])
    with pytest.raises(ValueError, match=r"no file, folder or pattern with files '/no/\*\.png'"):
        predictions.find(["/no/*.png"])


def test_outputs_are_named_below_what_inputs_have_in_common(tree):
    assert predictions.stems_of([tree.plain]) == ["plain"]
    name = "aachen_000000_000019_leftImg8bit"
    both = predictions.stems_of([tree.city, tree.plain])
    assert both == [f"city/leftImg8bit/val/aachen/{name}", "plain"]
    with pytest.raises(ValueError, match="there twice, such as 'plain'"):
        predictions.stems_of([tree.plain, tree.plain.with_suffix(".jpg")])


def test_a_folder_is_whole_or_not_there(tmp_path):
    out = tmp_path / "deep/out"

    def stop_halfway():
        with predictions.whole_folder(out) as folder:
            (folder / "a").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stop_halfway()
    assert not list(out.parent.iterdir())
    out.mkdir()
    with predictions.whole_folder(out) as folder:
        (folder / "a").write_text("whole")
        assert not list(out.iterdir())
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    with pytest.raises(ValueError, match="not an empty folder"), predictions.whole_folder(out):
        pass
    assert (out / "a").read_text() == "whole"


# --- the command ----------------------------------------------------------------------------------


def write_run(folder, cell, labels=CITYSCAPES20):
    torch.manual_seed(0)
    folder.mkdir()
    write_json(folder / "cell.json", to_dict(cell))
    tasks = tasks_of(cell.recipe, cell.tasks, labels)
    state = {"format": 1, "model": build_model(cell, tasks).state_dict()}
    torch.save(state, folder / "last.pt")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder with an untrained network."""
    return write_run(tmp_path_factory.mktemp("runs") / "both", small_cell())


def command(run, *words):
    return RUNNER.invoke(app, ["predict", "--checkpoint", str(run), *map(str, words)])


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_images_become_pictures_and_numbers(run, tree):
    out = tree.root / "out"
    result = command(run, tree.city, tree.plain, "--out", out)
    assert result.exit_code == 0, result.output
    assert "guessed: 60 degrees" in result.stdout
    assert "2 frames, " in result.stdout
    assert " FPS" in result.stdout
    record = json.loads((out / "prediction.json").read_text())
    assert record["cell"] == small_cell().slug
    assert record["network_size"] == [64, 128]
    first, second = record["images"]
    assert first["camera"]["height_m"] == 1.22
    assert second["camera"]["source"].startswith("guessed")
    assert second["unit"] in (HEIGHTS, UNSCALED)
    base = str(out / "plain_")
    assert read(f"{base}overlay.png").shape[1] == 2 * OWN[1]
    assert read(f"{base}depth_colors.png").shape[1] == 2 * OWN[1]
    assert read(f"{base}points.png").shape == (480, 960, 3)
    ids, depth = read(f"{base}instanceIds.png"), read(f"{base}depth.png")
    assert ids.dtype == depth.dtype == np.uint16
    assert ids.shape == depth.shape == OWN
    with np.load(f"{base}points.npz") as cloud:
        seen = np.sort(cloud["points"][:, 2])
    steps = np.sort(depth[depth > 0])
    assert len(steps) == len(seen), "the same pixels"
    of_a_unit = record["depth_steps_of"].get("plain", record["depth_steps"])
    assert np.abs(steps / of_a_unit - seen.clip(max=65535 / 256)).max() <= 0.5 / of_a_unit + 1e-4
    assert Path(f"{base}points.ply").is_file()


def test_only_what_is_asked_for_is_written(run, tree):
    out = tree.root / "out"
    assert command(run, tree.plain, "--out", out, "--what", "ids", "-q").output == ""
    assert {path.name for path in out.iterdir()} == {"prediction.json", "plain_instanceIds.png"}
    assert command(run, tree.plain, "--out", out / "b", "--what", "depth", "-q").output == ""
    names = {"prediction.json", "plain_depth.png", "plain_depth_colors.png"}
    assert {path.name for path in (out / "b").iterdir()} == names


def test_a_cell_of_one_task_predicts_that(tree, tmp_path):
    run = write_run(tmp_path / "depth", small_cell(tasks=("depth",)))
    out = tree.root / "out"
    assert command(run, tree.plain, "--out", out).exit_code == 0
    names = {path.name for path in out.iterdir()}
    assert {"plain_depth.png", "plain_points.ply"} <= names
    assert not {"plain_overlay.png", "plain_instanceIds.png"} & names
    result = command(run, tree.plain, "--out", tmp_path / "x", "--what", "ids")
    assert "--what ids takes the task panoptic, which the cell lacks" in result.stderr


def write_video(path, frames, size=(48, 80)):
    with video.Writer(path, 10.0) as writer:
        for number in range(frames):
            writer.write(np.full((*size, 3), 20 * number % 255, np.uint8))
    return path


def test_a_video_becomes_a_video(run, tmp_path):
    path, out = write_video(tmp_path / "drive.mp4", 7), tmp_path / "out"
    result = command(run, path, "--out", out)
    assert result.exit_code == 0, result.output
    assert "7 frames, " in result.stdout
    assert {file.name for file in out.iterdir()} == {"prediction.json", "drive.mp4"}
    made = video.Reader(out / "drive.mp4")
    frames = list(made)
    assert len(frames) == made.frames == 7
    assert made.fps == 10
    assert made.size[1] == 2 * 640 + 8, "two pictures side by side, large enough for text"
    record = json.loads((out / "prediction.json").read_text())
    assert (record["frames"], record["size"]) == (7, [48, 80])
    assert "guessed" in record["camera"]["source"]


def test_frames_of_a_video_can_be_written_too(run, tmp_path):
    path, out = write_video(tmp_path / "drive.mp4", 2), tmp_path / "out"
    assert command(run, path, "--out", out, "--what", "depth").exit_code == 0
    names = {file.name for file in out.iterdir()}
    assert {"drive_000000_depth.png", "drive_000001_depth.png", "drive.mp4"} <= names


def test_a_video_is_never_held_as_a_whole(tmp_path, monkeypatch):
    made: list[weakref.ref] = []
    alive: list[int] = []

    class Lazy:
        fps, frames, size = 5.0, 0, SIZE

        def __init__(self, path):
            pass

        def __iter__(self):
            for number in range(12):
                frame = np.full((*SIZE, 3), number, np.uint8)
                made.append(weakref.ref(frame))
                alive.append(sum(ref() is not None for ref in made))
                yield frame
                del frame

    monkeypatch.setattr(predictions, "Reader", Lazy)
    told: list[int] = []
    job = predictions.Job(street_predictor(SIZE, SIZE, K)[0], Given(), [])
    job.progress = lambda done, total: told.append(len(made))
    record = predictions.predict_video(job, [tmp_path / "x.mp4"], tmp_path)
    assert record["frames"] == 12
    assert told == list(range(1, 13)), "a frame is decoded when the one before is done"
    assert max(alive) <= 2, "the frame at hand and the one before"


# --- bad input ------------------------------------------------------------------------------------


def test_bad_input_is_one_line_and_leaves_nothing(run, tree, tmp_path):
    text, damaged, empty = tree.root / "notes.txt", tree.root / "half.png", tree.root / "none.mp4"
    text.write_text("no picture")
    damaged.write_bytes(tree.plain.read_bytes()[:60])
    write_video(empty, 1)
    data = empty.read_bytes()
    empty.write_bytes(data[: len(data) // 3])
    for words, message in (
        ([text], "neither an image nor a video"),
        ([empty], "neither an image nor a video"),
        ([damaged], "half.png: truncated PNG"),
        ([text, damaged], "notes.txt: not an image that OpenCV can read, or a damaged one (2 im"),
        ([tree.root / "gone.png"], "no file, folder or pattern"),
        ([tree.plain, "--camera-height", "1.4"], "takes the camera's intrinsics, too"),
        ([tree.plain, "--fx", "9"], "give all of --fx --fy --cx --cy"),
        ([tree.plain, "--size", "64"], "--size '64' is not HxW"),
        ([tree.plain, "--size", "64x100"], "is not divisible"),
        ([tree.plain, "--what", "masks"], "--what 'masks' is none of overlay, depth, "),
    ):
        before = set(tree.root.rglob("*"))
        result = command(run, *words, "--out", tree.root / "out", "-q")
        assert result.exit_code == 2, (words, result.output)
        assert message in result.stderr
        assert result.stderr.count("\n") == 1, result.stderr
        assert result.stdout == ""
        assert set(tree.root.rglob("*")) == before, "nothing half-written"


def test_a_folder_with_something_in_it_stays_as_it_is(run, tree):
    before = {path: path.stat().st_mtime for path in tree.root.rglob("*")}
    result = command(run, tree.plain, "--out", tree.root)
    assert result.exit_code == 2
    assert "exists and is not an empty folder: name a new one, or remove it" in result.stderr
    assert {path: path.stat().st_mtime for path in tree.root.rglob("*")} == before


def test_a_checkpoint_of_another_class_count(tree, tmp_path):
    run = write_run(tmp_path / "other", small_cell(), CITYSCAPES19)
    result = command(run, tree.plain, "--out", tree.root / "out")
    assert result.exit_code == 2
    assert "is not of this cell's model: size mismatch" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tree.root / "out").exists()
    result = command(tmp_path / "gone", tree.plain, "--out", tree.root / "out")
    assert "no run or checkpoint" in result.stderr


def test_a_video_without_frames(tmp_path, monkeypatch):
    path = write_video(tmp_path / "drive.mp4", 1)

    class Empty:
        isOpened, release = (lambda self: True), (lambda self: None)

        def __init__(self, path):
            pass

        def get(self, what):
            return math.nan if what == cv2.CAP_PROP_FPS else 0.0

        def read(self):
            return False, None

    monkeypatch.setattr(cv2, "VideoCapture", Empty)
    with pytest.raises(ValueError, match=r"drive\.mp4: a video without a frame"):
        video.Reader(path)


def test_a_disk_that_is_full_is_noticed(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    frames = np.random.default_rng(0).integers(0, 256, (20, 128, 256, 3)).astype(np.uint8)

    def write():
        with video.Writer(tmp_path / "a.mp4", 10.0) as writer:
            for frame in frames:
                writer.write(frame)

    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
    try:
        with pytest.raises(ValueError, match="is the disk full"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


# --- rerun, and real data -------------------------------------------------------------------------


def test_a_rerun_recording(run, tree):
    pytest.importorskip("rerun")
    path = tree.root / "seen.rrd"
    assert command(run, tree.plain, "--out", tree.root / "out", "--rerun", path).exit_code == 0
    assert path.read_bytes()[:4] in (b"RRF2", b"RRIO")
    assert path.stat().st_size > 100_000, "image, depth and points"
    assert not list(tree.root.glob(".seen*"))


def test_a_recording_takes_the_package(run, tree, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    path = tree.root / "seen.rrd"
    result = command(run, tree.plain, "--out", tree.root / "out", "--rerun", path)
    assert result.exit_code == 2
    assert "pip install 'mtl-bench[rerun]'" in result.stderr
    assert not path.exists()
    assert not (tree.root / "out").exists()


def test_a_frame_of_kitti_with_its_calibration(run, tmp_path):
    drive = SHARED / "data/kitti_raw/2011_09_26/2011_09_26_drive_0002_sync"
    if not drive.is_dir():
        pytest.skip("no KITTI sample beside the checkout")
    image = drive / "image_02/data/0000000003.png"
    calibration = drive.parent / "calib_cam_to_cam.txt"
    result = command(run, image, "--calib", calibration, "--out", tmp_path / "out", "--what", "ids")
    assert result.exit_code == 0, result.output
    assert "note: 375x1242 was squeezed to 64x128; --size 64x208 would" in result.stdout
    record = json.loads((tmp_path / "out/prediction.json").read_text())["images"][0]
    assert record["camera"]["fx"] == 721.5377
    assert record["camera"]["height_m"] == 1.65


@pytest.mark.slow
def test_a_real_video_from_end_to_end(run, tmp_path):
    path = SHARED / "data/udacity_lanelines/solidWhiteRight.mp4"
    if not path.is_file():
        pytest.skip("no video beside the checkout")
    result = command(run, path, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert video.Reader(tmp_path / "out" / path.name).frames == 221
