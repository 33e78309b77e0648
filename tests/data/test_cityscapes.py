import json
import shutil

import cv2
import numpy as np
import pytest
import torch
from cityscapes_tree import (
    CAMERA,
    HEIGHT,
    LOSS,
    WIDTH,
    file,
    instance_ids,
    open_tree,
    put_ego_mask,
    put_png,
    write_frame,
    write_tree,
)

from mtl_bench.core import config
from mtl_bench.core.labels import IGNORE
from mtl_bench.data.check import check
from mtl_bench.data.cityscapes_files import neighbour, read_instance_ids, unlabelled_names
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.tasks.panoptic.targets import panoptic_targets

NAME = "aachen_000000_000019"
PLAIN = config.Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)


@pytest.fixture
def tree(tmp_path):
    return write_tree(tmp_path)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def rgb(path):
    return torch.from_numpy(cv2.imread(str(path))[..., ::-1].copy()).permute(2, 0, 1) / 255


# --- what a sample holds --------------------------------------------------------------------------


def test_training_sample_without_changes_shows_the_files(tree):
    dataset = open_tree(tree, augment=PLAIN)
    assert dataset.names == [
        "aachen_000000_000019",
        "aachen_000002_000019",
        "bochum_000001_000019",
    ]
    sample = dataset.sample(0, generator())
    assert sample.names == [NAME]
    expected = rgb(file(tree, "leftImg8bit", NAME, "leftImg8bit.png"))
    assert torch.equal(sample.image_B3HW, expected)
    assert torch.equal(sample.fields["clean"], expected)
    for place, frame in enumerate(("000018", "000020")):
        path = file(tree, "leftImg8bit_sequence", f"aachen_000000_{frame}", "leftImg8bit.png")
        assert torch.equal(sample.fields["neighbours"][place], rgb(path))
    torch.testing.assert_close(
        sample.camera.K_B33, torch.tensor([[2262.52, 0, 16.98], [0, 2265.3, 8.137], [0, 0, 1]])
    )
    assert sample.camera.height_m_B.item() == pytest.approx(1.22)
    assert sample.camera.pitch_rad_B.item() == pytest.approx(0.038)
    assert "depth_m" not in sample.fields

    ids = instance_ids()
    masked = np.isin(ids, [1, 23])
    assert np.array_equal(sample.fields["reprojection_mask"].numpy(), ~masked)
    targets = panoptic_targets(ids.astype(np.int32), CITYSCAPES20, LOSS)
    assert np.array_equal(sample.fields["semantic"].numpy(), targets.semantic)
    assert np.array_equal(sample.fields["semantic_weight"].numpy(), targets.semantic_weight)
    assert np.array_equal(sample.fields["center"][0].numpy(), targets.center)
    assert np.array_equal(sample.fields["center_weight"][0].numpy(), targets.center_weight)
    assert np.array_equal(sample.fields["offset"].numpy(), targets.offset)
    assert np.array_equal(sample.fields["offset_weight"][0].numpy(), targets.offset_weight)
    assert targets.offset_weight.sum() == 24


def test_padding_counts_nowhere(tree):
    dataset = open_tree(tree, augment=config.Augment(crop=(HEIGHT + 4, WIDTH + 6)))
    sample = dataset.sample(0, generator())
    assert sample.image_B3HW.shape == (3, HEIGHT + 4, WIDTH + 6)
    assert (sample.fields["semantic_weight"] > 0).sum() == HEIGHT * WIDTH
    outside = sample.fields["semantic_weight"] == 0
    assert (sample.fields["semantic"][outside] == IGNORE).all()
    assert not sample.fields["reprojection_mask"][outside].any()
    assert (sample.fields["center_weight"][0][outside] == 0).all()
    assert (sample.fields["offset_weight"][0][outside] == 0).all()


def test_evaluation_sample(tree):
    sample = open_tree(tree, augment=None).sample(0, None)
    expected = rgb(file(tree, "leftImg8bit", NAME, "leftImg8bit.png"))
    assert torch.equal(sample.image_B3HW, expected)
    assert np.array_equal(sample.fields["instance_ids"].numpy(), instance_ids())
    assert sample.fields["instance_ids"].dtype == torch.int32
    assert sample.fields["depth_m"].dtype == torch.float32
    assert sample.fields["depth_m"][5, 5].item() == pytest.approx(23.678742, abs=1e-5)
    assert sample.fields["depth_m"][0, :2].tolist() == [0, 0]
    assert "neighbours" not in sample.fields
    assert "semantic" not in sample.fields


def test_large_frames_shrink_and_ground_truth_keeps_its_size(tmp_path):
    write_frame(tmp_path, NAME, size=(4 * HEIGHT, 2 * WIDTH))
    dataset = open_tree(tmp_path, augment=PLAIN)
    sample = dataset.sample(0, generator())
    original = rgb(file(tmp_path, "leftImg8bit", NAME, "leftImg8bit.png"))
    area = original.reshape(3, HEIGHT, 4, WIDTH, 2).mean((2, 4))
    torch.testing.assert_close(sample.image_B3HW, area, atol=1 / 255, rtol=0)
    assert sample.fields["neighbours"].shape == (2, 3, HEIGHT, WIDTH)
    assert sample.fields["semantic"].shape == (HEIGHT, WIDTH)
    assert (sample.fields["semantic"][0] == CITYSCAPES20.index("sky")).all()
    expected = [[2262.52 / 2, 0, (16.98 + 0.5) / 2 - 0.5], [0, 2265.3 / 4, (8.137 + 0.5) / 4 - 0.5]]
    torch.testing.assert_close(sample.camera.K_B33[:2], torch.tensor(expected))

    evaluated = open_tree(tmp_path, augment=None).sample(0, None)
    assert evaluated.image_B3HW.shape == (3, HEIGHT, WIDTH)
    assert torch.equal(evaluated.camera.K_B33, sample.camera.K_B33)
    assert evaluated.fields["instance_ids"].shape == (4 * HEIGHT, 2 * WIDTH)
    assert evaluated.fields["depth_m"][5, 5].item() == pytest.approx(23.678742, abs=1e-5)  # own fx


def test_shrunk_labels_are_those_in_the_middle(tmp_path):
    write_frame(tmp_path, NAME, size=(3 * HEIGHT, 3 * WIDTH))
    ids = np.full((3 * HEIGHT, 3 * WIDTH), 7, np.uint16)
    ids[1::3, 1::3] = 26003
    put_png(file(tmp_path, "gtFine", NAME, "gtFine_instanceIds.png"), ids)
    sample = open_tree(tmp_path, augment=PLAIN).sample(0, generator())
    assert (sample.fields["semantic"] == CITYSCAPES20.index("car")).all()
    assert (sample.fields["offset_weight"] == 1).all()


def test_each_task_reads_only_its_files(tree):
    for folder in ("leftImg8bit_sequence", "disparity"):
        (tree / folder).rename(tree / f"away_{folder}")
    panoptic = open_tree(tree, video=False)
    sample = panoptic.sample(0, generator())
    assert "neighbours" not in sample.fields
    assert "clean" not in sample.fields
    assert "reprojection_mask" not in sample.fields
    assert "semantic" in sample.fields
    assert "depth_m" not in open_tree(tree, video=False, augment=None).sample(0, None).fields

    for folder in ("leftImg8bit_sequence", "disparity"):
        (tree / f"away_{folder}").rename(tree / folder)
    (tree / "gtFine").rename(tree / "away_gtFine")
    depth = open_tree(tree, panoptic=False)
    sample = depth.sample(0, generator())
    assert "semantic" not in sample.fields
    assert sample.fields["reprojection_mask"].all()
    assert "instance_ids" not in (
        open_tree(tree, panoptic=False, augment=None).sample(0, None).fields
    )

    (tree / "away_gtFine").rename(tree / "gtFine")
    sample = open_tree(tree, panoptic=False, augment=PLAIN).sample(0, generator())
    assert "semantic" not in sample.fields
    assert not sample.fields["reprojection_mask"][0].any()  # sky


def test_evaluation_needs_no_neighbours(tree):
    for path in (tree / "leftImg8bit_sequence").rglob("*.png"):
        path.unlink()
    assert "depth_m" in open_tree(tree, augment=None).sample(1, None).fields


def test_cache_changes_nothing_and_saves_reading(tree):
    data = config.Data(height=HEIGHT, width=WIDTH, cache=False)
    cached, fresh = open_tree(tree), open_tree(tree, data=data)
    first = cached.sample(0, generator(4))
    for path in tree.rglob(f"{NAME[:14]}*"):
        path.rename(path.with_suffix(".away"))
    second = cached.sample(0, generator(4))
    with pytest.raises(ValueError, match="cannot be read"):
        fresh.sample(0, generator(4))
    with pytest.raises(ValueError, match="cannot be read"):
        cached.uncached().sample(0, generator(4))
    assert torch.equal(first.image_B3HW, second.image_B3HW)
    assert torch.equal(first.fields["center"], second.fields["center"])


def test_each_frame_has_its_own_camera(tree):
    other = json.loads(json.dumps(CAMERA))
    other["intrinsic"]["fx"], other["extrinsic"]["z"] = 1000.0, 2.0
    file(tree, "camera", "aachen_000002_000019", "camera.json").write_text(json.dumps(other))
    dataset = open_tree(tree, augment=PLAIN)
    samples = [dataset.sample(index, generator()) for index in range(3)]
    assert [s.camera.K_B33[0, 0].item() for s in samples] == pytest.approx([2262.52, 1000, 2262.52])
    assert samples[1].camera.height_m_B.item() == 2


def test_labelled_sequence_frames_join_the_training(tree, tmp_path_factory):
    pseudo = tmp_path_factory.mktemp("pseudo")
    for frame, value in ((17, 7), (18, 7), (19, 7), (20, 7), (21, 7)):
        name = f"aachen_000000_{frame:06d}"
        image = np.full((HEIGHT, WIDTH, 3), frame, np.uint8)
        if frame != 19:
            put_png(file(tree, "leftImg8bit_sequence", name, "leftImg8bit.png"), image)
        path = pseudo / "aachen" / f"{name}_gtFine_instanceIds.png"
        put_png(path, np.full((HEIGHT, WIDTH), value, np.uint16))
    dataset = open_tree(tree, further_labels=pseudo, augment=PLAIN)
    assert dataset.names == [
        "aachen_000000_000018",
        "aachen_000000_000019",
        "aachen_000000_000020",
        "aachen_000002_000019",
        "bochum_000001_000019",
    ]
    later = dataset.sample(2, generator())
    assert torch.equal(later.image_B3HW, torch.full((3, HEIGHT, WIDTH), 20.0) / 255)
    assert torch.equal(later.fields["neighbours"][1], torch.full((3, HEIGHT, WIDTH), 21.0) / 255)
    assert (later.fields["semantic"] == CITYSCAPES20.index("road")).all()
    assert later.camera.K_B33[0, 0].item() == pytest.approx(2262.52)
    human = dataset.sample(1, generator())
    assert (human.fields["semantic"] == CITYSCAPES20.index("car")).any()
    assert dataset.dataset.static_from == "labels"


def test_every_frame_of_a_video_data_set_has_neighbours(tmp_path):
    """Also where snippets have no room at their ends, or labels where there is no image."""
    for number, frames in enumerate((range(15, 24), range(18, 21), range(17, 20))):
        stem = f"aachen_{number:06d}"
        write_frame(tmp_path, f"{stem}_000019")
        for frame in frames:
            image = np.full((HEIGHT, WIDTH, 3), frame, np.uint8)
            name = f"{stem}_{frame:06d}"
            put_png(file(tmp_path, "leftImg8bit_sequence", name, "leftImg8bit.png"), image)
        for frame in range(10, 28):
            path = tmp_path / f"pseudo/aachen/{stem}_{frame:06d}_gtFine_instanceIds.png"
            put_png(path, np.full((HEIGHT, WIDTH), 7, np.uint16))
    dataset = open_tree(tmp_path, further_labels=tmp_path / "pseudo", augment=PLAIN)
    assert [name[7:] for name in dataset.names] == [
        *(f"000000_{frame:06d}" for frame in range(16, 23)),
        "000001_000019",
        "000002_000018",
        "000002_000019",
    ]
    assert [name for name in dataset.names if not name.endswith("19")] == unlabelled_names(
        tmp_path, "train"
    )
    for index, name in enumerate(dataset.names):
        sample = dataset.sample(index, generator())
        for place, step in enumerate((-1, 1)):
            path = file(tmp_path, "leftImg8bit_sequence", neighbour(name, step), "leftImg8bit.png")
            assert torch.equal(sample.fields["neighbours"][place], rgb(path))


# --- without labels -------------------------------------------------------------------------------


def test_depth_trains_without_labels_and_panoptic_does_not(tree):
    shutil.rmtree(tree / "gtFine")
    depth = open_tree(tree, panoptic=False)
    assert (depth.dataset.static_from, depth.dataset.knows_static) == ("none", False)
    for index in range(len(depth)):
        sample = depth.sample(index, generator(index))
        assert sample.fields["reprojection_mask"].all()
        assert sample.fields["neighbours"].shape == (2, 3, HEIGHT, WIDTH)
    for video in (True, False):
        with pytest.raises(ValueError, match="missing, one of 3 label files") as error:
            open_tree(tree, video=video)
        assert one_line(error)


def test_panoptic_alone_needs_no_video_at_all(tree):
    shutil.rmtree(tree / "leftImg8bit_sequence")
    dataset = open_tree(tree, video=False)
    assert dataset.dataset.static_from == "labels"
    sample = dataset.sample(0, generator())
    assert "semantic" in sample.fields
    further = {"neighbours", "clean", "clean_neighbours", "reprojection_mask"}
    assert not further & sample.fields.keys()
    with pytest.raises(ValueError, match="missing, one of 6 neighbour frames"):
        open_tree(tree)


def test_ego_mask_goes_through_the_augmentation(tree):
    shutil.rmtree(tree / "gtFine")
    ego = put_ego_mask(tree)
    dataset = open_tree(tree, panoptic=False, augment=PLAIN)
    assert (dataset.dataset.static_from, dataset.dataset.knows_static) == ("ego_mask.png", False)
    assert np.array_equal(dataset.sample(0, generator()).fields["reprojection_mask"].numpy(), ~ego)

    for path in tree.rglob("*_leftImg8bit.png"):  # so that the image says what the mask must be
        put_png(path, np.where(ego, 255, 0)[..., None].repeat(3, 2).astype(np.uint8))
    settings = config.Augment(
        crop=(HEIGHT - 4, WIDTH + 4), brightness=0, contrast=0, saturation=0, hue=0
    )
    dataset = open_tree(tree, panoptic=False, augment=settings)
    flipped = 0
    for seed in range(12):
        sample = dataset.sample(0, generator(seed))
        black = (sample.image_B3HW == 0).all(0)  # padding is gray
        assert torch.equal(sample.fields["reprojection_mask"], black)
        flipped += bool(sample.fields["reprojection_mask"][-1].int().argmax() < WIDTH // 2)
    assert 0 < flipped < 12


def test_ego_mask_is_for_frames_without_labels(tree):
    ego = put_ego_mask(tree)
    labelled = np.isin(instance_ids(), [1, 23])
    dataset = open_tree(tree, augment=PLAIN)
    assert (dataset.dataset.static_from, dataset.dataset.knows_static) == ("labels", True)
    assert np.array_equal(
        dataset.sample(0, generator()).fields["reprojection_mask"].numpy(), ~labelled
    )

    file(tree, "gtFine", NAME, "gtFine_instanceIds.png").unlink()
    dataset = open_tree(tree, augment=PLAIN, panoptic=False)
    assert dataset.dataset.static_from == "labels, or ego_mask.png where a frame lacks them"
    assert not dataset.dataset.knows_static
    masks = [
        dataset.sample(index, generator()).fields["reprojection_mask"].numpy() for index in (0, 1)
    ]
    assert np.array_equal(masks[0], ~ego)
    assert np.array_equal(masks[1], ~labelled)

    (tree / "ego_mask.png").unlink()
    dataset = open_tree(tree, augment=PLAIN, panoptic=False)
    assert dataset.dataset.static_from == "labels, or none where a frame lacks them"


def test_ego_mask_shrinks_with_the_frames(tmp_path):
    size = (3 * HEIGHT, 2 * WIDTH)
    write_frame(tmp_path, NAME, size=size)
    shutil.rmtree(tmp_path / "gtFine")
    put_ego_mask(tmp_path, size)
    sample = open_tree(tmp_path, panoptic=False, augment=PLAIN).sample(0, generator())
    small = np.zeros((HEIGHT, WIDTH), bool)
    small[HEIGHT // 2 :, : WIDTH // 2] = True
    assert np.array_equal(sample.fields["reprojection_mask"].numpy(), ~small)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint16), "16-bit PNG where 8"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "3 channels where one is expected"),
        (np.zeros((8, 9), np.uint8), "8x9 pixels, but aachen_000000_000019_leftImg8bit.png has"),
    ],
)
def test_wrong_ego_mask(tree, mask, message):
    put_png(tree / "ego_mask.png", mask)
    assert check(tree).problems == []  # not in use
    open_tree(tree).sample(0, generator())
    shutil.rmtree(tree / "gtFine")
    with pytest.raises(ValueError, match=f"{tree}/ego_mask.png: {message}") as error:
        open_tree(tree, panoptic=False).sample(0, generator())
    assert one_line(error)
    assert "depth_m" in open_tree(tree, panoptic=False, augment=None).sample(0, None).fields
    report = check(tree)
    assert [str(problem) for problem in report.problems] == [str(error.value)]
    assert report.obstacle("depth training") == "1 problem"
    assert "train: 1 bad ego mask" in report.summary()


def test_a_folder_with_videos_alone_says_what_is_missing(tree):
    shutil.rmtree(tree / "leftImg8bit")
    for look in (lambda root: open_tree(root, panoptic=False), check):
        with pytest.raises(ValueError, match=r"leftImg8bit/train: no .* in it; expected") as error:
            look(tree)
        assert one_line(error)


# --- what can be wrong ----------------------------------------------------------------------------


def one_line(error):
    return "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("folder", "name", "suffix", "what"),
    [
        ("leftImg8bit_sequence", "aachen_000000_000020", "leftImg8bit.png", "neighbour frames"),
        ("gtFine", NAME, "gtFine_instanceIds.png", "label files"),
        ("camera", NAME, "camera.json", "camera files"),
    ],
)
def test_missing_files_are_named_before_training(tree, folder, name, suffix, what):
    path = file(tree, folder, name, suffix)
    path.unlink()
    with pytest.raises(ValueError, match=rf"{path}: missing, one of 1 {what}.*{folder}_") as error:
        open_tree(tree)
    assert one_line(error)
    report = check(tree)
    assert [str(problem) for problem in report.problems] == [
        f"{path}: missing; unpack {folder}_trainvaltest.zip"
    ]


def test_first_frame_of_a_video_has_no_previous_one(tree):
    write_frame(tree, "aachen_000005_000001")
    path = file(tree, "leftImg8bit_sequence", "aachen_000005_000001", "leftImg8bit.png")
    new = "aachen_000005_000000"
    for folder, suffix in (
        ("leftImg8bit", "leftImg8bit.png"),
        ("camera", "camera.json"),
        ("gtFine", "gtFine_instanceIds.png"),
    ):
        old = file(tree, folder, "aachen_000005_000001", suffix)
        old.rename(file(tree, folder, new, suffix))
    assert path.exists()
    with pytest.raises(ValueError, match=r"aachen_000005_-00001_leftImg8bit\.png: missing"):
        open_tree(tree)
    assert any("000005_-00001" in str(problem) for problem in check(tree).problems)


def test_missing_disparity_is_named_before_evaluation(tree):
    path = file(tree, "disparity", NAME, "disparity.png")
    path.unlink()
    with pytest.raises(ValueError, match=f"{path}: missing"):
        open_tree(tree, augment=None)


BROKEN = [
    ("leftImg8bit", "leftImg8bit.png", np.zeros((HEIGHT, WIDTH, 3), np.uint16), "16-bit PNG"),
    ("gtFine", "gtFine_instanceIds.png", np.zeros((HEIGHT, WIDTH), np.uint8), "8-bit PNG where 16"),
    ("gtFine", "gtFine_instanceIds.png", np.full((8, 9), 7, np.uint16), "8x9 pixels, but"),
    ("disparity", "disparity.png", np.zeros((HEIGHT, WIDTH), np.uint8), "8-bit PNG where 16"),
    ("disparity", "disparity.png", np.zeros((8, 9), np.uint16), "8x9 pixels, but"),
]


@pytest.mark.parametrize(("folder", "suffix", "array", "message"), BROKEN)
def test_wrong_contents(tree, folder, suffix, array, message):
    path = file(tree, folder, NAME, suffix)
    put_png(path, array)
    with pytest.raises(ValueError, match=f"{path}: {message}") as error:
        open_tree(tree, augment=None).sample(0, None)
    assert one_line(error)
    assert [str(problem) for problem in check(tree).problems] == [str(error.value)]


def test_neighbour_of_another_size(tree):
    path = file(tree, "leftImg8bit_sequence", "aachen_000000_000018", "leftImg8bit.png")
    put_png(path, np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(ValueError, match=f"{path}: 16x33 pixels, but"):
        open_tree(tree).sample(0, generator())


@pytest.mark.parametrize("value", [34, 500, 999, 34000, 65535])
def test_unknown_label_id(tree, value):
    path = file(tree, "gtFine", NAME, "gtFine_instanceIds.png")
    ids = instance_ids()
    ids[3, 4:6] = value
    put_png(path, ids)
    message = f"{path}: unknown instance id {value} on 2 pixels"
    with pytest.raises(ValueError, match=message):
        open_tree(tree).sample(0, generator())
    assert check(tree).problems == []
    deep = check(tree, deep=True).problems
    assert len(deep) == 1
    assert str(deep[0]).startswith(message)


def test_every_known_label_id_is_accepted(tmp_path):
    values = [*range(34), 26000, 26999, 33001, 29000]
    path = tmp_path / "a.png"
    put_png(path, np.array([values], np.uint16))
    assert read_instance_ids(path).tolist() == [values]


@pytest.mark.parametrize("keep", [0, 4, 20, 40, 0.5, -1, -12, -16])
def test_truncated_png(tree, keep):
    path = file(tree, "leftImg8bit", NAME, "leftImg8bit.png")
    data = path.read_bytes()
    keep = int(keep * len(data)) if isinstance(keep, float) else keep
    path.write_bytes(data[:keep])
    message = "truncated PNG|empty|not a PNG"
    with pytest.raises(ValueError, match=f"{path}: .*({message})") as error:
        open_tree(tree, augment=None).sample(0, None)
    assert one_line(error)
    assert [problem.group for problem in check(tree).problems] == ["bad"]


def test_damaged_png(tree):
    path = file(tree, "leftImg8bit", NAME, "leftImg8bit.png")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"{path}: damaged PNG"):
        open_tree(tree, augment=None).sample(0, None)
    assert check(tree).problems == []  # the header is in order
    assert "damaged PNG" in str(check(tree, deep=True).problems[0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "no 'intrinsic'"),
        ("{", "not a camera file"),
        ('{"intrinsic": 3, "extrinsic": 4}', "not a camera file"),
        (json.dumps({**CAMERA, "intrinsic": {**CAMERA["intrinsic"], "fx": 0}}), "impossible"),
        (json.dumps({**CAMERA, "extrinsic": {"baseline": 0.2}}), "no 'z'"),
    ],
)
def test_broken_camera(tree, text, message):
    path = file(tree, "camera", NAME, "camera.json")
    path.write_text(text)
    with pytest.raises(ValueError, match=f"{path}: {message}") as error:
        open_tree(tree, augment=None).sample(0, None)
    assert one_line(error)
    assert [str(problem) for problem in check(tree).problems] == [str(error.value)]


def test_frames_smaller_than_the_recipe(tree):
    with pytest.raises(ValueError, match="16x32 pixels, fewer than the recipe's 32x64"):
        open_tree(tree, data=config.Data(height=32, width=64), augment=None).sample(0, None)


def test_no_data_set_at_all(tmp_path):
    for look in (open_tree, check):
        with pytest.raises(ValueError, match="no such folder"):
            look(tmp_path / "nowhere")
        with pytest.raises(ValueError, match="expected Cityscapes' layout"):
            look(tmp_path)
    put_png(tmp_path / "leftImg8bit/train/a/strange_leftImg8bit.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(ValueError, match="'strange' is no frame's name"):
        check(tmp_path)


def test_a_folder_that_cannot_be_listed(tree, monkeypatch):
    def deny(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("mtl_bench.data.cityscapes_files.os.scandir", deny)
    with pytest.raises(ValueError, match="leftImg8bit/train: cannot be listed"):
        check(tree)


# --- check ----------------------------------------------------------------------------------------


def test_check_of_a_sound_tree(tree):
    write_tree(tree, 2, "val")
    report = check(tree, deep=True)
    assert report.problems == []
    assert report.frames == {"train": 3, "val": 2}
    assert report.present["train", "leftImg8bit_sequence"] == 6
    assert report.summary() == [
        str(tree),
        "train: 3 frames (Cityscapes: 2975), 3 label files, 6 neighbour frames, 3 camera files, "
        "3 disparity maps",
        "val: 2 frames (Cityscapes: 500), 2 label files, 4 neighbour frames, 2 camera files, "
        "2 disparity maps",
        "panoptic training: ready",
        "depth training: ready",
        "panoptic evaluation: ready",
        "depth evaluation: ready",
        "pseudo labels: 0 training frames could get them",
    ]


def test_check_says_what_can_be_done_without_labels(tree):
    for frame in (17, 21, 22):
        name = f"aachen_000000_{frame:06d}"
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        put_png(file(tree, "leftImg8bit_sequence", name, "leftImg8bit.png"), image)
    assert check(tree).summary()[-1] == "pseudo labels: 3 training frames could get them"

    shutil.rmtree(tree / "gtFine")
    assert check(tree).summary()[2:] == [
        "val: none",
        "panoptic training: no gtFine/train; unpack gtFine_trainvaltest.zip",
        "depth training: ready",
        "panoptic evaluation: no frames in leftImg8bit/val",
        "depth evaluation: no frames in leftImg8bit/val",
        "without labels: only depth can be trained",
        "reprojection mask: none, with the auto-mask; ego_mask.png would mask the ego vehicle",
        "pseudo labels: 6 training frames could get them",
    ]
    put_ego_mask(tree)
    lines = check(tree).summary()
    assert "reprojection mask: ego_mask.png, with the auto-mask" in lines


def test_check_lists_everything_at_once(tree):
    write_tree(tree, 5, "val")
    for path in (tree / "leftImg8bit_sequence" / "val").rglob("*_000018_*"):
        path.unlink()
    file(tree, "camera", NAME, "camera.json").unlink()
    put_png(
        file(tree, "gtFine", NAME, "gtFine_instanceIds.png"), np.zeros((HEIGHT, WIDTH), np.uint8)
    )
    for path in (tree / "disparity").rglob("*.png"):
        path.unlink()
    report = check(tree)
    lines = report.summary()
    assert len(report.problems) == 7
    assert "val: 5 missing neighbour frames" in lines
    assert "  and 2 more" in lines
    assert "train: 1 missing camera file" in lines
    assert "train: 1 bad label file" in lines
    assert report.obstacle("panoptic training") == "1 problem"
    assert report.obstacle("depth training") == "1 problem"
    assert report.obstacle("depth training") == "1 problem"
    assert report.obstacle("panoptic evaluation") is None
    absent = "no disparity/val; unpack disparity_trainvaltest.zip"
    assert report.obstacle("depth evaluation") == absent
    assert f"depth evaluation: {absent}" in lines


def test_check_without_a_split(tree):
    report = check(tree)
    assert report.frames == {"train": 3, "val": 0}
    assert "val: none" in report.summary()
    assert report.obstacle("panoptic evaluation") == "no frames in leftImg8bit/val"
