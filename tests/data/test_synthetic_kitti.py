"""The built-in data in KITTI's layout: what it says of itself fits together and is exact."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_synthetic import digests, read, warp_error

from mtl_bench.core.config import Cell, Data, Recipe, load_recipe
from mtl_bench.core.dataset import dataset_in, dataset_of
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import kitti_files, velodyne
from mtl_bench.data import scenes as synthetic
from mtl_bench.data.kitti import Kitti
from mtl_bench.data.labels import CITYSCAPES19
from mtl_bench.data.samples import open_samples
from mtl_bench.data.scenes import kitti as kitti_layout
from mtl_bench.data.scenes import render
from mtl_bench.data.scenes.settings import SPLITS, Settings
from mtl_bench.data.synthetic_kitti import SyntheticKitti

HEIGHT, WIDTH, FRAMES, SEED = 48, 144, 4, 3
SETTINGS = Settings(HEIGHT, WIDTH, 5, 2, 17, SEED, FRAMES, FRAMES // 2, 10, layout=Kitti.layout)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    out = tmp_path_factory.mktemp("kitti") / "set"
    counts = SETTINGS.counts
    return synthetic.write(
        out, HEIGHT, WIDTH, *counts, SEED, frames=FRAMES, progress=False, layout=Kitti.layout
    )


def scene_of(split, number):
    """The scene as the writer draws it."""
    camera = kitti_layout.camera_of(SETTINGS, kitti_layout.place(SETTINGS, split, number)[0])
    return render.draw_scene((SEED, split, number), HEIGHT, WIDTH, FRAMES, FRAMES // 2, camera)


def drive_of(root, split, number):
    date, drive = kitti_layout.place(SETTINGS, split, number)
    return root / date / drive


def test_lists_and_files(root):
    """Lists as PackNet has them; every frame in them has neighbours, labels and a scan."""
    assert dataset_in(root) is Kitti
    for split, scenes in enumerate((5, 2, 17)):
        name = kitti_layout.LISTS[SPLITS[split]]
        lines = (root / "data_splits" / f"{name}.txt").read_text().splitlines()
        assert len(lines) == scenes * (FRAMES - 2)
        assert len({line.split("/")[1] for line in lines}) == scenes
        for line in lines:
            date, drive, camera, _, file = line.split("/")
            assert (camera, drive[:10], len(file)) == ("image_02", date, 14)
            image = root / line
            for step in (-1, 0, 1):
                assert image.with_name(f"{int(image.stem) + step:010d}.png").is_file()
            assert (root / date / drive / "label_02" / "data" / file).is_file()
            assert (root / date / drive / "velodyne_points/data" / f"{image.stem}.bin").is_file()
    lists = (root / "data_splits").glob("*.txt")
    drives = [{line.split("/")[1] for line in path.read_text().split()} for path in lists]
    assert not set.intersection(*drives)
    assert sum(map(len, drives)) == len(set.union(*drives)) == 24


def opened(cell, split, root, training=False, **truth):
    return open_samples(cell.recipe, tasks_of_cell(cell), split, root, training, **truth)


def test_one_test_frame_in_sixteen_has_no_improved_map(root):
    cell = Cell(load_recipe("kitti-smoke"), "none", "none")
    cell = replace(cell, recipe=replace(cell.recipe, data=replace(
        cell.recipe.data, height=HEIGHT, width=WIDTH)))  # fmt: skip
    counts = {
        (split, truth): len(opened(cell, split, root, truth=truth))
        for split in ("val", "test")
        for truth in ("improved", "velodyne")
    }
    per = FRAMES - 2
    assert counts == {
        ("val", "improved"): 2 * per, ("val", "velodyne"): 2 * per,
        ("test", "improved"): 16 * per, ("test", "velodyne"): 17 * per,
    }  # fmt: skip
    assert not (drive_of(root, 2, 15) / "proj_depth").exists()
    assert len(opened(cell, "train", root, training=True)) == 5 * per


@pytest.mark.parametrize(("split", "number"), [(0, 0), (1, 1), (2, 3)])
def test_scans_improved_maps_and_labels_are_what_is_seen(root, split, number):
    """Projected by the reader, every scanned point lies on its pixel, at the pixel's depth."""
    drive, scene = drive_of(root, split, number), scene_of(split, number)
    for frame in range(1, FRAMES - 1):
        seen = render.truth(scene, frame)
        camera = kitti_files.read_camera(drive.parent, "02")
        project = kitti_files.scanner_to_pixels(drive.parent, camera)
        scan = velodyne.read_scan(drive / f"velodyne_points/data/{frame:010d}.bin")
        depth = velodyne.depth_map(scan, project, camera.size)
        hit = depth > 0
        assert hit.sum() == len(scan)
        np.testing.assert_allclose(depth[hit], seen.depth_HW[hit], rtol=1e-6)
        assert 0.3 < hit.mean() < 0.8

        improved = kitti_files.read_improved_m(
            drive / f"proj_depth/groundtruth/image_02/{frame:010d}.png"
        )
        near = seen.depth_HW < 255
        assert np.abs(improved - seen.depth_HW)[near].max() <= 1 / 512
        assert (improved[~near] == 0).all()

        ids = read(drive / f"label_02/data/{frame:010d}.png")
        assert ids.dtype == np.uint16
        assert (np.where(ids < 1000, ids, ids // 1000) == seen.label_HW).all()
        known = {label.label_id for label in CITYSCAPES19.labels}
        assert set(np.unique(seen.label_HW).tolist()) <= known  # no ego vehicle
        assert (read(drive / f"image_02/data/{frame:010d}.png")[..., ::-1]
                == render.image(scene, frame)).all()  # fmt: skip


def test_the_ground_is_a_camera_height_below(root):
    heights = []
    for split, number in ((0, 0), (0, 1), (0, 2), (1, 0)):
        drive = drive_of(root, split, number)
        camera = kitti_files.read_camera(drive.parent, "02")
        improved = kitti_files.read_improved_m(
            drive / "proj_depth/groundtruth/image_02/0000000002.png"
        )
        road = (read(drive / "label_02/data/0000000002.png") == 7) & (improved < 12)
        rows = np.nonzero(road)[0]
        heights.append(np.median((rows - camera.K_33[1, 2]) / camera.K_33[1, 1] * improved[road]))
        scan = velodyne.read_scan(drive / "velodyne_points/data/0000000002.bin")
        low = scan[(scan[:, 2] < -1.6) & (scan[:, 0] < 12)]
        assert np.median(-low[:, 2]) == pytest.approx(1.65 + kitti_layout.ABOVE_M, abs=0.02)
    assert heights == pytest.approx([kitti_files.CAMERA_HEIGHT_M] * 4, abs=0.02)


def test_calibration_is_the_days_and_like_kittis(root):
    days = {}
    for date in kitti_layout.DATES:
        folder = root / date
        left, right = (kitti_files.read_camera(folder, name) for name in ("02", "03"))
        assert kitti_files.baseline_m(folder) == pytest.approx(0.54)
        assert left.size == right.size == (HEIGHT, WIDTH)
        fx, fy, cx, cy = left.K_33[[0, 1, 0, 1], [0, 1, 2, 2]]
        assert fx == fy == pytest.approx(721.5 / 1242 * WIDTH, rel=0.02)
        assert cx / WIDTH == pytest.approx(609.6 / 1242, abs=0.01)
        assert cy / HEIGHT == pytest.approx(172.9 / 375, abs=0.01)
        days[date] = fx
    assert len(set(days.values())) == 5


def test_oxts_say_how_the_car_moves(root):
    for number in range(3):
        drive, scene = drive_of(root, 0, number), scene_of(0, number)
        paths = [drive / f"oxts/data/{frame:010d}.txt" for frame in range(FRAMES)]
        values = np.array([[float(word) for word in path.read_text().split()] for path in paths])
        assert values.shape == (FRAMES, 30)
        north, east = np.diff(values[:, 0]) * 111320, np.diff(values[:, 1]) * 73033
        moved = np.hypot(north, east) * kitti_layout.FRAMES_PER_S
        assert values[1:, 8] == pytest.approx(moved, rel=0.1)
        course = np.arctan2(north, east)
        assert values[1:, 5] == pytest.approx(course, abs=0.02)  # yaw: from east to the left
        assert values[:, 4] == pytest.approx([p.rotation_33[1, 2] for p in scene.motion.poses])
        stamps = (drive / "image_02/timestamps.txt").read_text().splitlines()
        assert len(stamps) == FRAMES


def test_true_depth_and_motion_warp_the_next_frame():
    sums = np.array([warp_error(scene_of(0, number), 2, 1) for number in range(6)]).sum(0)
    assert sums[1] / sums[2] > 0.015  # there is something to see
    assert sums[0] <= 0.1 * sums[1]


def test_bytes_depend_on_seed_and_number_alone(tmp_path):
    sets = {}
    for name, processes, seed in (("one", 1, 1), ("two", 2, 1), ("other", 1, 2)):
        out = tmp_path / name
        synthetic.write(
            out, 32, 96, 3, 1, 1, seed, processes=processes, progress=False, layout=Kitti.layout
        )
        sets[name] = digests(out)
    assert len(sets["one"]) > 40
    assert sets["one"] == sets["two"]
    images = [name for name in sets["one"] if "image_02/data" in name]
    assert not [name for name in images if sets["other"][name] == sets["one"][name]]


def test_a_recipe_renders_by_the_data_sets_name(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    data = Data(dataset="synthetic-kitti", height=16, width=48, train_scenes=1, val_scenes=0,
                test_scenes=2)  # fmt: skip
    kind = dataset_of(Recipe(data=data))
    assert kind is SyntheticKitti
    out = kind.render(data, quiet=True)
    assert out.is_relative_to(tmp_path)
    assert out.name.startswith("synthetic-kitti-16x48-")
    assert dataset_in(out) is Kitti
    assert (out / "data_splits/eigen_val_files.txt").read_text() == ""
    assert len((out / "data_splits/eigen_test_files.txt").read_text().splitlines()) == 2
    before = digests(out)
    assert kind.render(data, quiet=True) == out
    assert digests(out) == before


def test_sets_of_cityscapes_layout_keep_their_names(tmp_path):
    """No layout is in them, as before there was another: they are found again in the user's cache
    until the renderer's version is raised."""
    data = Data(height=16, width=32, train_scenes=1, val_scenes=1)
    out = synthetic.ensure(data, tmp_path, progress=False)
    assert out.name == "synthetic-16x32-c221b4c0fccc"
    assert "layout" not in (out / "synthetic.json").read_text()


def test_a_full_size_scan_is_as_sparse_as_kittis():
    """64 beams hit 4 % of a 375 x 1242 image: about 19,200 of its pixels on real frames."""
    settings = replace(SETTINGS, height=375, width=1242)
    camera = kitti_layout.camera_of(settings, kitti_layout.DATES[0])
    scene = render.draw_scene((SEED, 0, 0), 375, 1242, 3, 1, camera)
    depth = render.truth(scene, 1).depth_HW
    points = kitti_layout.scan(depth, camera, np.zeros_like(depth))
    assert points.dtype == np.float32
    assert 0.02 < len(points) / depth.size < 0.06
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    assert elevation.max() < 3
    assert len(np.unique(np.round(elevation * 2))) > 15


@pytest.mark.slow
def test_the_command_renders_kittis_layout(tmp_path):
    command = [sys.executable, "-m", "mtl_bench", "data", "synthetic", "--layout", "kitti"]
    command += ["--out", str(tmp_path / "k"), "--size", "32x96", "--scenes", "2", "-q"]
    subprocess.run([*command, "--val-scenes", "1", "--test-scenes", "1"], check=True)
    assert dataset_in(tmp_path / "k") is Kitti
    image = next((tmp_path / "k").rglob("image_02/data/*.png"))
    assert cv2.imread(str(image)).shape == (32, 96, 3)
