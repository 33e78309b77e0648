"""KITTI raw: golden numbers of real frames, the published splits, and trees that lack something."""

import hashlib
import json
import os
import shutil
from dataclasses import replace

import cv2
import kitti_tree
import numpy as np
import pytest
import torch
from conftest import SHARED
from kitti_tree import (
    FOCAL,
    HEIGHT,
    OTHER_DAY,
    TEST,
    TRAIN,
    VAL,
    WALL_M,
    WIDTH,
    file,
    improved,
    names,
    open_tree,
    put_png,
    write_drive,
    write_tree,
)
from typer.testing import CliRunner

from mtl_bench.bench import store
from mtl_bench.bench.run import run_cell
from mtl_bench.cli.app import app
from mtl_bench.core import config, locks
from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import kitti_files, kitti_splits, velodyne
from mtl_bench.data.check_kitti import check_kitti
from mtl_bench.data.kitti_files import Tree, read_camera, scanner_to_pixels
from mtl_bench.data.kitti_splits import Frame
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.data.loader import eval_batches
from mtl_bench.data.samples import open_samples
from mtl_bench.evaluate.trivial import baselines
from mtl_bench.tasks.panoptic import pseudo_labels

REAL = SHARED / "data" / "kitti_raw"
LISTS = SHARED / "data" / "splits"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no real samples (../shared/data)")
needs_lists = pytest.mark.skipif(not LISTS.is_dir(), reason="no published lists (../shared/data)")


@pytest.fixture
def tree(tmp_path):
    return write_tree(tmp_path / "kitti")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


# --- golden numbers of real frames ----------------------------------------------------------------


@needs_real
def test_calibration_of_a_real_day():
    camera = read_camera(REAL / "2011_09_26", "02")
    expected = [[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]]
    np.testing.assert_array_equal(camera.K_33, expected)
    assert camera.size == (375, 1242)
    assert kitti_files.baseline_m(REAL / "2011_09_26") == pytest.approx(0.53273, abs=1e-5)


@needs_real
@pytest.mark.parametrize(
    ("number", "pixels", "counted", "median", "total"),
    [
        (0, 19137, 17197, 13.5440, 332378.18),
        (3, 19299, 17260, 12.9490, 321427.80),
        (6, 19196, 17144, 12.9145, 323695.70),
        (9, 19113, 16993, 12.7620, 323022.62),
    ],
)
def test_projected_scan_of_a_real_frame(number, pixels, counted, median, total):
    """As published numbers were measured; but of frame 0 no two pixels are taken for one."""
    frame, tree = Frame(TEST, "02", number), Tree(REAL)
    if not tree.has_scan(frame):
        pytest.skip(f"no scan of frame {number}")
    camera = read_camera(REAL / "2011_09_26", "02")
    project_34 = scanner_to_pixels(REAL / "2011_09_26", camera)
    depth_m = velodyne.depth_map(velodyne.read_scan(tree.scan(frame)), project_34, camera.size)
    valid = (depth_m > 1e-3) & (depth_m < 80)
    valid[:153] = valid[371:] = False
    valid[:, :44] = valid[:, 1197:] = False
    assert np.count_nonzero(depth_m) == pixels
    assert np.count_nonzero(valid) == counted
    assert np.median(depth_m[valid]) == pytest.approx(median, abs=1e-4)
    assert depth_m.sum(dtype=np.float64) == pytest.approx(total, abs=0.01)


@needs_real
def test_the_real_sample_as_a_data_set():
    dataset = open_tree(REAL, "test", data=config.Data(height=375, width=1242))
    assert dataset.names == names(TEST, 3, 6)
    assert dataset.dataset.described == {
        "frames": 2,
        "frames_published": 697,
        "left_out": {"absent": 693, "without depth maps": 2},
        "depth_truth": {"velodyne": 2},
    }
    sample = dataset.sample(0, None)
    assert sample.camera.K_B33[0, 2].item() == pytest.approx(609.5593)
    assert sample.camera.height_m_B.item() == pytest.approx(1.65)
    assert sample.camera.pitch_rad_B.item() == 0
    assert torch.count_nonzero(sample.fields["depth_m"]) == 19299
    with pytest.raises(ValueError, match="none of its 4 frames of test has a depth map"):
        open_tree(REAL, "test", truth="improved")
    with pytest.raises(ValueError, match=r"none of the 39810 frames .*train_frames=all"):
        open_tree(REAL, panoptic=False)


# --- the published splits -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("split", "count", "digest"),
    [
        ("train", 39810, "106fa7bc1d9aa081"),
        ("val", 4424, "f19fc40ed31141c1"),
        ("test", 697, "4a6f68ba068d7b9d"),
        ("not improved", 45, "0f6619bbc6335817"),
    ],
)
def test_published_splits(split, count, digest):
    frames = kitti_splits.published(split) if split in kitti_splits.SPLITS else None
    frames = sorted(kitti_splits.without_improved()) if frames is None else frames
    text = "\n".join(frame.name for frame in frames)
    assert len(frames) == count
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest


@needs_lists
def test_splits_are_the_lists_that_were_published():
    def read(path):
        lines = [line.split() for line in (LISTS / path).read_text().splitlines()]
        return {Frame(d.split("/")[1], kitti_splits.CAMERAS[s], int(n)) for d, n, s in lines}

    train, val = read("eigen_zhou/train_files.txt"), read("eigen_zhou/val_files.txt")
    test, benchmark = read("eigen/test_files.txt"), read("eigen_benchmark/test_files.txt")
    assert set(kitti_splits.published("train")) == train
    assert set(kitti_splits.published("val")) == val
    assert set(kitti_splits.published("test")) == test
    assert kitti_splits.without_improved() == test - benchmark
    packed = {"zhou": train | val, "val": val, "test": test, "not_improved": test - benchmark}
    for name, frames in packed.items():
        lines = (kitti_splits.FOLDER / f"{name}.txt").read_text().splitlines()
        assert lines[1:] == kitti_splits.pack(frames)
    assert sum(path.stat().st_size for path in kitti_splits.FOLDER.glob("*.txt")) < 60_000


def test_packing_is_undone():
    frames = [Frame("a", "02", n) for n in (1, 2, 3, 7)] + [Frame("a", "03", n) for n in (2, 4)]
    frames += [Frame("b", camera, 0) for camera in ("02", "03")]
    lines = kitti_splits.pack(frames)
    assert lines == ["a l 1-3,7", "a r 2,4", "b lr 0"]
    assert list(kitti_splits.unpack(lines)) == frames


def test_a_tree_of_other_days_brings_its_own_lists(tree):
    path = tree / "data_splits" / "eigen_zhou_files.txt"
    path.parent.mkdir()
    path.write_text("2000_01_01/2000_01_01_drive_0001_sync/image_03/data/0000000007.png more\n")
    assert len(kitti_splits.frames_of(tree, "train")) == 39810  # it has KITTI's days: theirs count
    for date in kitti_tree.SIZES:
        (tree / date).rename(tree / f"away_{date}")
    own = (Frame("2000_01_01_drive_0001_sync", "03", 7),)
    assert kitti_splits.frames_of(tree, "train") == own
    path.write_text("2000_01_01 7 r\n")
    with pytest.raises(ValueError, match="line 1 is '2000_01_01 7 r', not an image's path"):
        kitti_splits.frames_of(tree, "train")


# --- what a sample holds --------------------------------------------------------------------------


def test_training_frames_have_both_neighbours(tree):
    dataset = open_tree(tree)
    assert dataset.names == names(TRAIN, 3, 4, 5)
    assert dataset.dataset.left_out == {"absent": 39810 - 5, "without neighbours": 2}
    assert dataset.dataset.published_frames == 39810
    sample = dataset.sample(1, generator())
    for place, number in enumerate((3, 5)):
        image = cv2.imread(str(file(tree, TRAIN, "image_02", number)))[..., ::-1]
        expected = torch.from_numpy(image.copy()).permute(2, 0, 1) / 255
        assert torch.equal(sample.fields["neighbours"][place], expected)
    sky = CITYSCAPES19.index("sky")
    assert (sample.fields["semantic"][:4] == sky).all()
    assert not sample.fields["reprojection_mask"][:4].any()
    assert sample.fields["reprojection_mask"][4:].all()
    assert (dataset.dataset.static_from, dataset.dataset.knows_static) == ("labels", True)
    K = torch.tensor([[FOCAL, 0, 23.5], [0, FOCAL, 7.5], [0, 0, 1]])
    torch.testing.assert_close(sample.camera.K_B33, K)


def test_all_frames_train_but_those_that_measure(tree):
    data = config.Data(dataset="kitti", height=HEIGHT, width=WIDTH, train_frames="all")
    own = "2011_09_28_drive_9999_sync"
    write_drive(tree, own, range(5), "03")
    dataset = open_tree(tree, data=data, panoptic=False)
    expected = [*names(TRAIN, 3, 4, 5), *names(own, 1, 2, 3, camera="03")]
    assert dataset.names == expected
    write_drive(tree, VAL, range(3, 8))  # 4 and 6 validate
    expected[3:3] = names(VAL, 5)
    assert open_tree(tree, data=data, panoptic=False).names == expected
    assert dataset.dataset.described["frames_published"] is None
    assert dataset.sample(len(dataset) - 1, generator()).image_B3HW.shape == (3, HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="must be published or all, not 'most'"):
        replace(data, train_frames="most")


def test_truth_of_test_frames(tree):
    dataset = open_tree(tree, "test")
    assert dataset.names == [*names(TEST, 3, 6, 9), *names(OTHER_DAY, 3, 6)]
    assert dataset.dataset.truth_counts == {"improved": 2, "velodyne": 3}
    scanned, stored = (dataset.sample(index, None).fields["depth_m"] for index in (0, 1))
    assert torch.equal(stored[1:], torch.full((HEIGHT - 1, WIDTH), 5.0))
    assert (stored[0] == 0).all()
    assert set(scanned.unique().tolist()) == {0, WALL_M}
    assert 100 < torch.count_nonzero(scanned) < 37 * 13

    raw = open_tree(tree, "test", truth="velodyne")
    assert (len(raw), raw.dataset.published_frames, dict(raw.dataset.truth_counts)) == (
        5,
        697,
        {"velodyne": 5},
    )
    best = open_tree(tree, "test", truth="improved")
    assert best.names == names(TEST, 6, 9)
    assert (best.dataset.published_frames, best.dataset.left_out["without depth maps"]) == (652, 3)
    with pytest.raises(ValueError, match="no depth truth 'stereo': it has improved"):
        open_tree(tree, "test", truth="stereo")


def test_improved_maps_in_every_layout(tree):
    expected = open_tree(tree, "test", truth="improved").sample(0, None).fields["depth_m"]
    package = tree.parent / "data_depth_annotated"
    inside = tree / "2011_09_26" / TEST / "proj_depth"
    for source, target in (
        (package, tree / "data_depth_annotated"),
        (tree / "data_depth_annotated" / "val", tree / "train"),
        (tree / "train", tree.parent / "val"),
        (tree.parent / "val" / TEST, tree.parent / "data_depth_annotated" / TEST),
        (tree.parent / "data_depth_annotated" / TEST / "proj_depth", inside),
    ):
        target.parent.mkdir(exist_ok=True)
        source.rename(target)
        dataset = open_tree(tree, "test", truth="improved")
        assert torch.equal(dataset.sample(0, None).fields["depth_m"], expected)


def test_the_nearest_point_of_a_pixel_wins():
    project_34 = np.array([[0, -10.0, 0, 0], [0, 0, -10, 0], [1, 0, 0, 0]]) + 0
    project_34[:2, 0] = 3
    points = np.array([[20, 0, 0], [5, 0, 0], [9, 0, 0], [-4, 0, 0], [0, 1, 0], [8, -50, 0]])
    depth_m = velodyne.depth_map(points.astype(np.float32), project_34, (6, 6))
    assert depth_m[2, 2] == 5  # round(3) - 1
    assert np.count_nonzero(depth_m) == 1


def test_days_of_other_sizes_are_resized_and_measured_at_their_own(tree):
    data = config.Data(dataset="kitti", height=8, width=24)
    dataset = open_tree(tree, "test", data=data)
    first, last = dataset.sample(0, None), dataset.sample(4, None)
    assert first.image_B3HW.shape == last.image_B3HW.shape == (3, 8, 24)
    assert last.camera.K_B33[0, 0].item() == pytest.approx(FOCAL * 24 / 47)
    assert last.camera.K_B33[1, 1].item() == pytest.approx(FOCAL * 8 / 15)
    assert last.camera.K_B33[1, 2].item() == pytest.approx((7 + 0.5) * 8 / 15 - 0.5)
    assert (first.fields["depth_m"].shape, last.fields["depth_m"].shape) == ((16, 48), (15, 47))
    sizes = [(len(b.names), b.fields["depth_m"].shape[1:]) for b in eval_batches(dataset, 2)]
    assert sizes == [(2, (16, 48)), (1, (16, 48)), (2, (15, 47))]
    larger = open_tree(tree, data=config.Data(dataset="kitti", height=17, width=50))
    sample = larger.sample(0, generator())
    assert sample.image_B3HW.shape == (3, 17, 50)
    assert sample.fields["semantic"].unique().numel() == 3


def test_predicted_labels_are_no_truth(tree):
    dataset = open_tree(tree, "test")
    assert dataset.sample(0, None).fields["instance_ids"].unique().tolist() == [7, 23, 26001]
    (tree / kitti_files.RECORD).write_text("{}")
    assert "instance_ids" not in open_tree(tree, "test").sample(0, None).fields
    assert open_tree(tree).sample(0, generator()).fields["semantic"] is not None
    (tree / kitti_files.RECORD).unlink()
    file(tree, TEST, "label_02", 3).unlink()  # metrics over some of the frames would be others
    assert "instance_ids" not in open_tree(tree, "test").sample(1, None).fields


def test_depth_trains_without_labels(tree):
    shutil.rmtree(tree / "2011_09_26" / TRAIN / "label_02")
    dataset = open_tree(tree, panoptic=False)
    assert (dataset.dataset.static_from, dataset.dataset.knows_static) == ("none", False)
    assert dataset.sample(0, generator()).fields["reprojection_mask"].all()


def test_the_right_camera_has_its_own_intrinsics(tree):
    write_drive(tree, TRAIN, range(2, 7), "03")
    path = tree / "2011_09_26" / "calib_cam_to_cam.txt"
    path.write_text(path.read_text().replace("P_rect_03: 20.0", "P_rect_03: 22.0"))
    dataset = open_tree(tree)
    assert dataset.names == [*names(TRAIN, 3, 4, 5), *names(TRAIN, 3, 4, 5, camera="03")]
    focal = [dataset.sample(index, generator()).camera.K_B33[0, 0].item() for index in (0, 3)]
    assert focal == [20.0, 22.0]


def test_cached_frames_change_nothing(tree, monkeypatch):
    data = config.Data(dataset="kitti", height=8, width=24, cache=False)
    fresh = open_tree(tree, data=data)
    samples = [fresh.sample(index, generator(index)) for index in range(3)]
    sources = fresh.dataset.sources()
    assert len(sources) == 5 + 3  # with neighbours; labels
    for path, content in sources:
        fresh.dataset.on_disk.add(path, content)
    monkeypatch.setattr("mtl_bench.data.png.read", None)
    for index, sample in enumerate(samples):
        again = open_tree(tree, data=data).sample(index, generator(index))
        for name, value in sample.tensors().items():
            assert torch.equal(again.tensors()[name], value)


def opened(cell, split, root, **truth):
    return open_samples(cell.recipe, tasks_of_cell(cell), split, root, training=False, **truth)


def test_data_sets_by_name(tree, smoke_root):
    labels = {
        name: dataset_of(config.Recipe(data=config.Data(dataset=name))).labels
        for name in ("kitti", "synthetic-kitti", "cityscapes", "synthetic")
    }
    assert labels["kitti"] == labels["synthetic-kitti"] == CITYSCAPES19
    assert labels["cityscapes"] == labels["synthetic"] == CITYSCAPES20
    cell = cell_of(height=HEIGHT, width=WIDTH)
    assert len(opened(cell, "test", tree)) == 5
    assert len(opened(cell, "test", tree, truth="improved")) == 2
    smoke = Cell(load_recipe("smoke"), "tiny", "fixed_uncertainty")
    with pytest.raises(ValueError, match="no depth truth 'velodyne': it has disparity"):
        opened(smoke, "val", smoke_root, truth="velodyne")


def test_trivial_predictors_of_days_of_two_sizes(tree, tmp_path):
    cell = cell_of(height=HEIGHT, width=WIDTH)
    metrics = baselines(cell, tree, tmp_path / "cache").metrics
    assert metrics["depth_dgc.abs_rel"] == pytest.approx(1)  # walls at 10 m, measured at 5 m
    assert metrics["eigen-raw.depth_median.abs_rel"] == pytest.approx(0)
    assert metrics["semantic.class.sky.iou"] == pytest.approx(100)
    assert metrics["panoptic.class.road.pq"] == pytest.approx(100)


# --- broken trees ---------------------------------------------------------------------------------


def refused(message, act):
    with pytest.raises(ValueError, match=message) as error:
        act()
    assert "\n" not in str(error.value)
    return str(error.value)


def read_all(root):
    open_tree(root).sample(0, generator())
    dataset = open_tree(root, "test")
    for index in range(len(dataset)):
        dataset.sample(index, None)


@pytest.mark.parametrize("name", ["calib_cam_to_cam.txt", "calib_velo_to_cam.txt"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "missing; unpack 2011_09_26_calib.zip"),
        (lambda path: path.write_text("hello"), "no (P_rect_02|R) in this calibration"),
        (lambda path: path.write_text("P_rect_02: a\nR: a"), "(P_rect_02|R) is not numbers"),
        (lambda path: path.write_text("P_rect_02: 1 2\nR: 1 2"), "2 numbers, not (12|9) finite"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00"), "cannot be read"),
    ],
)
def test_broken_calibration(tree, name, change, message):
    path = tree / "2011_09_26" / name
    change(path)
    text = refused(f"{path}: .*{message}", lambda: read_all(tree))
    assert text in [str(problem) for problem in check_kitti(tree).problems]


BROKEN = [
    ("image_02", lambda p: put_png(p, np.zeros((16, 48, 3), np.uint16)), "16-bit PNG where 8"),
    ("image_02", lambda p: p.write_bytes(p.read_bytes()[:-20]), "truncated PNG"),
    ("image_02", lambda p: p.write_bytes(b""), "the file is empty"),
    ("image_02", lambda p: put_png(p, np.zeros((9, 9, 3), np.uint8)), "9x9 pixels, but the day's"),
    ("label_02", lambda p: put_png(p, np.zeros((16, 48), np.uint8)), "8-bit PNG where 16"),
    ("label_02", lambda p: put_png(p, np.zeros((9, 9), np.uint16)), "9x9 pixels, but"),
]


@pytest.mark.parametrize(("folder", "change", "message"), BROKEN)
def test_broken_pictures(tree, folder, change, message):
    shutil.rmtree(tree / "2011_09_26" / TRAIN / "velodyne_points")
    path = file(tree, TRAIN, folder, 3)
    for number in (2, 6):
        file(tree, TRAIN, "image_02", number).unlink()
    for number in (3, 5):  # the first and last that are left
        change(file(tree, TRAIN, folder, number))
    shutil.copytree(tree, tree.parent / "copy")
    data = config.Data(dataset="kitti", height=HEIGHT, width=WIDTH)
    write_drive(tree.parent / "spare", TRAIN, (2, 6))
    for number in (2, 6):  # neighbours that are in order
        spare = file(tree.parent / "spare", TRAIN, "image_02", number)
        spare.rename(file(tree, TRAIN, "image_02", number))
    text = refused(
        f"{path}: .*{message}", lambda: open_tree(tree, data=data).sample(0, generator())
    )
    copied = text.replace(str(tree), str(tree.parent / "copy"))
    assert copied in [str(problem) for problem in check_kitti(tree.parent / "copy").problems]
    assert text in [str(problem) for problem in check_kitti(tree, deep=True).problems]


def test_a_neighbour_of_another_size_or_gone(tree):
    path = file(tree, TRAIN, "image_02", 4)
    put_png(path, np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    refused(f"{path}: 16x49 pixels, but 0000000003.png has 16x48", lambda: read_all(tree))
    path.unlink()
    refused("none of the 39810 frames of the split train", lambda: open_tree(tree))
    write_drive(tree, TRAIN, (7,))
    assert open_tree(tree).names == names(TRAIN, 6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: put_png(p, np.zeros((16, 48), np.uint8)), "8-bit PNG where 16"),
        (lambda p: put_png(p, np.zeros((9, 9), np.uint16)), "9x9 pixels, but"),
        (lambda p: p.write_bytes(p.read_bytes()[:50]), "truncated PNG"),
    ],
)
def test_broken_depth_maps(tree, change, message):
    path = improved(tree, TEST, 9)
    change(path)
    text = refused(f"{path}: .*{message}", lambda: read_all(tree))
    assert [str(problem) for problem in check_kitti(tree).problems] == [text]


@pytest.mark.parametrize("length", [0, 15, 161])
def test_scans_that_were_cut_off(tree, length):
    path = file(tree, TEST, "velodyne_points", 3, ".bin")
    path.write_bytes(wall_bytes()[:length])
    text = refused(f"{path}: {length} bytes are no whole number of points", lambda: read_all(tree))
    assert [str(problem) for problem in check_kitti(tree).problems] == [text]


def wall_bytes():
    return kitti_tree.wall().tobytes()


def test_empty_splits_and_no_tree_at_all(tree, tmp_path):
    for drive in (TRAIN, TEST, OTHER_DAY):
        shutil.rmtree(tree / drive[:10] / drive)
    refused("none of the 39810 frames .*train_frames=all to train", lambda: open_tree(tree))
    refused("none of the 697 frames of the split test; unpack", lambda: open_tree(tree, "test"))
    refused("has no split 'tset': it has train, val, test", lambda: open_tree(tree, "tset"))
    shutil.rmtree(tree / "2011_09_26" / VAL)
    data = config.Data(dataset="kitti", train_frames="all")
    refused("no frame to train on that has both", lambda: open_tree(tree, data=data))
    for look in (open_tree, check_kitti):
        refused("no such folder", lambda look=look: look(tmp_path / "nowhere"))
        refused("no day such as 2011_09_26 in it", lambda look=look: look(tmp_path))
    refused("no image in it; expected KITTI raw's layout", lambda: check_kitti(tree))


def test_no_labels_for_the_panoptic_task(tree):
    for number in (3, 4):
        file(tree, TRAIN, "label_02", number).unlink()
    message = (
        f"{file(tree, TRAIN, 'label_02', 3)}: missing, one of 2 label files .*"
        f"'mtl-bench pseudo-label --checkpoint CITYSCAPES_RUN --data {tree}'"
    )
    refused(message, lambda: open_tree(tree))


def test_a_damaged_file_in_the_middle_is_found_by_looking_deep(tree):
    path = file(tree, VAL, "image_02", 6)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    assert check_kitti(tree).problems == []
    assert "damaged PNG" in str(check_kitti(tree, deep=True).problems[0])


# --- data check -----------------------------------------------------------------------------------


def call(*words, code=0):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


@needs_real
def test_check_describes_the_real_sample():
    lines = call("data", "check", REAL, "--deep").splitlines()
    assert lines == [
        f"{REAL}: KITTI raw",
        "days: 1, drives: 1, left images: 10, right images: 0, scans: 2, "
        "improved depth maps: 0, label files: 0",
        "2011_09_26: 10 images of 375x1242 pixels, focal length 721.54, baseline 0.5327 m",
        "train: 0 of the published 39810 frames; 0 with both neighbours",
        "val: 0 of the published 4424 frames",
        "test: 4 of the published 697 frames; 0 of 652 improved depth maps, 2 of 697 scans",
        "all with both neighbours, but val's and test's: 6 frames",
        "recipe kitti, panoptic: no frame to train on; recipe.data.train_frames=all has 6",
        "recipe kitti, depth: no frame to train on; recipe.data.train_frames=all has 6",
    ]


def test_check_of_a_tree(tree):
    lines = call("data", "check", tree).splitlines()
    assert "test: 5 of the published 697 frames; 2 of 652 improved depth maps, 5 of 697 scans" in (
        lines
    )
    assert "train: 5 of the published 39810 frames; 3 with both neighbours" in lines
    assert lines[-2:] == ["recipe kitti, panoptic: ready", "recipe kitti, depth: ready"]
    shutil.rmtree(tree / "2011_09_26" / TRAIN / "label_02")
    shutil.rmtree(tree.parent / "data_depth_annotated")
    lines = call("data", "check", tree).splitlines()
    assert lines[-2].startswith("recipe kitti, panoptic: 3 training frames have no labels; make")
    assert lines[-1] == (
        "recipe kitti, depth: no test frame has improved maps; unpack data_depth_annotated.zip "
        "into it or beside it, or measure on the velodyne maps that 5 frames have: "
        "--set recipe.evaluate.protocol=eigen-raw --set recipe.evaluate.also=[]"
    )
    for path in (tree / "2011_09_26" / VAL / "velodyne_points" / "data").iterdir():
        path.write_bytes(b"x")
    lines = call("data", "check", tree, "--deep", code=1).splitlines()
    assert "3 bad scans" in lines
    for path in (tree / "2011_09_26" / TRAIN / "velodyne_points" / "data").iterdir():
        path.write_bytes(b"x")
    lines = call("data", "check", tree, "--deep", code=1).splitlines()
    assert "8 bad scans" in lines
    assert "  and 5 more" in lines


# --- pseudo labels --------------------------------------------------------------------------------


def cell_of(recipe="kitti-smoke", tasks=(), dataset="kitti", **data):
    base = load_recipe(recipe)
    changed = replace(base, data=replace(base.data, dataset=dataset, **data))
    return Cell(changed, "tiny", "fixed_uncertainty", tasks=tasks)


def execute(cell, runs, root):
    with locks.claim(store.run_dir(cell, runs)):
        directory, _ = store.begin(cell, runs)
        return run_cell(cell, directory, root, "cpu", echo=lambda line: None)


@pytest.fixture(scope="module")
def teacher(smoke_root, tmp_path_factory):
    """The run of a cell that was trained in Cityscapes' layout, with 20 classes."""
    cell = Cell(load_recipe("smoke"), "tiny", "fixed_uncertainty", tasks=("panoptic",))
    runs = tmp_path_factory.mktemp("teacher")
    execute(cell, runs, smoke_root)
    return store.run_dir(cell, runs)


def test_a_cityscapes_cell_labels_kitti(tree, teacher):
    for drive in (TRAIN, TEST, OTHER_DAY):
        shutil.rmtree(tree / drive[:10] / drive / "label_02")
    words = ("pseudo-label", "--checkpoint", teacher, "--data", tree)
    assert f"5 frames written, 0 there already: {tree}" in call(*words)
    record = json.loads((tree / kitti_files.RECORD).read_text())
    assert (record["labels"], record["input"]) == ("cityscapes20", "the frames' own size")
    path = file(tree, TRAIN, "label_02", 4)
    ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert (ids.dtype, ids.shape) == (np.uint16, (16, 48))
    assert len(open_tree(tree)) == 3

    before = path.read_bytes()
    path.unlink()
    assert "1 frames written, 4 there already" in call(*words)
    assert path.read_bytes() == before
    assert "5 frames written, 0 there already" in call(*words, "--split", "test")
    assert file(tree, OTHER_DAY, "label_02", 6).is_file()
    assert "made with other flip" in call(*words, "--no-flip", code=2)
    assert "3 frames written, 10 there already" in call(*words, "--split", "all")
    assert len(list(tree.glob("*/*/label_02/data/*.png"))) == 13


def test_the_ego_vehicle_is_left_unlabeled(tree, teacher, monkeypatch):
    shutil.rmtree(tree / "2011_09_26" / TRAIN / "label_02")
    out = tree.parent / "labels"
    halves = np.where(np.arange(48) < 24, 1, 26001).astype(np.uint16)
    monkeypatch.setattr(
        pseudo_labels, "instance_ids", lambda *given: np.broadcast_to(halves, (1, 16, 48))
    )
    call("pseudo-label", "--checkpoint", teacher, "--data", tree, "--out", out, "-q")
    ids = cv2.imread(str(file(out, TRAIN, "label_02", 3)), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(ids[0], np.where(halves == 1, 0, halves))
    assert not (tree / "2011_09_26" / TRAIN / "label_02").exists()


def test_what_cannot_be_labelled(tree, teacher):
    words = ("pseudo-label", "--checkpoint", teacher, "--data", tree)
    assert "not of this command's making" in call(*words, code=2).replace("\n", " ")
    for path in tree.glob("*/*/label_02"):
        shutil.rmtree(path)
    shutil.rmtree(tree / "2011_09_26" / TRAIN)
    assert "'--split all' labels every frame" in call(*words, code=2).replace("\n", " ")


def test_the_video_stage_needs_a_data_set_that_takes_its_labels(tree):
    video = replace(cell_of(height=HEIGHT, width=WIDTH), video=True)
    refused(
        "video .* kitti takes no further labels; set video=false",
        lambda: execute(video, tree / "runs", tree),
    )
    assert not list((tree / "runs").rglob("*.png"))


# --- whole cells ----------------------------------------------------------------------------------


def test_the_command_line_tells_layouts_apart(tree, smoke_root, teacher):
    words = ("--backbone", "tiny", "--method", "fixed_uncertainty", "--runs", tree / "runs")
    output = call("train", "--recipe", "kitti-smoke", "--data", smoke_root, *words, code=2)
    assert "is in Cityscapes's layout, but recipe 'kitti-smoke'" in output.replace("\n", " ")
    output = call("train", "--recipe", "smoke", "--data", tree, *words, code=2)
    assert "is in KITTI raw's layout, but recipe 'smoke'" in output.replace("\n", " ")


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """The real sample with what it lacks: improved maps, here the scans' own points."""
    root = tmp_path_factory.mktemp("real") / "kitti"
    shutil.copytree(REAL, root, copy_function=os.symlink)
    dataset = open_tree(REAL, "test")
    for index, number in enumerate((3, 6)):
        depth_m = dataset.sample(index, None).fields["depth_m"].numpy()
        put_png(improved(root, TEST, number), (depth_m * 256).round().astype(np.uint16))
    return root


@needs_real
def test_a_cell_on_the_real_sample_with_both_protocols(real, teacher, tmp_path):
    """Labels from a Cityscapes cell, training on them, and Eigen's frames by improved maps and by
    scans, which here hold the same depth."""
    words = ("--split", "all", "--scales", "0.25", "--no-flip", "-q")
    call("pseudo-label", "--checkpoint", teacher, "--data", real, *words)
    cell = cell_of(train_frames="all")
    assert cell.recipe.evaluate.protocol == "eigen-improved"
    row = execute(cell, tmp_path / "runs", real)
    metric, protocol = row["metric"], row["protocol"]
    for key in ("eigen-improved-crop", "eigen-raw"):
        assert protocol["also"][key]["frames"] == 2
    assert metric["eigen-raw.depth_median.abs_rel"] == pytest.approx(
        metric["eigen-improved-crop.depth_median.abs_rel"], rel=1e-3
    )
    assert 0 < metric["depth_median.abs_rel"] < 2
    assert not [key for key in metric if key.startswith("panoptic.")]
    assert protocol["training"]["frames"] == 6
    assert protocol["reprojection_mask"] == "labels"
    assert protocol["compared_at"] == [375, 1242]


def test_what_would_stop_the_evaluation_is_told_before_the_training(tree, tmp_path):
    shutil.rmtree(tree.parent / "data_depth_annotated")
    cell = cell_of(height=HEIGHT, width=WIDTH)
    with pytest.raises(
        ValueError, match=r"none of its 5 frames of test has a depth map \(improved"
    ):
        execute(cell, tmp_path / "runs", tree)
    assert not list((tmp_path / "runs").rglob("last.pt"))
