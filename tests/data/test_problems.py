"""The small standard problems: what their data sets make of a seed or read of a tree."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mtl_bench.core.config import load_recipe
from mtl_bench.core.plugins import load, stem_and_field
from mtl_bench.data.celeba import ATTRIBUTES, IMAGES, PARTITION

SPLITS = ("train", "val", "test")


def numbers(name: str, split: str = "train", **changes) -> np.ndarray:
    """[N,K], the truth of a split."""
    data = replace(load_recipe(name).data, **changes)
    return load("datasets", name)(Path(), split, data).truth_NK.numpy()


def opened(name: str, split: str = "train", **changes):
    recipe, kind = load_recipe(name), load("datasets", name)
    own = {stem_and_field(task)[1] for task in recipe.tasks}
    needs = own if "regress" in kind.predicts else kind.fields
    return kind(Path(), split, replace(recipe.data, **changes), needs=needs)


# --- made regressions -----------------------------------------------------------------------------


def test_losses_of_scales_differ_ten_thousandfold():
    variance_K = numbers("scales").var(0)
    steps = np.log(variance_K[1:] / variance_K[:-1])
    assert variance_K[-1] / variance_K[0] == pytest.approx(1e4, rel=0.05)
    assert steps == pytest.approx(np.log(1e4) / 9, rel=0.02)


@pytest.mark.parametrize("cosine", [-0.1, 0.0, 0.5, 1.0])
def test_functions_have_the_chosen_cosine(cosine):
    found_KK = np.corrcoef(numbers("conflict", cosine=cosine), rowvar=False)
    off = found_KK[~np.eye(8, dtype=bool)]
    # a tenth of each number's variance is noise of its own
    assert off == pytest.approx(0.9 * cosine, abs=0.03)


def test_a_made_number_has_the_chosen_norm():
    deviation_K = numbers("conflict", norm_ratio=25.0).std(0)
    assert deviation_K[-1] / deviation_K[0] == pytest.approx(25, rel=0.02)


def test_made_data_are_a_function_of_their_seed():
    small = {"train_scenes": 8, "val_scenes": 4, "test_scenes": 4}
    one, two, other = (opened("scales", seed=seed, **small) for seed in (0, 0, 1))
    assert torch.equal(one.truth_NK, two.truth_NK)
    assert torch.equal(one.pixels_N3HW, two.pixels_N3HW)
    assert not torch.equal(one.pixels_N3HW, other.pixels_N3HW)
    splits = [opened("scales", split, **small) for split in SPLITS]
    assert [len(split) for split in splits] == [8, 4, 4]
    pixels = torch.cat([split.pixels_N3HW for split in splits]).flatten(1)
    assert len(pixels.unique(dim=0)) == 16


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("conflict", {"cosine": -0.5}, "cosine = -0.5: of 8 functions, any two have -0.143 to 1"),
        ("conflict", {"heads": 2}, "recipe.data.heads = 2 has no c2"),
        ("scales", {"heads": 11}, "heads = 11: from 2 to 10"),
    ],
)
def test_a_problem_that_cannot_be_made(name, changes, message):
    with pytest.raises(ValueError, match=message):
        opened(name, **changes)


# --- digits ---------------------------------------------------------------------------------------


def test_digits_are_overlaid_and_told_apart():
    dataset = opened("digits", train_scenes=50)
    frame = dataset.read(dataset.names[3])
    left, right = frame.fields["left_picture"], frame.fields["right_picture"]
    image = frame.images_N3HW[0]
    assert torch.equal(image[0] / 255, torch.maximum(left, right))
    assert torch.equal(image[0], image[2])
    assert left[:, 12:].max() == 0 == right[:, :4].max()  # each in its own corner
    assert 0 <= int(frame.fields["left"]) <= 9


def test_no_digit_is_in_two_splits():
    def seen(split: str) -> set[bytes]:
        pictures = opened("digits", split).pictures_N2HW
        return {p[2:10, 2:10].tobytes() for p in pictures[:, 0]}

    train, val, test = (seen(split) for split in SPLITS)
    assert len(train) > 900
    # a handful of the 1797 are alike to the pixel
    assert max(len(train & val), len(train & test), len(val & test)) <= 2


def test_an_image_too_small_for_two_digits():
    with pytest.raises(ValueError, match="10x16: two digits take 12x12 pixels"):
        opened("digits", height=10)


# --- CelebA ---------------------------------------------------------------------------------------

CELEBA = load("datasets", "celeba")
DATA = load_recipe("celeba-cnn9").data


@pytest.fixture
def tree(tmp_path) -> Path:
    CELEBA.example(tmp_path, DATA)
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_the_recipe_has_every_attribute():
    tasks = load_recipe("celeba-cnn9").tasks
    assert tasks == tuple(f"attributes:{name}" for name in CELEBA.fields)
    assert len(set(tasks)) == 40


def test_attributes_are_those_of_the_list(tree):
    dataset = CELEBA(tree, "val", DATA, needs=CELEBA.fields)
    assert dataset.names[0] == "000013"
    line = (tree / ATTRIBUTES).read_text().splitlines()[2 + 12].split()
    frame = dataset.read("000013")
    assert [f"{2 * int(value) - 1}" for value in frame.fields.values()] == line[1:]
    assert frame.images_N3HW[0].shape == (3, 64, 64)


def test_a_good_tree(tree):
    report = CELEBA.check(tree, deep=True)
    lines = report.summary()
    assert report.problems == []
    assert lines[1] == "train: 12 images of 12 listed, 162770 published"
    assert lines[4].startswith("images 218x178, uint8, values ")
    assert sum("% have it" in line for line in lines) == 40


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: (t / PARTITION).unlink(), r"list_eval_partition.txt: missing; it comes with"),
        (lambda t: edit(t / ATTRIBUTES, "Bald", "Bold"), r"attr_celeba.txt:2: .* 40 attributes"),
        (lambda t: edit(t / ATTRIBUTES, " -1", " 0"), r"attr_celeba.txt:3: .* -1 or 1 stand here"),
        (lambda t: edit(t / PARTITION, " 1\n", " 7\n"), r"partition.txt:13: .* 0, 1 or 2 stand"),
        (lambda t: (t / IMAGES / "000013.jpg").unlink(), r"000013.jpg.*missing"),
        (lambda t: (t / IMAGES / "000013.jpg").write_text("x"), r"000013.jpg: .*damaged"),
    ],
)
def test_a_bad_tree(tree, spoil, message):
    spoil(tree)
    problems = "\n".join(CELEBA.check(tree, deep=True).problems)
    assert problems.count("\n") == 0
    with pytest.raises(ValueError, match=message):
        raise ValueError(problems)
    with pytest.raises(ValueError, match=message):
        CELEBA(tree, "val", DATA, needs=CELEBA.fields).read("000013")
