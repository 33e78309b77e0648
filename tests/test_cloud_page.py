"""The 3D page: opens offline in a browser, shows the right colours, and stays small."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.show.figures import Shown, cloud_page
from mtl_bench.show.figures.cloud_page import POINTS, leveled, page_of, thinned
from mtl_bench.show.predict import Predicted
from mtl_bench.show.predict.cameras import Mounted
from mtl_bench.show.predict.point_cloud import PointCloud

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
RED, BLUE, CAR, TREE = (220, 0, 0), (0, 0, 220), (0, 0, 142), (107, 142, 35)
ABOUT = {"name": "two", "run": "r", "notes": "n", "height": 1.5, "pitch": 0.0, "pixel": 0.02}


def cluster(x, color, label_id, instance):
    """A wall of points, 4 m wide and high, 12 m ahead."""
    ys, xs = np.mgrid[-2.5:1.5:60j, x - 2 : x + 2 : 60j]
    points = np.stack([xs, ys, np.full_like(xs, 12)], -1).reshape(-1, 3).astype(np.float32)
    count = len(points)
    colors = np.full((count, 3), color, np.uint8)
    ids = np.full(count, label_id, np.uint8), np.full(count, instance, np.uint16)
    return PointCloud(points, colors, *ids, "m")


def two_clusters():
    left, right = cluster(-4, RED, 26, 26001), cluster(4, BLUE, 21, 0)
    arrays = {
        key: np.concatenate([value, vars(right)[key]])
        for key, value in vars(left).items()
        if key != "unit"
    }
    return replace(left, **arrays)


def browse(page, tmp_path, mode, *options):
    """A screenshot of the page in one colour mode, seen by the camera; and what it said."""
    path, shot = tmp_path / "page.html", tmp_path / "shot.png"
    path.write_text(page)
    command = [CHROMIUM, "--headless", "--no-sandbox", "--hide-scrollbars", "--window-size=900,600"]
    command += [*options, f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr"]
    command += ["--virtual-time-budget=3000", f"--screenshot={shot}"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", f"{path.as_uri()}#{mode}/Camera"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return cv2.imread(str(shot))[..., ::-1], console


def share(picture, color):
    return (np.abs(picture.astype(int) - color).max(-1) <= 3).mean()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize(
    ("mode", "colors"),
    [("Image", (RED, BLUE)), ("Class", (CAR, TREE)), ("Instance", (None, (203, 207, 194)))],
)
def test_a_browser_shows_the_points(tmp_path, mode, colors):
    picture, console = browse(page_of(two_clusters(), CITYSCAPES20, ABOUT), tmp_path, mode, *WEBGL)
    assert console == []
    halves = picture[200:, :450], picture[200:, 450:]
    for half, color, other in zip(halves, colors, colors[::-1], strict=True):
        if color is not None:
            assert 0.05 < share(half, color) < 0.9
        if other is not None:
            assert share(half, other) == 0
    assert 0.2 < share(picture, (255, 255, 255)) < 0.9


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_without_webgl_the_page_says_so(tmp_path):
    page = page_of(two_clusters(), CITYSCAPES20, ABOUT)
    picture, console = browse(page, tmp_path, "Image", "--disable-gpu", "--disable-3d-apis")
    assert share(picture, RED) == share(picture, BLUE) == 0
    assert share(picture, (255, 255, 255)) > 0.9
    assert (picture[280:320] < 128).any(), "a line of text in the middle"
    assert not any("Uncaught" in line for line in console)


def test_the_page_asks_for_nothing():
    page = page_of(two_clusters(), CITYSCAPES20, {**ABOUT, "name": "</script><b>&"})
    code = re.sub(r'<script type="text/plain".*?</script>', "", page)  # but the base64
    assert not re.search(r"https?:|//[a-z]|url\(|import |fetch|XMLHttp|WebSocket", code)
    assert """content="default-src 'none';""" in page
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources == ["data:,"]
    assert "<b>" not in page
    assert page.count("</script>") == 5


def test_positions_are_kept_to_the_millimetre():
    cloud = two_clusters()
    page = page_of(cloud, CITYSCAPES20, ABOUT)
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', page)[1])
    stored = re.search(r'id="positions">(.*?)</script>', page)[1]
    steps = np.frombuffer(base64.b64decode(stored), "<u2").reshape(-1, 3)
    points = np.array(facts["low"]) + steps / 65535 * np.array(facts["extent"])
    assert np.abs(points - cloud.points_N3).max() < 1e-3
    assert [s["name"] for s in facts["segments"]] == ["vegetation", "car"]
    assert [s["instance"] for s in facts["segments"]] == [0, 26001]
    assert (facts["near"], facts["far"], facts["unit"]) == (2.0, 80.0, "m")


def test_a_camera_that_looks_down_sees_a_level_road():
    pitch, z = 0.1, np.array([5.0, 20.0, 60.0])
    level = np.stack([np.zeros(3), np.full(3, 1.5), z], 1)
    cos, sin = np.cos(pitch), np.sin(pitch)
    seen = level @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]).T  # ahead appears higher
    assert seen[2, 1] < 0
    assert np.allclose(leveled(seen.astype(np.float32), pitch), level, atol=1e-5)


def shown(rows, columns, height=1.5):
    """A level road below a sky without depth."""
    rng = np.random.default_rng(0)
    K = np.array([[columns, 0, columns / 2], [0, columns, rows / 4], [0, 0, 1.0]])
    slope = (np.arange(rows) - rows / 4) / columns
    depth = np.where(slope > 0, 1.5 / np.maximum(slope, 1e-4), 0)[:, None].repeat(columns, 1)
    ids = np.where(depth > 0, 7, 23).astype(np.int32)
    classes = np.where(ids == 7, CITYSCAPES20.index("road"), CITYSCAPES20.index("sky"))
    image = rng.integers(0, 256, (rows, columns, 3)).astype(np.uint8)
    predicted = Predicted(
        image, K, ids, classes.astype(np.uint8), depth.astype(np.float32), "m", "road", height
    )
    return Shown("frame", predicted, Mounted(K, height, 0.0, "test"), CITYSCAPES20)


def test_a_cityscapes_frame_stays_below_ten_megabytes():
    page = cloud_page(shown(1024, 2048), "a run")
    assert 6e6 < len(page) < 1e7
    assert re.search(rf"; {POINTS} of \d{{7}} points;", page)
    assert f"{POINTS} points shown" in page
    assert "points beyond 90 m left out" in page


def test_tiny_frames_get_points_in_between():
    page = cloud_page(shown(64, 128), "a run")
    assert "interpolated to 256 x 512" in page
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', page)[1])
    assert facts["low"][1] + facts["extent"][1] == pytest.approx(1.5, abs=0.02)
    assert facts["height"] == 1.5


def test_without_depth_there_is_no_page():
    frame = shown(64, 128)
    bare = replace(frame.predicted, depth_HW=None, unit=None)
    with pytest.raises(ValueError, match="no depth is predicted"):
        cloud_page(replace(frame, predicted=bare), "a run")


def test_thinning_is_even():
    kept = thinned(1000, 300)
    assert len(set(kept.tolist())) == 300
    assert kept.max() < 1000
    assert np.diff(kept).max() <= 7
