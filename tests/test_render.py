"""Pictures: the right colours in the right places, legible whatever the input's size."""

import numpy as np
import pytest

from mtl_bench.data.labels import CITYSCAPES19, CITYSCAPES20
from mtl_bench.show import render
from mtl_bench.show.render import canvas, depth, panoptic

ROAD, CAR = (128, 64, 128), (0, 0, 142)


def noise(rows, columns, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (rows, columns, 3)).astype(np.uint8)


def colors_in(picture):
    return {tuple(color) for color in picture.reshape(-1, 3).tolist()}


# --- panoptic -------------------------------------------------------------------------------------


def test_a_class_has_its_color_and_its_instances_shades_of_it():
    colors = render.segment_colors(np.array([7, 26, 26000, 26001, 26002, 0, 31]), CITYSCAPES20)
    assert colors[0].tolist() == list(ROAD)
    assert colors[1].tolist() == colors[2].tolist() == list(CAR)
    assert len({tuple(color) for color in colors[2:5].tolist()}) == 3
    assert all(color[2] > color[0] == color[1] for color in colors[2:5].tolist())  # still blue
    assert colors[5].tolist() == list(panoptic.VOID)
    assert colors[6].tolist() == [0, 80, 100]


def test_an_overlay_shows_classes_outlines_and_leaves_void_gray():
    ids = np.full((40, 60), 7)
    ids[10:30, 10:25], ids[10:30, 25:40], ids[:5] = 26001, 26002, 0
    picture = render.overlay(np.full((40, 60, 3), (200, 100, 0), np.uint8), ids, CITYSCAPES20)
    gray = round(0.299 * 200 + 0.587 * 100)
    assert abs(picture[:5].astype(int) - gray).max() <= 1
    assert np.abs(picture[35, 5] - (0.65 * np.array(ROAD) + 0.35 * gray)).max() <= 1
    white = (picture == 255).all(2)
    assert white[10:30, 24:26].any(1).all(), "between two instances"
    assert white[9:11, 12:38].any(0).all(), "around an instance"
    assert not white[4:6, :].any(), "not between two stuff classes"
    assert not (picture[20, 15] == picture[20, 35]).all()


def test_a_legend_names_what_is_shown():
    whole = render.legend(CITYSCAPES19, 640)
    some = render.legend(CITYSCAPES19, 640, {0, 13})
    assert some.shape[0] < whole.shape[0]
    assert some.shape[1] == whole.shape[1] == 640
    assert {label.color for label in CITYSCAPES19.labels} <= colors_in(whole)
    assert ROAD in colors_in(some)
    assert (0, 0, 142) in colors_in(some)
    assert (244, 35, 232) not in colors_in(some)  # sidewalk


@pytest.mark.parametrize(("rows", "columns"), [(64, 128), (375, 1242), (1024, 2048), (20, 30)])
def test_pictures_of_any_size_have_room_for_text(rows, columns):
    ids = np.full((rows, columns), 7)
    ids[: rows // 2] = 23
    picture = render.panoptic_picture(noise(rows, columns), ids, CITYSCAPES20)
    times = max(1, -(-640 // columns))
    below = render.legend(CITYSCAPES20, columns * times, {1, 11})
    assert picture.shape == (rows * times + below.shape[0], columns * times, 3)
    assert (picture[rows * times :] == below).all()
    colored = render.depth_picture(np.full((rows, columns), 8.0), "m")
    assert colored.shape[1] == columns * times
    assert canvas.text_height(columns * times) >= 13


def test_what_is_enlarged_keeps_its_ids():
    ids = np.array([[7, 26001], [26002, 33003]])
    assert set(np.unique(render.enlarge(ids.astype(np.int32), 300))) == set(ids.ravel())


# --- depth ----------------------------------------------------------------------------------------


def test_depth_gets_darker_with_distance_and_gray_without_value():
    values = np.geomspace(2, 80, 50)[None]
    light = render.depth_colors(values, 2, 80)[0].astype(int) @ [0.3, 0.6, 0.1]
    assert (np.diff(light) < 1).all()
    assert light[0] > 230
    assert light[-1] < 10
    odd = render.depth_colors(np.array([[0.0, np.nan, np.inf, -1.0, 1.0, 500.0]]), 2, 80)[0]
    assert (odd[:4] == render.NO_DEPTH).all()
    assert (odd[4] == render.depth_colors(np.array([[2.0]]), 2, 80)).all()
    assert (odd[5] == render.depth_colors(np.array([[80.0]]), 2, 80)).all()


def test_the_bar_says_which_color_is_which_depth():
    near, far, width = 2.0, 80.0, 800
    bar = render.scale_bar(width, near, far, "m")
    size = canvas.text_height(width)
    left, right = size, width - 2 * size - canvas.text_width("m", size)
    for value in depth.ticks(near, far):
        x = left + (right - 1 - left) * np.log(value / near) / np.log(far / near)
        expected = render.depth_colors(np.array([[value]]), near, far)[0, 0].astype(int)
        assert abs(bar[size, round(x)].astype(int) - expected).max() <= 4
        assert (bar[round(1.7 * size) + 1, round(x)] == canvas.INK).all(), "a tick"


def test_ticks_are_round_numbers():
    assert depth.ticks(2, 80) == [2, 5, 10, 20, 50]
    assert depth.ticks(0.03, 1.2) == [0.05, 0.1, 0.2, 0.5, 1]


def test_a_unit_without_scale_takes_the_ends_from_the_map():
    values = np.linspace(0, 3, 1000).reshape(10, 100)
    near, far = render.depth_range(values, "network units")
    assert 0 < near < 0.2
    assert 2.8 < far < 3
    assert render.depth_range(values, "m") == (2, 80)
    near, far = render.depth_range(np.zeros((4, 4)), "network units")
    assert 0 < near < far


# --- points ---------------------------------------------------------------------------------------

RED, GREEN = (255, 0, 0), (0, 255, 0)


def view_of(points, colors, view=None, pixel_rad=0.02, size=(101, 201)):
    view = view or render.View((0, 0, 0), (0, 0, 1))
    points, colors = np.array(points, np.float32), np.array(colors, np.uint8)
    return render.points_view(points, colors, size, view, pixel_rad)


@pytest.mark.parametrize("order", [1, -1])
def test_a_near_point_hides_a_far_one(order):
    picture = view_of([[0, 0, 5], [0, 0, 9]][::order], [RED, GREEN][::order])
    assert tuple(picture[50, 100]) == RED
    assert GREEN not in colors_in(picture)


def test_points_are_where_the_viewer_sees_them():
    view = render.View((0, -3, -4), (0, 0, 10))
    points = [[0, 0, 10], [2, 0, 10], [0, -2, 10], [0, 0, 30], [0, 0, -30]]
    for point, right, down in zip(points, (0, 1, 0, 0, None), (0, 0, -1, -1, None), strict=True):
        rows, columns = np.nonzero((view_of([point], [RED], view) == RED).all(2))
        if right is None:
            assert not len(rows), "behind the viewer"
        else:
            assert np.sign(round(columns.mean() - 100)) == right
            assert np.sign(round(rows.mean() - 50)) == down


def test_the_same_thing_looks_smaller_from_afar():
    def area(z):
        view = render.View((0, 0, z), (0, 0, 20))
        return (view_of([[0, 0, 20]], [RED], view) == RED).all(2).sum()

    assert area(-60) < area(0) < area(10)


def test_an_empty_cloud_is_an_empty_picture():
    picture = view_of(np.zeros((0, 3)), np.zeros((0, 3)))
    assert picture.shape == (101, 201, 3)
    assert (picture == 255).all()
    far = render.View((0, 0, 0), (0, 0, 1), farthest=4.0)
    assert (view_of([[0, 0, 5]], [RED], far) == 255).all()


# --- canvas ---------------------------------------------------------------------------------------


def test_pictures_stand_below_and_beside_each_other():
    a, b = noise(10, 20), noise(6, 30, 1)
    below = render.stack([a, b], gap=2)
    assert below.shape == (18, 30, 3)
    assert (below[:10, :20] == a).all()
    assert (below[12:] == b).all()
    assert (below[10:12] == 255).all()
    beside = render.beside([a, b])
    assert beside.shape == (10, 50, 3)
    assert (beside[:6, 20:] == b).all()
    assert (beside[6:, 20:] == 255).all()
