"""What `mtl-bench predict` is given: cut files, links, litter, odd names, odd videos."""

import json
import os

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core.config import Cell, load_recipe, to_dict
from mtl_bench.core.files import write_json
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import pictures, video
from mtl_bench.model import build_model
from mtl_bench.show.predict import job as predictions

PHOTO = cv2.GaussianBlur(
    np.random.default_rng(0).integers(0, 255, (48, 80, 3)).astype(np.uint8), (0, 0), 2
)
KINDS = ("png", "jpg", "bmp", "tif", "webp", "ppm", "jp2")


def encoded(kind: str) -> bytes:
    return cv2.imencode(f".{kind}", PHOTO)[1].tobytes()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder with an untrained network of one task."""
    torch.manual_seed(0)
    cell = Cell(load_recipe("smoke"), backbone="tiny", method="fixed", tasks=("depth",))
    folder = tmp_path_factory.mktemp("runs") / "depth"
    folder.mkdir()
    write_json(folder / "cell.json", to_dict(cell))
    state = {"format": 1, "model": build_model(cell, tasks_of_cell(cell)).state_dict()}
    torch.save(state, folder / "last.pt")
    return folder


def predict(run, *words):
    words = ["predict", "--checkpoint", run, "--what", "depth", "-q", *words]
    return CliRunner().invoke(app, [str(word) for word in words])


# --- whole or not at all --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_that_was_cut_off_is_refused_by_name(tmp_path, kind):
    path, data = tmp_path / f"a.{kind}", encoded(kind)
    path.write_bytes(data)
    assert pictures.is_image(path)
    assert (pictures.read(path) == cv2.imread(str(path))[..., ::-1]).all()
    header = pictures.read_header(path)
    assert (header.height, header.width, header.bits) == (48, 80, 8)
    for share in (0.2, 0.5, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ValueError, match=rf"{path}: (truncated|not an image)"):
            pictures.read(path)


def test_images_of_more_than_eight_bits_are_read_as_before(tmp_path):
    for name in ("a.tif", "a.png"):
        path = tmp_path / name
        assert cv2.imwrite(str(path), PHOTO.astype(np.uint16) * 256)
        assert (pictures.read(path) == cv2.imread(str(path))[..., ::-1]).all()
    with pytest.raises(ValueError, match="16-bit PNG where 8 bits"):
        pictures.read(tmp_path / "a.png", bits=8)


def test_one_bad_image_does_not_cost_the_others(run, tmp_path):
    folder, out = tmp_path / "images", tmp_path / "out"
    folder.mkdir()
    for name in "abc":
        (folder / f"{name}.jpg").write_bytes(encoded("jpg"))
    (folder / "b.jpg").write_bytes(encoded("jpg")[:900])
    (folder / "d.png").write_text("no picture")
    result = predict(run, folder, "--out", out)
    assert result.exit_code == 1
    assert result.stderr.splitlines() == [
        line for line in result.stderr.splitlines() if line.startswith("not predicted: ")
    ]
    record = json.loads((out / "prediction.json").read_text())
    assert [image["name"] for image in record["images"]] == ["a", "c"]
    assert [failure["input"] for failure in record["failed"]] == [
        str(folder / "b.jpg"),
        str(folder / "d.png"),
    ]
    assert "b.jpg: truncated or damaged image" in result.stderr
    assert {p.name for p in out.glob("*_depth.png")} == {"a_depth.png", "c_depth.png"}
    for name in "ac":
        (folder / f"{name}.jpg").unlink()
    result = predict(run, folder, "--out", tmp_path / "none")
    assert result.exit_code == 2
    assert "(2 images, and none can be predicted)" in result.stderr
    assert not (tmp_path / "none").exists()


# --- names and folders ----------------------------------------------------------------------------


def test_links_to_folders_are_followed_once(tmp_path):
    inside, pool = tmp_path / "in", tmp_path / "pool"
    (inside / "deep").mkdir(parents=True)
    pool.mkdir()
    for path in (inside / "a.png", pool / "b.png", pool / "c.JPG"):
        path.write_bytes(encoded("png"))
    (inside / "linked").symlink_to(pool)
    (inside / "twice").symlink_to(pool)
    (inside / "deep" / "circle").symlink_to(inside)
    (pool / "back").symlink_to(tmp_path / "in")
    found = predictions.find([str(inside)])
    assert found == [inside / "a.png", inside / "linked/b.png", inside / "linked/c.JPG"]
    assert predictions.stems_of(found) == ["a", "linked/b", "linked/c"]


def test_what_operating_systems_leave_behind_is_no_image(tmp_path):
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "a.png").write_bytes(encoded("png"))
    for name in ("._a.png", ".DS_Store", "Thumbs.db", "__MACOSX/a.png"):
        (tmp_path / name).write_bytes(b"\0\5\x16\7")
    assert predictions.find([str(tmp_path)]) == [tmp_path / "a.png"]
    assert predictions.find([f"{tmp_path}/*"]) == [tmp_path / "a.png"]
    assert predictions.find([f"{tmp_path}/*.png"]) == [tmp_path / "a.png"]


def test_a_folder_that_cannot_be_listed_is_told(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(encoded("png"))

    def closed(path):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os, "scandir", closed)
    with pytest.raises(ValueError, match=r"cannot be listed \(Permission denied\)"):
        predictions.find([str(tmp_path)])


def test_names_that_are_not_utf_8(run, tmp_path):
    """OpenCV used to end the process at them."""
    folder = tmp_path / "caf\udce9"
    folder.mkdir()
    (folder / "a\udcff.png").write_bytes(encoded("png"))
    (folder / "b\udcff.mp4").write_bytes(b"no video")
    result = predict(run, folder, "--out", folder / "out")
    assert result.exit_code == 0, result.output
    assert (folder / "out/a\udcff_depth.png").is_file()
    for read_or_write in (video.Reader, lambda path: video.Writer(path, 10.0)):
        with pytest.raises(ValueError, match=r"b.xff.mp4': .*is not UTF-8; rename it"):
            read_or_write(folder / "b\udcff.mp4")
    pytest.importorskip("rerun")
    result = predict(run, folder, "--out", tmp_path / "c", "--rerun", folder / "c.rrd")
    assert result.exit_code == 2
    assert "Rerun reads and writes no file whose name is not UTF-8" in result.stderr
    assert not (tmp_path / "c").exists()


# --- videos ---------------------------------------------------------------------------------------


def write_video(path, fps, frames=5):
    with video.Writer(path, fps) as writer:
        for number in range(frames):
            writer.write(np.full_like(PHOTO, 20 * number))
    return path


@pytest.mark.parametrize("fps", [65.536, 70.123, 119.88012, 1000.5, 7000.77, 90000, 0.001, 29.97])
def test_every_frame_rate_can_be_written(tmp_path, fps):
    found = video.Reader(write_video(tmp_path / "a.mp4", fps))
    assert found.frames == 5
    assert found.fps == pytest.approx(min(max(fps, 0.01), 65535), rel=1e-3)


def test_a_video_that_ends_early_is_told(run, tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mp4", 10.0)
    monkeypatch.setattr(predictions, "Reader", short := type("Short", (video.Reader,), {}))
    short.__iter__ = lambda self: iter([PHOTO] * 3)
    result = predict(run, path, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "3 of 5 frames can be decoded; is the file whole?" in result.stderr
    assert json.loads((tmp_path / "out/prediction.json").read_text())["frames"] == 3
