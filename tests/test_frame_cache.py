"""The cache of decoded frames changes nothing but the time; broken data is one line everywhere."""

import dataclasses
import os
import shutil
from itertools import islice

import cv2
import numpy as np
import pytest
import torch
from cityscapes_tree import HEIGHT, WIDTH, file, instance_ids, open_tree, put_png, write_tree
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import config
from mtl_bench.data import frame_cache
from mtl_bench.data.loader import eval_batches, train_batches

NAME = "aachen_000000_000019"
SMALL = config.Data(height=HEIGHT, width=WIDTH, cache=False)
AUGMENT = config.Augment(scales=(0.75, 1.0, 1.5), crop=(20, 30))


@pytest.fixture
def tree(tmp_path):
    """Frames twice as large as the input, so that caching shrinks them."""
    root = tmp_path / "tree"
    for split in ("train", "val"):
        write_tree(root, 3, split, size=(2 * HEIGHT, 2 * WIDTH))
    return root


def reader(root, split="train", data=SMALL, **changes):
    return open_tree(root, split, data=data, **{"augment": AUGMENT, **changes})


def fill(dataset, training=True):
    sources = dataset.sources(training)
    assert list(frame_cache.build(dataset.on_disk, sources)) == list(range(1, len(sources) + 1))
    return sources


def take(dataset, workers=0, count=2):
    return list(islice(train_batches(dataset, 3, seed=5, workers=workers), count))


def assert_same(ones, others):
    for one, two in zip(ones, others, strict=True):
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(two, field.name)
            same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
            assert same, field.name


def spoil(path):
    """Other bytes, but the size and time of before: only who opens the file sees it."""
    state = path.stat()
    path.write_bytes(bytes(state.st_size))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


# --- what is read ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (2 * HEIGHT, 2 * WIDTH)])
@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("in_memory", [False, True])
def test_samples_are_the_same_and_come_from_the_cache(tree, size, workers, in_memory):
    data = config.Data(height=size[0], width=size[1], cache=in_memory)
    expected = take(reader(tree, data=data), workers)
    sources = fill(reader(tree, data=data))
    assert len(sources) == 3 * 3 + 3
    for path, _ in sources:
        spoil(path)
    assert_same(take(reader(tree, data=data), workers), expected)


def test_evaluation_is_the_same_and_its_truth_keeps_its_size(tree):
    def batches():
        return list(eval_batches(reader(tree, "val", augment=None), 2))

    expected = batches()
    images = fill(reader(tree, "val", augment=None), training=False)
    assert [content.what for _, content in images] == ["image"] * 3
    for path, _ in images:
        spoil(path)
    assert_same(batches(), expected)
    assert expected[0].instance_ids_BHW.shape[1:] == (2 * HEIGHT, 2 * WIDTH)


def test_each_task_caches_its_own_files(tree):
    def kinds(**tasks):
        sources = reader(tree, **tasks).sources(training=True)
        return [content.what for _, content in sources]

    assert kinds(video=False) == ["image"] * 3 + ["label map"] * 3
    assert kinds(panoptic=False) == ["image"] * 9 + ["label map"] * 3
    shutil.rmtree(tree / "gtFine")
    assert kinds(panoptic=False) == ["image"] * 9


def test_another_size_is_another_cache(tree):
    fill(reader(tree))
    larger = config.Data(height=2 * HEIGHT, width=2 * WIDTH, cache=False)
    batch = take(reader(tree, data=larger), count=1)[0]
    assert batch.image_B3HW.shape[-2:] == (20, 30)
    assert all(reader(tree, data=larger).on_disk.lacks(p) for p in tree.rglob("*_leftImg8bit.png"))


# --- what has changed or is damaged ---------------------------------------------------------------


@pytest.mark.parametrize("workers", [0, 1])
def test_changed_data_is_noticed_and_cached_again(tree, workers):
    fill(reader(tree))
    path = file(tree, "gtFine", NAME, "gtFine_instanceIds.png")
    put_png(path, np.full((2 * HEIGHT, 2 * WIDTH), 8, np.uint16))
    message = f"^{path}: changed since it was cached in {tree}/frame_cache/{HEIGHT}x{WIDTH}; run"
    with pytest.raises(ValueError, match=message) as error:
        take(reader(tree), workers)
    assert "\n" not in str(error.value)
    dataset = reader(tree)
    assert [p for p, _ in dataset.sources(training=True) if dataset.on_disk.lacks(p)] == [path]
    fill(dataset)
    cached = take(dataset, workers)
    shutil.rmtree(tree / "frame_cache")
    assert_same(take(reader(tree), workers), cached)


@pytest.mark.parametrize("damage", [b"", b"x" * 5000, "cut", "longer"])
def test_a_damaged_cache_is_one_line(tree, damage):
    dataset = reader(tree)
    fill(dataset)
    source = file(tree, "leftImg8bit", NAME, "leftImg8bit.png")
    stored = tree / "frame_cache" / f"{HEIGHT}x{WIDTH}" / source.relative_to(tree)
    stored = stored.with_name(stored.name + ".frame")
    whole = stored.read_bytes()
    other = {"cut": whole[:-1], "longer": whole + b"\0"}
    stored.write_bytes(other[damage] if isinstance(damage, str) else damage)
    with pytest.raises(ValueError, match=f"^{stored}: damaged; run 'mtl-bench data cache'"):
        take(dataset)
    assert dataset.on_disk.lacks(source)
    fill(dataset)
    assert stored.read_bytes() == whole


def test_a_stopped_build_leaves_whole_files_and_goes_on(tree):
    dataset = reader(tree)
    sources = dataset.sources(training=True)
    broken = sources[5][0]
    original = broken.read_bytes()
    broken.write_bytes(original[:100])
    with pytest.raises(ValueError, match=f"^{broken}: truncated PNG"):
        list(frame_cache.build(dataset.on_disk, sources))
    assert not list(tree.rglob("*.tmp"))
    missing = [source for source in sources if dataset.on_disk.lacks(source[0])]
    assert sources[5] in missing
    assert not set(sources[:5]) & set(missing)
    broken.write_bytes(original)
    list(frame_cache.build(dataset.on_disk, missing))
    assert not any(dataset.on_disk.lacks(path) for path, _ in sources)


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        f'[data]\ndataset = "cityscapes"\nheight = {HEIGHT}\nwidth = {WIDTH}\ncache = false\n'
    )
    return path


def command(*words):
    return CliRunner().invoke(app, ["data", "cache", *map(str, words)])


def test_command_says_what_it_takes_and_goes_on(tree, recipe):
    first = command("--recipe", recipe, "--data", tree)
    assert first.exit_code == 0, first.output
    assert "12 images and 3 label maps at 16x32: 0.00 GB" in first.output
    assert f"in {tree}/frame_cache/16x32, 0 there already" in first.output
    assert "15 files written" in first.output
    next((tree / "frame_cache").rglob("*.frame")).unlink()
    again = command("--recipe", recipe, "--data", tree)
    assert "14 there already" in again.output
    assert "1 files written" in again.output
    assert command("--recipe", recipe, "--data", tree, "-q").stdout == ""


def test_another_place_is_found_by_the_environment(tree, recipe, tmp_path, monkeypatch):
    place = tmp_path / "fast disk"
    result = command("--recipe", recipe, "--data", tree, "--out", place)
    assert f"set MTL_BENCH_FRAME_CACHE={place} where cells run" in result.output
    assert not (tree / "frame_cache").exists()
    monkeypatch.setenv("MTL_BENCH_FRAME_CACHE", str(place))
    dataset = reader(tree)
    assert not any(dataset.on_disk.lacks(path) for path, _ in dataset.sources(training=True))


def test_a_full_disk_and_wrong_tasks_are_one_line(tree, recipe, monkeypatch):
    result = command("--recipe", recipe, "--data", tree, "--tasks", "dept")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "--tasks 'dept': choose from panoptic, depth" in result.stderr
    free = shutil.disk_usage(tree)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: free)
    result = command("--recipe", recipe, "--data", tree)
    assert result.exit_code == 2
    assert "the cache takes 0.0 GB, and 0.0 GB are free" in result.stderr
    assert not (tree / "frame_cache").exists()


# --- broken trees ---------------------------------------------------------------------------------


def no_calibration(root):
    path = file(root, "camera", NAME, "camera.json")
    path.unlink()
    return f"{path}: missing, one of 1 camera files"


def bad_calibration(root):
    path = file(root, "camera", NAME, "camera.json")
    path.write_text("{}")
    return f"{path}: no 'intrinsic' in this camera file"


def truncated(root):
    path = file(root, "leftImg8bit_sequence", "aachen_000000_000020", "leftImg8bit.png")
    path.write_bytes(path.read_bytes()[:-20])
    return f"{path}: truncated PNG"


def wrong_size(root):
    path = file(root, "gtFine", NAME, "gtFine_instanceIds.png")
    put_png(path, instance_ids())
    return f"{path}: {HEIGHT}x{WIDTH} pixels, but {NAME}_leftImg8bit.png has {2 * HEIGHT}x"


def too_small(root):
    for path in root.rglob("train/**/*000000_0000*.png"):
        put_png(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[: HEIGHT - 1])
    path = file(root, "leftImg8bit", NAME, "leftImg8bit.png")
    return f"{path}: {HEIGHT - 1}x{2 * WIDTH} pixels, fewer than the recipe's {HEIGHT}x{WIDTH}"


def no_neighbour(root):
    path = file(root, "leftImg8bit_sequence", "aachen_000000_000018", "leftImg8bit.png")
    path.unlink()
    return f"{path}: missing, one of 1 neighbour frames"


def sixteen_bits(root):
    path = file(root, "leftImg8bit", NAME, "leftImg8bit.png")
    put_png(path, np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint16))
    return f"{path}: 16-bit PNG where 8 bits"


def eight_bit_labels(root):
    path = file(root, "gtFine", NAME, "gtFine_instanceIds.png")
    put_png(path, np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8))
    return f"{path}: 8-bit PNG where 16 bits"


def empty_split(root):
    shutil.rmtree(root / "leftImg8bit/train/aachen")
    shutil.rmtree(root / "leftImg8bit/train/bochum")
    return f"{root}/leftImg8bit/train: no *_leftImg8bit.png in it"


BREAKS = [no_calibration, truncated, wrong_size, too_small, no_neighbour]
BREAKS += [sixteen_bits, eight_bit_labels, empty_split]


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("breaks", [*BREAKS, bad_calibration])
def test_a_broken_tree_is_one_line_from_any_process(tree, breaks, workers):
    message = breaks(tree)
    with pytest.raises(ValueError) as error:
        take(reader(tree), workers)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("breaks", [b for b in BREAKS if b is not wrong_size])
def test_a_broken_tree_is_one_line_when_it_is_cached(tree, recipe, breaks):
    message = breaks(tree)
    result = command("--recipe", recipe, "--data", tree)
    assert result.exit_code == 2, result.output
    assert f"mtl-bench: {message}" in result.stderr


@pytest.mark.parametrize("workers", [0, 1])
def test_sizes_and_cameras_are_compared_behind_the_cache_too(tree, workers):
    size = wrong_size(tree)
    fill(reader(tree))
    with pytest.raises(ValueError) as error:
        take(reader(tree), workers)
    assert str(error.value).startswith(size)
    write_tree(tree, 1, size=(2 * HEIGHT, 2 * WIDTH))
    fill(reader(tree))
    camera = bad_calibration(tree)
    with pytest.raises(ValueError) as error:
        take(reader(tree), workers)
    assert str(error.value).startswith(camera)
