"""Point clouds: the built-in scene's own geometry comes out of the files again."""

import errno
from pathlib import Path

import numpy as np
import pytest

from mtl_bench.data import cityscapes_files as files
from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.data.synthetic.files import write_scene
from mtl_bench.data.synthetic.settings import Settings
from mtl_bench.show import predict
from mtl_bench.show.predict import Predicted
from mtl_bench.show.predict.point_cloud import from_maps, from_prediction, write_npz, write_ply

ROAD, CAR, SKY, EGO = 7, 26, 23, 1


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    """Image, depth, ids and camera of a built-in frame, read as any Cityscapes frame is."""
    root = tmp_path_factory.mktemp("scene")
    settings = Settings(64, 128, 0, 4, 0, seed=0, frames=3, annotated=1, min_instance_area=12)
    write_scene(root, settings, 1, 2)
    (name,) = files.annotated_names(root, "val")

    def path(kind: files.Kind) -> Path:
        return files.file_of(root / kind.folder / "val", kind, name)

    camera = files.read_camera(path(files.CAMERA))
    ids = files.read_instance_ids(path(files.LABELS)).astype(np.int32)
    depth_m = files.read_depth_m(path(files.DISPARITY), camera)
    return files.read_image(path(files.IMAGE)), depth_m, ids, camera


def matrix(camera):
    return np.array([[camera.fx, 0, camera.u0], [0, camera.fy, camera.v0], [0, 0, 1]])


@pytest.fixture(scope="module")
def vertices(frame, tmp_path_factory):
    """What somebody else's reader finds in the file."""
    plyfile = pytest.importorskip("plyfile")
    image, depth_m, ids, camera = frame
    cloud = from_maps(image, depth_m, ids, matrix(camera), CITYSCAPES20, predict.METRES)
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(path, cloud, CITYSCAPES20)
    data = plyfile.PlyData.read(str(path))
    assert not data.text
    assert data.byte_order == "<"
    assert "unit of x y z: m" in data.comments
    assert any("x right, y down, z forward" in comment for comment in data.comments)
    return data["vertex"].data


def test_the_road_lies_at_the_cameras_height(frame, vertices):
    camera = frame[3]
    road = vertices[(vertices["class"] == ROAD) & (vertices["z"] < 30)]
    assert len(road) > 1000
    assert road["z"].max() > 20
    # The camera looks down by its pitch: turned back, y is the height below it
    level = np.cos(camera.pitch_rad) * road["y"] + np.sin(camera.pitch_rad) * road["z"]
    assert np.abs(level - camera.height_m).max() < 0.01
    assert np.abs(road["y"] - camera.height_m).max() > 0.05, "the pitch matters here"


def test_every_point_is_the_one_that_its_pixel_sees(frame, vertices):
    image, depth_m, ids, camera = frame
    u = np.rint(vertices["x"] / vertices["z"] * camera.fx + camera.u0).astype(int)
    v = np.rint(vertices["y"] / vertices["z"] * camera.fy + camera.v0).astype(int)
    assert np.allclose(vertices["z"], depth_m[v, u], rtol=1e-6)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], 1)
    assert (colors == image[v, u]).all()
    true = ids[v, u]
    assert (vertices["class"] == np.where(true < 1000, true, true // 1000)).all()
    assert (vertices["instance"] == np.where(true < 1000, 0, true)).all()
    assert (vertices["instance"] > 0).any()
    pixels = set(zip(v.tolist(), u.tolist(), strict=True))
    valid = (depth_m > 0) & ~np.isin(ids, (SKY, EGO))
    assert pixels == set(zip(*map(np.ndarray.tolist, np.nonzero(valid)), strict=True))


def test_sky_ego_vehicle_and_invalid_depth_are_left_out():
    ids = np.array([[ROAD, SKY, EGO, 26003, 0, ROAD, ROAD]])
    depth = np.array([[4.0, 900, 2, 8, 5, 0, np.nan]])
    image = np.arange(21, dtype=np.uint8).reshape(1, 7, 3)
    K = np.array([[10.0, 0, 3], [0, 20, 0], [0, 0, 1]])
    cloud = from_maps(image, depth, ids, K, CITYSCAPES20, predict.METRES)
    assert cloud.class_N.tolist() == [ROAD, CAR, 0]
    assert cloud.instance_N.tolist() == [0, 26003, 0]
    assert cloud.ids_N.tolist() == [ROAD, 26003, 0]
    assert np.allclose(cloud.points_N3, [[-1.2, 0, 4], [0, 0, 8], [0.5, 0, 5]])
    assert cloud.colors_N3.tolist() == image[0, [0, 3, 4]].tolist()
    kitti = from_maps(image, depth, ids, K, CITYSCAPES19, predict.METRES)
    assert kitti.class_N.tolist() == [ROAD, EGO, CAR, 0], "a label set without ego vehicle"


def test_arrays_hold_what_the_ply_file_holds(frame, vertices, tmp_path):
    image, depth_m, ids, camera = frame
    cloud = from_maps(image, depth_m, ids, matrix(camera), CITYSCAPES20, predict.METRES)
    write_npz(tmp_path / "cloud.npz", cloud)
    with np.load(tmp_path / "cloud.npz", allow_pickle=False) as data:
        assert (data["points"] == np.stack([vertices[name] for name in "xyz"], 1)).all()
        assert (data["classes"] == vertices["class"]).all()
        assert (data["instances"] == vertices["instance"]).all()
        assert data["colors"].dtype == np.uint8
        assert str(data["unit"]) == "m"


def test_a_cloud_takes_depth():
    image, K = np.zeros((2, 3, 3), np.uint8), np.eye(3)
    without = Predicted(image, K, np.full((2, 3), 7, np.int32), None, None, None, None, None)
    with pytest.raises(ValueError, match="no depth is predicted"):
        from_prediction(without, CITYSCAPES20)
    depth = np.ones((2, 3), np.float32)
    alone = Predicted(image, K, None, None, depth, predict.HEIGHTS, "normals", 1.0)
    cloud = from_prediction(alone, CITYSCAPES20)
    assert (cloud.class_N == 0).all()
    assert len(cloud) == 6
    assert cloud.unit == predict.HEIGHTS


def test_a_full_disk_leaves_no_file(frame, tmp_path, monkeypatch):
    image, depth_m, ids, camera = frame
    cloud = from_maps(image, depth_m, ids, matrix(camera), CITYSCAPES20, predict.METRES)
    whole = Path.write_bytes

    def full(path, data):
        whole(path, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_ply(tmp_path / "cloud.ply", cloud, CITYSCAPES20)
    assert not list(tmp_path.iterdir())
