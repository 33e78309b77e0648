import pytest
import torch
from kornia.enhance import (
    adjust_brightness_accumulative,
    adjust_contrast_with_mean_subtraction,
    adjust_saturation_with_gray_subtraction,
)

from mtl_bench.core import config
from mtl_bench.data import augment as A
from mtl_bench.tasks.panoptic.targets import OUTSIDE

PLAIN = config.Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)
MEAN = torch.tensor([123.675, 116.28, 103.53]) / 255


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def camera(fx=50.0, fy=60.0, cx=20.3, cy=9.6):
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def frames(height=24, width=40, count=3, seed=1):
    shape = (count, 3, height, width)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator(seed))


def ids(height=24, width=40):
    return torch.randint(0, 34, (height, width), dtype=torch.int32, generator=generator(2))


def projection(K, point):
    u, v, w = K @ point
    return torch.stack([u / w, v / w])


POINT = torch.tensor([0.4, 0.2, 2.0])  # a corner of something, metres in the camera's frame


def marked(height=24, width=40):
    """Frames with one bright pixel exactly where the camera sees POINT."""
    K = camera(fx=50, fy=60, cx=20, cy=9)
    u, v = projection(K, POINT).round().int().tolist()
    picture = torch.zeros(3, 3, height, width, dtype=torch.uint8)
    picture[..., v, u] = 255
    return picture, K, picture[0, 0].int()


def peak(picture):
    """(u, v) center of brightness of the first frame."""
    light = picture[0].float().sum(0)
    v, u = torch.meshgrid(*(torch.arange(n).float() for n in light.shape), indexing="ij")
    return torch.stack([(u * light).sum(), (v * light).sum()]) / light.sum()


def test_flip_moves_the_principal_point_with_the_picture():
    picture, K, labels = marked()
    flipped, flipped_K, flipped_labels = A.flip(picture, K, labels)
    mirrored = POINT * torch.tensor([-1, 1, 1])
    torch.testing.assert_close(projection(flipped_K, mirrored), peak(flipped))
    assert torch.equal(flipped_labels.argmax(), flipped[0, 0].argmax())
    assert flipped_K[0, 2] == 40 - 1 - K[0, 2]


@pytest.mark.parametrize("factor", [2.0, 3.0, 0.5, 1.5])
def test_resize_moves_the_camera_with_the_picture(factor):
    picture, K, labels = marked()
    resized, resized_K, resized_labels = A.resize(picture, K, labels, factor)
    assert resized.shape[-2:] == (24 * factor, 40 * factor) == resized_labels.shape
    torch.testing.assert_close(projection(resized_K, POINT), peak(resized), atol=0.05, rtol=0)
    if factor > 1:
        torch.testing.assert_close(
            projection(resized_K, POINT), peak(resized_labels[None, None]), atol=0.5, rtol=0
        )


def test_shrunk_labels_are_those_in_the_middle():
    labels = torch.arange(24 * 39, dtype=torch.int32).reshape(24, 39)
    _, _, resized = A.resize(frames(24, 39), camera(), labels, 1 / 3)
    assert torch.equal(resized, labels[1::3, 1::3])


def test_intrinsics_follow_each_axis_own_factor():
    K = A.scale(camera(10, 12, 7.5, 5.5), 0.5, 0.25)
    assert K.tolist() == [[5, 0, 3.5], [0, 3, 1.0], [0, 0, 1]]


def test_crop_pad_and_flip_keep_the_point_on_its_pixel():
    picture, K, labels = marked()
    settings = config.Augment(
        crop=(20, 60), scales=(1.0, 2.0), brightness=0, contrast=0, saturation=0, hue=0
    )
    seen = {False: 0, True: 0}
    for seed in range(40):
        view = A.augment(picture, K, labels, settings, generator(seed))
        assert view.clean_N3HW.shape == (3, 3, 20, 60)
        light = torch.where(view.instance_ids_HW != OUTSIDE, view.clean_N3HW, 0)
        direct = projection(view.K_33, POINT)
        mirrored = projection(view.K_33, POINT * torch.tensor([-1, 1, 1]))
        if not (3 <= direct[1] <= 16 and min(direct[0], mirrored[0]) >= 3):
            continue  # cut by the crop's edge
        if light.max() < 0.1 or max(direct[0], mirrored[0]) > 56:
            continue
        errors = [(candidate - peak(light)).abs().max() for candidate in (direct, mirrored)]
        assert min(errors) < 0.05
        seen[bool(errors[1] < errors[0])] += 1
    assert min(seen.values()) >= 3


def test_padding_has_one_colour_and_no_label():
    settings = config.Augment(crop=(40, 60), flip=True)
    view = A.augment(frames(), camera(), ids(), settings, generator())
    outside = view.instance_ids_HW == OUTSIDE
    assert outside.sum() == 40 * 60 - 24 * 40
    assert outside.any(0).all()  # above or below
    assert outside.any(1).all()  # at the sides
    for picture in (view.clean_N3HW, view.jittered_N3HW):
        padding = picture.permute(0, 2, 3, 1)[outside.expand(3, -1, -1)]
        torch.testing.assert_close(padding, MEAN.expand_as(padding))


def test_geometry_is_shared_by_frames_and_labels():
    labels = ids()
    same = labels.to(torch.uint8).expand(3, 3, -1, -1)
    settings = config.Augment(crop=(16, 50))
    for seed in range(6):
        view = A.augment(same, camera(), labels, settings, generator(seed))
        inside = view.instance_ids_HW != OUTSIDE
        for frame in view.clean_N3HW:
            for channel in frame:
                shown = (channel * 255).round().int()
                assert torch.equal(shown[inside], view.instance_ids_HW[inside])


def test_jitter_is_one_colour_map_for_all_frames():
    picture = frames().float() / 255
    picture[1, :, 3, 4] = picture[0, :, 20, 30]
    picture[2, :, 0, 0] = picture[0, :, 20, 30]
    settings = config.Augment()
    for seed in range(8):
        out = A.jitter(picture, settings, generator(seed))
        assert out.shape == picture.shape
        assert out.min() >= 0
        assert out.max() <= 1
        assert not torch.equal(out, picture)
        torch.testing.assert_close(out[1, :, 3, 4], out[0, :, 20, 30])
        torch.testing.assert_close(out[2, :, 0, 0], out[0, :, 20, 30])


@pytest.mark.parametrize("kind", ["brightness", "contrast", "saturation", "hue"])
def test_each_jitter_changes_what_it_is_called_after(kind):
    zero = dict.fromkeys(("brightness", "contrast", "saturation", "hue"), 0.0)
    picture = frames().float() / 255 * 0.4 + 0.3  # far from the clamps
    out = A.jitter(picture, config.Augment(**{**zero, kind: 0.1}), generator(3))
    assert not torch.allclose(out, picture, atol=1e-3)
    gray = torch.tensor([0.299, 0.587, 0.114])
    luma, new_luma = (torch.einsum("nchw,c->nhw", x, gray) for x in (picture, out))
    if kind == "brightness":
        ratio = out / picture
        torch.testing.assert_close(ratio, ratio[:1, :1, :1, :1].expand_as(ratio))
    elif kind == "contrast":
        torch.testing.assert_close(new_luma.mean(), luma.mean())
        assert new_luma.std() != pytest.approx(luma.std().item(), rel=1e-3)
    else:
        torch.testing.assert_close(new_luma, luma, atol=2e-4, rtol=0)


def test_hue_turn_agrees_with_a_full_circle_and_leaves_gray_alone():
    picture = torch.rand(3, 6, 7, generator=generator()) * 0.3 + 0.35
    torch.testing.assert_close(A._turn_hue(picture, 2.0), picture, atol=1e-5, rtol=0)
    gray = picture[:1].expand(3, -1, -1)
    torch.testing.assert_close(A._turn_hue(gray, 1.1), gray, atol=1e-3, rtol=0)
    red = torch.tensor([0.8, 0.2, 0.2])[:, None, None]
    toward_yellow = A._turn_hue(red, 1.05)
    toward_magenta = A._turn_hue(red, 0.95)
    assert toward_yellow[1] > red[1] > toward_magenta[1]


def test_no_change_asked_for_is_no_change():
    picture = frames()
    view = A.augment(picture, camera(), ids(), PLAIN, generator())
    assert torch.equal(view.clean_N3HW, picture.float() / 255)
    assert torch.equal(view.jittered_N3HW, view.clean_N3HW)
    assert torch.equal(view.K_33, camera())
    assert torch.equal(view.instance_ids_HW, ids())


def test_the_input_is_left_alone():
    picture, K, labels = frames(), camera(), ids()
    A.augment(picture, K, labels, config.Augment(crop=(30, 30)), generator())
    assert torch.equal(picture, frames())
    assert torch.equal(K, camera())
    assert torch.equal(labels, ids())


def test_scales_without_a_crop_keep_the_input_size():
    settings = config.Augment(scales=(0.5, 2.0))
    sizes = {
        tuple(A.augment(frames(), camera(), ids(), settings, generator(s)).clean_N3HW.shape)
        for s in range(6)
    }
    assert sizes == {(3, 3, 24, 40)}


def test_flip_happens_half_of_the_time_and_everything_is_a_function_of_the_generator():
    settings = config.Augment(brightness=0, contrast=0, saturation=0, hue=0)
    centers = [
        A.augment(frames(), camera(), ids(), settings, generator(s)).K_33[0, 2] for s in range(100)
    ]
    flipped = sum(bool(center != camera()[0, 2]) for center in centers)
    assert 30 < flipped < 70
    one, two = (
        A.augment(frames(), camera(), ids(), config.Augment(crop=(20, 20)), generator(9))
        for _ in range(2)
    )
    assert torch.equal(one.jittered_N3HW, two.jittered_N3HW)
    assert torch.equal(one.instance_ids_HW, two.instance_ids_HW)


# --- shortcuts, which must not change a bit -------------------------------------------------------


@pytest.mark.parametrize("size", [(24, 40), (64, 96)])
@pytest.mark.parametrize("factor", [0.4, 0.6875, 1.0, 1.37, 2.0])
def test_a_window_of_a_resized_frame_is_that_part_of_it(size, factor):
    picture, labels = frames(*size), ids(*size)
    whole, K, whole_labels = A.resize(picture, camera(), labels, factor)
    height, width = whole.shape[-2:]
    channels_last = [frame.permute(1, 2, 0).contiguous().permute(2, 0, 1) for frame in picture]
    for top in (0, height // 3, height - 7):
        for left in (0, width // 2, width - 9):
            window = (slice(top, top + 7), slice(left, left + 9))
            for given in (picture, channels_last):
                part, part_K, part_labels = A.resize(given, camera(), labels, factor, window)
                assert torch.equal(part, whole[..., window[0], window[1]])
                assert torch.equal(part_labels, whole_labels[window])
                assert torch.equal(part_K, A.shift(K, -left, -top))


def test_jitter_in_blocks_is_jitter_of_the_whole(monkeypatch):
    picture = frames(30, 50).float() / 255
    threads = torch.get_num_threads()
    try:
        for seed in range(24):
            results = []
            for count, block in ((1, 50), (1, 7 * 50), (1, 2**16), (2, 50)):
                torch.set_num_threads(count)
                monkeypatch.setattr(A, "_BLOCK", block)
                results.append(A.jitter(picture, config.Augment(), generator(seed)))
            assert all(torch.equal(results[0], other) for other in results[1:])
    finally:
        torch.set_num_threads(threads)


def test_jitter_is_kornias_changes_one_after_another():
    picture, settings = frames().float() / 255, config.Augment(contrast=0.5)
    widths = (settings.brightness, settings.contrast, settings.saturation, settings.hue)
    for seed in range(12):
        source = generator(seed)
        draws = (torch.rand(4, generator=source) * 2 - 1).tolist()
        expected = picture.transpose(0, 1).flatten(1, 2)
        for kind in torch.randperm(4, generator=source).tolist():
            factor = 1 + widths[kind] * draws[kind]
            expected = (
                adjust_brightness_accumulative,
                adjust_contrast_with_mean_subtraction,
                adjust_saturation_with_gray_subtraction,
                A._turn_hue,
            )[kind](expected, factor)
        expected = expected.unflatten(1, (3, -1)).transpose(0, 1)
        torch.testing.assert_close(A.jitter(picture, settings, generator(seed)), expected)
