"""Trees as users have them: litter between the frames, JPEG files, packages that are not needed."""

import shutil

import cityscapes_tree
import cv2
import kitti_tree
import numpy as np
import pytest
import torch
from kitti_tree import OTHER_DAY, TEST, TRAIN

from mtl_bench.core.config import Cell, load_recipe
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import cameras, cityscapes_files
from mtl_bench.data.check import check
from mtl_bench.data.check_kitti import check_kitti
from mtl_bench.evaluate.walk import evaluate
from mtl_bench.model import build_model

LITTER = b"\0\5\x16\7 Mac OS X"


@pytest.fixture
def city(tmp_path):
    return cityscapes_tree.write_tree(tmp_path / "cs")


@pytest.fixture
def kitti(tmp_path):
    return kitti_tree.write_tree(tmp_path / "kitti")


def as_jpeg(root, folder):
    """Convert a folder's frames, as monodepth2's users do."""
    for path in root.glob(f"**/{folder}/**/*.png"):
        image = cv2.imread(str(path))
        path.unlink()
        assert cv2.imwrite(str(path.with_suffix(".jpg")), image, [cv2.IMWRITE_JPEG_QUALITY, 92])


def first_of(samples):
    return samples.names, samples.sample(0, torch.Generator().manual_seed(0))


def assert_alike(one, other):
    for name, value in one.tensors().items():
        difference = (value.float() - other.tensors()[name].float()).abs().mean()
        assert difference < 0.3, name  # the images are noise, which JPEG keeps ill


# --- litter ---------------------------------------------------------------------------------------


def test_what_operating_systems_leave_behind_is_no_frame(city, kitti):
    plain = cityscapes_tree.open_tree(city).names, check(city).summary()
    of_kitti = kitti_tree.open_tree(kitti).names, check_kitti(kitti, deep=True).summary()
    for path in [*city.rglob("*"), *kitti.rglob("*")]:
        if path.is_file():
            path.with_name(f"._{path.name}").write_bytes(LITTER)
        else:
            (path / ".DS_Store").write_bytes(LITTER)
            (path / "Thumbs.db").write_bytes(LITTER)
            path.with_name(f"._{path.name}").mkdir()
    assert (cityscapes_tree.open_tree(city).names, check(city).summary()) == plain
    found = kitti_tree.open_tree(kitti).names, check_kitti(kitti, deep=True).summary()
    assert found == of_kitti
    image = next(iter(city.glob("leftImg8bit/train/*/[!.]*.png")))
    camera = cameras.of_layout(image, (cityscapes_tree.HEIGHT, cityscapes_tree.WIDTH))
    assert not camera.source.split("/")[-1].startswith(".")


# --- JPEG -----------------------------------------------------------------------------------------


def test_sequences_may_be_jpeg_files(city):
    names, one = first_of(cityscapes_tree.open_tree(city))
    for folder in ("leftImg8bit", "leftImg8bit_sequence"):
        as_jpeg(city, folder)
    same_names, other = first_of(cityscapes_tree.open_tree(city))
    assert same_names == names
    assert_alike(one, other)
    assert check(city, deep=True).problems == []
    path = next(iter(city.glob("leftImg8bit/train/*/*.jpg")))
    assert cameras.of_layout(path, (16, 32)) is not None
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match="truncated or damaged image"):
        cityscapes_files.read_image(path)


def test_kitti_frames_may_be_jpeg_files(kitti):
    names, one = first_of(kitti_tree.open_tree(kitti))
    for folder in ("image_02", "image_03"):
        as_jpeg(kitti, folder)
    jpeg = kitti_tree.open_tree(kitti)
    same_names, other = first_of(jpeg)
    assert same_names == names
    assert_alike(one, other)
    assert jpeg.dataset.sources()[0][0].suffix == ".jpg"
    report = check_kitti(kitti, deep=True)
    assert (report.problems, len(report.images)) == ([], 13)
    kitti_tree.put_png(kitti_tree.file(kitti, TRAIN, "image_02", 3), np.zeros((16, 48, 3)))
    assert jpeg.dataset.tree.image(jpeg.dataset._frames[jpeg.names[0]]).suffix == ".jpg"
    assert kitti_tree.open_tree(kitti).dataset.sources()[1][0].suffix == ".png", "the lossless one"


# --- what is not needed ---------------------------------------------------------------------------


def test_labels_alone_need_no_camera(city, kitti, tmp_path):
    shutil.rmtree(city / "camera")
    with pytest.raises(ValueError, match=r"camera\.json: missing, .* unpack camera_trainvaltest"):
        cityscapes_tree.open_tree(city)
    for root, module in ((city, cityscapes_tree), (kitti, kitti_tree)):
        for path in root.glob("*/calib_*.txt"):
            path.unlink()
        samples = module.open_tree(root, video=False)
        sample = samples.sample(0, torch.Generator().manual_seed(0))
        assert sample.camera.K_B33.isnan().all(), "nobody takes it for a camera's"
    with pytest.raises(ValueError, match=r"calib_cam_to_cam\.txt: missing"):
        kitti_tree.open_tree(kitti)
    report = check(city)
    assert report.obstacle("panoptic training") is None
    assert report.obstacle("depth training") == "no camera/train; unpack camera_trainvaltest.zip"


def test_a_panoptic_cell_is_evaluated_without_cameras(tmp_path):
    root = cityscapes_tree.write_tree(tmp_path / "cs", 2, "val", (32, 64))
    shutil.rmtree(root / "camera")
    cell = Cell(load_recipe("smoke"), backbone="tiny", method="fixed", tasks=("panoptic",))
    model = build_model(cell, tasks_of_cell(cell))
    metrics = evaluate(model, cell, root, torch.device("cpu")).metrics
    assert 0 <= metrics["panoptic.pq"] <= 1


def test_a_message_names_the_protocol_that_would_work(kitti):
    package = kitti.parent / "data_depth_annotated"
    scans = f"{kitti}: none of its 5 frames of test has a depth map"
    shutil.move(package / "val" / TEST, package / TEST)  # without the halves
    assert len(kitti_tree.open_tree(kitti, "test", truth="improved")) == 2
    shutil.rmtree(package)
    with pytest.raises(ValueError, match=scans) as error:
        kitti_tree.open_tree(kitti, "test", truth="improved")
    assert str(error.value).endswith(
        "(improved); unpack data_depth_annotated.zip into it or beside it, or measure on the "
        "velodyne maps that 5 frames have: --set recipe.evaluate.protocol=eigen-raw "
        "--set recipe.evaluate.also=[]"
    )
    for drive in (TEST, OTHER_DAY):
        shutil.rmtree(kitti / drive[:10] / drive / "velodyne_points")
    with pytest.raises(ValueError, match=r"\(velodyne\); unpack the drives' velodyne_points$"):
        kitti_tree.open_tree(kitti, "test", truth="velodyne")
