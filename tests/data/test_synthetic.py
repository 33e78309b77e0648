"""The built-in data set: exact geometry, Cityscapes' formats, determinism, no half-written set."""

import hashlib
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtl_bench.core.config import Data
from mtl_bench.data import scenes as synthetic
from mtl_bench.data.labels import CITYSCAPES20, KNOWN_LABEL_IDS
from mtl_bench.data.scenes import render
from mtl_bench.data.scenes.cityscapes import BASELINE_M, encode_disparity
from mtl_bench.data.scenes.rays import context_from_target

HEIGHT, WIDTH = 64, 128


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "set"
    return synthetic.write(out, HEIGHT, WIDTH, 14, 14, 2, seed=3, progress=False)


def digests(root: Path) -> dict[str, str]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


# --- geometry -------------------------------------------------------------------------------------


def bilinear(image, u, v):
    u0, v0 = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = (u - u0)[..., None], (v - v0)[..., None]
    top = image[v0, u0] * (1 - a) + image[v0, u0 + 1] * a
    return top * (1 - b) + (image[v0 + 1, u0] * (1 - a) + image[v0 + 1, u0 + 1] * a) * b


def interior(scene, frame, seen):
    """Key of the surface [H,W] that a pixel sees, and where all eight neighbours see it too.

    A silhouette's pixel mixes two surfaces that move differently: no one depth warps it.
    """
    height, width = seen.index_HW.shape
    u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    depth = np.where(seen.depth_HW > 0, seen.depth_HW, 1)
    key = seen.index_HW * 4 + render._faces(scene, frame, u, v, seen.index_HW, depth)
    padded = np.pad(key, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return key, (windows == key[..., None, None]).all((2, 3))


def warp_error(scene, frame, step):
    """Sums of |warped neighbour - now| and |neighbour - now| over static surfaces, their pixels."""
    camera = scene.camera
    height, width = camera.height, camera.width
    now, later = (render.image(scene, i) / 255 for i in (frame, frame + step))
    seen, seen_later = (render.truth(scene, i) for i in (frame, frame + step))
    T = context_from_target(scene.motion.poses[frame], scene.motion.poses[frame + step])
    v, u = np.mgrid[:height, :width].astype(float)
    z = seen.depth_HW.astype(float)
    points = np.stack([(u - camera.u0) / camera.fx * z, (v - camera.v0) / camera.fy * z, z], -1)
    points = points @ T[:3, :3].T + T[:3, 3]
    z_later = np.where(z > 0, points[..., 2], 1)
    u_later = points[..., 0] / z_later * camera.fx + camera.u0
    v_later = points[..., 1] / z_later * camera.fy + camera.v0
    inside = (u_later >= 0) & (u_later < width - 1) & (v_later >= 0) & (v_later < height - 1)
    u_later, v_later = np.where(inside, u_later, 0), np.where(inside, v_later, 0)
    key, inner = interior(scene, frame, seen)
    key_later, inner_later = interior(scene, frame + step, seen_later)
    moving = np.abs(scene.solids.velocity_P3[seen.index_HW]).sum(-1) > 0  # or sky, without depth
    static = inside & inner & (seen.depth_HW > 0) & ~moving
    u0, v0 = np.floor(u_later).astype(int), np.floor(v_later).astype(int)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):  # the same surface, not one that occludes it
        there = v0 + i, u0 + j
        static &= (key_later[there] == key) & inner_later[there]
    warped = np.abs(bilinear(later, u_later, v_later) - now).mean(-1)[static]
    return warped.sum(), np.abs(later - now).mean(-1)[static].sum(), static.sum()


@pytest.mark.parametrize(("height", "width", "scenes"), [(64, 128, 12), (256, 512, 2)])
def test_true_depth_and_motion_warp_the_next_frame(height, width, scenes):
    streets = (render.draw_scene((0, 1, i), height, width, 3, 1) for i in range(scenes))
    sums = np.array([warp_error(street, 1, 1) for street in streets]).sum(0)
    assert sums[2] > 0.3 * scenes * height * width
    assert sums[1] / sums[2] > 0.015  # there is something to see
    assert sums[0] <= 0.1 * sums[1]


@pytest.mark.parametrize(
    ("frame", "stride"), [(2, 1), (3, 1), (4, 1), (5, 1), (6, 1), (3, 3), (4, 3), (5, 3)]
)
@pytest.mark.parametrize("side", [-1, 1])
def test_frames_without_labels_warp_as_well_as_the_annotated_one(frame, stride, side):
    """The video stage trains on them: nine frames share one texture filter."""
    streets = [render.draw_scene((0, 1, i), HEIGHT, WIDTH, 9, 4) for i in range(6)]
    sums = np.array([warp_error(street, frame, side * stride) for street in streets]).sum(0)
    assert sums[1] / sums[2] > 0.015
    assert sums[0] <= 0.1 * sums[1]


def test_one_street_at_every_size():
    small, large = (
        render.truth(render.draw_scene((5, 0, 2), h, 2 * h, 3, 1), 1) for h in (64, 128)
    )
    same = small.label_HW == large.label_HW[::2, ::2]
    assert same.mean() > 0.9


def test_the_bonnet_stays_where_it_is_and_has_no_depth():
    scene = render.draw_scene((5, 0, 1), HEIGHT, WIDTH, 3, 1)
    masks = [render.truth(scene, frame).label_HW == render.EGO for frame in range(3)]
    assert masks[0].any()
    assert (masks[0] == masks[1]).all()
    assert (masks[1] == masks[2]).all()
    assert (render.truth(scene, 1).depth_HW[masks[1]] == 0).all()


def test_small_things_become_groups():
    scene = render.draw_scene((0, 1, 0), HEIGHT, WIDTH, 3, 1)
    seen = render.truth(scene, 1)
    for least in (1, 12, 100):
        ids, counts = np.unique(render.instance_ids(seen, least), return_counts=True)
        assert counts[ids >= 1000].min() >= least
    things = {label.label_id for label in CITYSCAPES20.labels if label.is_thing}
    assert things & set(ids[ids < 1000].tolist())


def test_disparity_round_trip():
    depth = np.linspace(2, 80, 2000, dtype=np.float32)
    fx = 0.86 * WIDTH
    stored = encode_disparity(np.append(depth, 0), fx)
    assert stored[-1] == 0
    back = BASELINE_M * fx / ((stored[:-1] - 1) / 256)
    assert np.abs(back / depth - 1).max() < 0.02


# --- files ----------------------------------------------------------------------------------------


def test_every_class_is_there(root):
    for split in ("train", "val"):
        paths = sorted(root.glob(f"gtFine/{split}/*/*_labelIds.png"))
        present = set(np.unique([read(path) for path in paths]).tolist())
        assert {label.label_id for label in CITYSCAPES20.labels} <= present <= KNOWN_LABEL_IDS


def test_files_agree_with_each_other(root):
    for split, count in (("train", 14), ("val", 14), ("test", 2)):
        images = sorted(root.glob(f"leftImg8bit/{split}/*/*_leftImg8bit.png"))
        assert len(images) == count
        for path in images:
            city, stem = path.parent.name, path.name.removesuffix("_leftImg8bit.png")

            def file(kind, ending, folder=f"{split}/{city}", stem=stem):
                return root / kind / folder / f"{stem}_{ending}"

            assert path.read_bytes() == file("leftImg8bit_sequence", "leftImg8bit.png").read_bytes()
            ids = read(file("gtFine", "gtFine_instanceIds.png"))
            labels = read(file("gtFine", "gtFine_labelIds.png"))
            disparity = read(file("disparity", "disparity.png"))
            assert (ids.dtype, labels.dtype, disparity.dtype) == (np.uint16, np.uint8, np.uint16)
            assert (np.where(ids < 1000, ids, ids // 1000) == labels).all()
            assert (disparity[np.isin(labels, (render.SKY, render.EGO))] == 0).all()
            camera = json.loads(file("camera", "camera.json").read_text())
            assert 1.2 <= camera["extrinsic"]["z"] <= 1.6
            speed = json.loads(file("vehicle", "vehicle.json").read_text())["speed"]
            moved = np.array(json.loads(file("egomotion", "egomotion.json").read_text())["next"])
            assert -moved[2, 3] * 17 == pytest.approx(speed, rel=0.1)
    assert len(list(root.glob("leftImg8bit_sequence/val/*/*.png"))) == 42


def test_road_depth_follows_from_camera_height(root):
    """Triangulating the written disparity puts the road at the written camera height."""
    path = min(root.glob("gtFine/val/*/*_labelIds.png"))
    road = read(path) == 7
    stem = path.name.removesuffix("gtFine_labelIds.png")
    camera = json.loads((root / "camera/val" / path.parent.name / f"{stem}camera.json").read_text())
    disparity = read(root / "disparity/val" / path.parent.name / f"{stem}disparity.png")
    inside, outside = camera["intrinsic"], camera["extrinsic"]
    v, _ = np.nonzero(road)
    z = outside["baseline"] * inside["fx"] / ((disparity[road].astype(float) - 1) / 256)
    y = (v - inside["v0"]) / inside["fy"] * z
    height = y * np.cos(outside["pitch"]) + z * np.sin(outside["pitch"])
    assert np.median(height) == pytest.approx(outside["z"], abs=0.02)


def test_panoptic_files_are_the_official_converters(root, tmp_path, capsys):
    from cityscapesscripts.preparation.createPanopticImgs import convert2panoptic

    convert2panoptic(str(root / "gtFine"), str(tmp_path), False, ["train", "val", "test"])
    for split in ("train", "val", "test"):
        name = f"cityscapes_panoptic_{split}"
        own, official = root / "gtFine" / f"{name}.json", tmp_path / f"{name}.json"
        assert json.loads(own.read_text()) == json.loads(official.read_text())
        pictures = sorted((tmp_path / name).iterdir())
        assert [p.name for p in pictures] == sorted(
            p.name for p in (root / "gtFine" / name).iterdir()
        )
        for picture in pictures:
            assert (read(picture) == read(root / "gtFine" / name / picture.name)).all()


def test_bytes_do_not_depend_on_processes(tmp_path):
    for processes in (1, 2):
        synthetic.write(
            tmp_path / str(processes), 32, 64, 3, 1, 1, processes=processes, progress=False
        )
    one = digests(tmp_path / "1")
    assert len(one) > 50
    assert one == digests(tmp_path / "2")
    other = synthetic.write(
        tmp_path / "other", 32, 64, 3, 1, 1, seed=1, processes=1, progress=False
    )
    changed = [name for name, digest in digests(other).items() if one[name] != digest]
    assert any(name.startswith("leftImg8bit/train") for name in changed)


def test_long_snippets_have_the_labels_where_cityscapes_has_them(tmp_path):
    out = synthetic.write(tmp_path / "long", 16, 32, 1, 0, 0, frames=30, progress=False)
    names = sorted(p.name for p in out.glob("leftImg8bit_sequence/train/*/*.png"))
    assert [name.split("_")[2] for name in names] == [f"{i:06d}" for i in range(30)]
    assert [p.name.split("_")[2] for p in out.glob("gtFine/train/*/*labelIds.png")] == ["000019"]


def test_a_recipe_chooses_the_length_of_the_snippets(tmp_path):
    """Labels, disparity and camera belong to the middle frame alone, the images to all."""
    data = Data(height=16, width=32, train_scenes=2, val_scenes=1)
    folders = {
        frames: synthetic.ensure(replace(data, frames=frames), tmp_path, progress=False)
        for frames in (3, 4, 7)
    }
    assert len(set(folders.values())) == 3
    for frames, out in folders.items():
        for split, scenes in (("train", 2), ("val", 1), ("test", 8)):
            video = sorted(out.glob(f"leftImg8bit_sequence/{split}/*/*.png"))
            assert len(video) == scenes * frames
            for kind in ("leftImg8bit", "gtFine", "disparity", "camera", "vehicle", "egomotion"):
                found = {p.name.split("_")[2] for p in out.glob(f"{kind}/{split}/*/*")}
                assert found == {f"{frames // 2:06d}"}
    for frames in (1, 2):
        with pytest.raises(ValueError, match=rf"recipe\.data\.frames = {frames}, but") as error:
            synthetic.ensure(replace(data, frames=frames), tmp_path)
        assert "\n" not in str(error.value)


def test_a_killed_run_leaves_no_data_set(tmp_path):
    out = tmp_path / "set"
    code = (
        "import pathlib, sys; from mtl_bench.data import scenes as synthetic;"
        "synthetic.write(pathlib.Path(sys.argv[1]), 32, 64, 500, 1, 0, progress=False)"
    )
    child = subprocess.Popen([sys.executable, "-c", code, str(out)])
    deadline = time.monotonic() + 60
    while not any(tmp_path.glob("set.partial-*/gtFine/*/*/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    child.kill()
    child.wait()
    assert any(tmp_path.glob("set.partial-*"))
    assert not out.exists()
    time.sleep(1)  # its workers end with the scene at hand
    synthetic.write(out, 32, 64, 1, 0, 0, processes=1, progress=False)
    assert not any(tmp_path.glob("set.partial-*"))
    assert len(list(out.glob("leftImg8bit/*/*/*.png"))) == 1


def test_ensure_renders_once(tmp_path, capfd):
    data = Data(height=16, width=32, train_scenes=1, val_scenes=1)
    out = synthetic.ensure(data, tmp_path)
    assert "10/10 scenes" in capfd.readouterr().err
    before = digests(out)
    assert synthetic.ensure(data, tmp_path) == out
    assert capfd.readouterr().err == ""
    assert digests(out) == before
    other = synthetic.ensure(replace(data, seed=1), tmp_path, progress=False)
    assert other != out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 8}, "8x64 is too small"),
        ({"annotated": 3}, "annotated frame 3 is not among 3 frames"),
        ({"train_scenes": 0, "val_scenes": 0, "test_scenes": 0}, "scenes; give counts"),
    ],
)
def test_wrong_settings_are_named(tmp_path, change, message):
    settings = {"height": 32, "width": 64, "train_scenes": 1, "val_scenes": 0, **change}
    with pytest.raises(ValueError, match=message):
        synthetic.write(tmp_path / "x", **settings, progress=False)


def test_an_existing_folder_is_left_alone(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(ValueError, match="exists already"):
        synthetic.write(tmp_path, 32, 64, 1, 0, 0, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]
