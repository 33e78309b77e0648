"""Pseudo labels of models that know the truth are the truth; what was there stays as it was."""

import hashlib
import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from cityscapes_tree import CAMERA, file, put_png
from cityscapesscripts.preparation.createPanopticImgs import convert2panoptic
from torch import nn
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core.config import Augment, Cell, Data, Evaluate, Loss, Network, PseudoLabels, Recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.files import write_json
from mtl_bench.core.labels import IGNORE, class_of_instance_id
from mtl_bench.core.plain import to_dict
from mtl_bench.core.task import tasks_of, tasks_of_cell
from mtl_bench.data import pseudo_frames
from mtl_bench.data import scenes as synthetic
from mtl_bench.data.cityscapes_files import LABELS, SEQUENCE, file_of, names_in, read_instance_ids
from mtl_bench.data.labels import CITYSCAPES20
from mtl_bench.data.samples import open_samples
from mtl_bench.data.scenes import render
from mtl_bench.evaluate.walk import evaluating
from mtl_bench.model import Outputs, build_model
from mtl_bench.tasks.panoptic import pseudo_labels
from mtl_bench.tasks.panoptic.pseudo_labels import RECORD, average, pass_sizes
from mtl_bench.tasks.panoptic.targets import panoptic_targets
from mtl_bench.train import checkpoint

HEIGHT, WIDTH = 64, 128
CPU = torch.device("cpu")
PLAIN = Augment(flip=False, brightness=0, contrast=0, saturation=0, hue=0)
CELL = Cell(
    Recipe(
        data=Data(dataset="cityscapes", height=HEIGHT, width=WIDTH),
        augment=PLAIN,
        network=Network(strides=(4, 8, 16)),
        loss=Loss(center_sigma=2),
        pseudo=PseudoLabels(scales=(1.0,), flip=False),
        evaluate=Evaluate(nms_kernel=3),  # stuff_area stays 2048: labels must not use it
    ),
    backbone="none",
    method="none",
)


def with_recipe(cell=CELL, **changes):
    return replace(cell, recipe=replace(cell.recipe, **changes))


def with_pseudo(**changes):
    return with_recipe(pseudo=replace(CELL.recipe.pseudo, **changes))


def panoptic_of(cell):
    return tasks_of(cell.recipe, ("panoptic",), CITYSCAPES20)[0]


def ensure(model, cell, root, out, progress=None):
    """Label the training split's frames."""
    frames = dataset_of(cell.recipe).frames_to_label(root, out, "train", cell.recipe)
    with evaluating(model):
        return panoptic_of(cell).label(model, frames, CPU, progress)


class Net(nn.Module):
    """A network that a function stands in for; it gives the panoptic maps."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def forward(self, image_B3HW):
        names = ("semantic", "center", "offset")
        return Outputs({"panoptic": dict(zip(names, self.answer(image_B3HW), strict=True))})


class Oracle(nn.Module):
    """Outputs made of the instance ids that `ids_of` tells for an image at its size.

    Args:
        doubt: [H,W] pixels whose classes are all equally probable.
    """

    def __init__(self, ids_of, doubt=None):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))
        self.ids_of, self.doubt, self.seen = ids_of, doubt, 0
        self.net = Net(self.answer)

    def answer(self, image_B3HW):
        assert not self.training
        assert torch.is_inference_mode_enabled()
        self.seen += len(image_B3HW)
        maps = zip(*[self.frame(self.ids_of(image)) for image in image_B3HW], strict=True)
        return [torch.stack(part) for part in maps]

    def frame(self, ids_HW):
        targets = panoptic_targets(ids_HW.astype(np.int32), CITYSCAPES20, CELL.recipe.loss)
        assert (targets.semantic != IGNORE).all()
        classes = torch.from_numpy(targets.semantic)
        logits = nn.functional.one_hot(classes, len(CITYSCAPES20)).permute(2, 0, 1) * 9.0
        if self.doubt is not None:
            logits[:, self.doubt] = 0
        # A Gaussian that is enlarged has several equal maxima; on a slope it has one
        slope = np.linspace(1, 0.9, ids_HW.size, dtype=np.float32).reshape(ids_HW.shape)
        center = torch.from_numpy(targets.center * slope)[None]
        return logits, center, torch.from_numpy(targets.offset)


def renumbered(ids_HW):
    """The same instances with the numbers that grouping gives: 1, 2, ... in reading order of their
    centers, over all classes. Numbers have no meaning beyond telling instances apart."""
    result = ids_HW.copy()
    centers = {}
    for value in np.unique(ids_HW[ids_HW >= 1000]).tolist():
        rows, columns = np.nonzero(ids_HW == value)
        center = (int(np.rint(rows.mean())), int(np.rint(columns.mean())))
        assert center not in centers, "two instances of one center cannot be told apart"
        centers[center] = value
    for number, center in enumerate(sorted(centers), 1):
        value = centers[center]
        result[ids_HW == value] = value // 1000 * 1000 + number
    return result


def written(folder, name):
    """The instance ids of a frame; its label ids must agree."""
    ids = read_instance_ids(file_of(folder, LABELS, name))
    label_ids = cv2.imread(
        str(file_of(folder, pseudo_frames.LABEL_IDS, name)), cv2.IMREAD_UNCHANGED
    )
    assert label_ids.dtype == np.uint8
    np.testing.assert_array_equal(label_ids, np.where(ids < 1000, ids, ids // 1000))
    return ids


def contents(folder):
    return {
        path.relative_to(folder): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def never(image):
    raise AssertionError("nothing is to be predicted")


# --- the built-in data set ------------------------------------------------------------------------

SCENES, FRAMES, SEED = 2, 5, 4


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Videos of 5 frames, the middle one annotated; no thing is too small for a number, as a crowd
    beside instances is nothing that grouping can tell: each of its pixels joins some center."""
    return synthetic.write(
        tmp_path_factory.mktemp("scenes") / "data",
        *(HEIGHT, WIDTH, SCENES, 0, 0, SEED, FRAMES),
        min_instance_area=1,
        processes=1,
        progress=False,
    )


@pytest.fixture(scope="module")
def truth():
    """Name -> true instance ids of every frame."""
    found = {}
    for number in range(SCENES):
        scene = render.draw_scene((SEED, 0, number), HEIGHT, WIDTH, FRAMES, FRAMES // 2)
        for frame in range(FRAMES):
            ids = render.instance_ids(render.truth(scene, frame), 1)
            found[f"syn00_{number:06d}_{frame:06d}"] = renumbered(ids)
    return found


@pytest.fixture(scope="module")
def knowing(scenes, truth):
    """Makes an oracle that recognises the built-in frames, and their mirror images."""
    known = {}
    for name, ids in truth.items():
        path = file_of(scenes / SEQUENCE.folder / "train", SEQUENCE, name)
        rgb = cv2.imread(str(path))[..., ::-1]
        known[rgb.tobytes()] = ids
        known[rgb[:, ::-1].tobytes()] = ids[:, ::-1]

    def make(change=lambda ids: ids, **options):
        def ids_of(image_3HW):
            rgb = (image_3HW.permute(1, 2, 0) * 255).round().byte().numpy()
            return change(known[rgb.tobytes()])

        return Oracle(ids_of, **options)

    return make


@pytest.fixture
def unlabelled(scenes, tmp_path):
    """The data set as it comes without its label package."""
    return shutil.copytree(scenes, tmp_path / "bare", ignore=shutil.ignore_patterns("gtFine"))


BETWEEN = [f"syn00_{scene:06d}_{frame:06d}" for scene in range(SCENES) for frame in (1, 3)]


@pytest.mark.parametrize("flip", [False, True])
def test_a_model_that_predicts_the_truth_writes_the_truth(scenes, truth, knowing, tmp_path, flip):
    before = contents(scenes)
    model = knowing()
    folder = ensure(model, with_pseudo(flip=flip), scenes, tmp_path / "out")
    assert model.seen == len(BETWEEN) * (1 + flip)
    assert folder == tmp_path / "out" / "gtFine" / "train"
    assert sorted(names_in(folder, LABELS)) == BETWEEN
    for name in BETWEEN:
        ids = written(folder, name)
        if flip:  # means of two heat maps can peak half a pixel off, and twice: other numbers
            ids = renumbered(ids)
        np.testing.assert_array_equal(ids, truth[name])
    values = np.unique(np.stack([truth[name] for name in BETWEEN]))
    assert (values >= 1000).sum() > 5
    assert 1 in values, "the ego vehicle, which is not evaluated"
    assert contents(scenes) == before


def test_without_human_labels_annotated_frames_are_labelled_too(
    scenes, unlabelled, truth, knowing, tmp_path
):
    folder = ensure(knowing(), CELL, unlabelled, tmp_path / "out")
    middle = f"syn00_000000_{FRAMES // 2:06d}"
    assert names_in(folder, LABELS) == {*BETWEEN, middle, middle.replace("000000_", "000001_")}
    human = read_instance_ids(file_of(scenes / "gtFine" / "train", LABELS, middle))
    np.testing.assert_array_equal(written(folder, middle), renumbered(human))
    assert not (unlabelled / "gtFine").exists()


def test_things_without_a_center_are_a_crowd(scenes, truth, knowing, tmp_path):
    def grouped(ids):
        return np.where(ids < 1000, ids, ids // 1000)

    folder = ensure(knowing(grouped), CELL, scenes, tmp_path / "out")
    for name in BETWEEN:
        np.testing.assert_array_equal(written(folder, name), grouped(truth[name]))


def test_less_certain_pixels_are_left_unlabeled(scenes, truth, knowing, tmp_path):
    doubt = np.zeros((HEIGHT, WIDTH), bool)
    doubt[:, 60:66] = True
    for limit, expected in ((0.5, 0), (0.04, 1)):  # 20 classes: 0.05 each, the first one wins
        model = knowing(doubt=doubt)
        out = tmp_path / str(limit)
        folder = ensure(model, with_pseudo(min_confidence=limit), scenes, out)
        for name in BETWEEN:
            np.testing.assert_array_equal(
                written(folder, name), np.where(doubt, expected, truth[name])
            )


def test_the_official_panoptic_writer_accepts_them(scenes, truth, knowing, tmp_path, capsys):
    ensure(knowing(), CELL, scenes, tmp_path / "out")
    for name in BETWEEN:
        put_png(file_of(tmp_path / "true" / "gtFine" / "train", LABELS, name), truth[name])
    results_of = {}
    for source in ("out", "true"):
        target = tmp_path / f"panoptic-{source}"
        target.mkdir()
        convert2panoptic(str(tmp_path / source / "gtFine"), str(target), setNames=["train"])
        results_of[source] = contents(target)
    assert results_of["out"] == results_of["true"]
    assert len(results_of["out"]) == len(BETWEEN) + 1


def test_labelled_frames_are_training_samples(scenes, truth, knowing, tmp_path):
    folder = ensure(knowing(), CELL, scenes, tmp_path / "out")
    tasks = tasks_of_cell(CELL)
    dataset = open_samples(
        CELL.recipe, tasks, "train", scenes, training=True, further_labels=folder
    )
    middle = [f"syn00_{scene:06d}_000002" for scene in range(SCENES)]
    assert dataset.names == sorted([*BETWEEN, *middle])
    name = BETWEEN[1]
    sample = dataset.sample(dataset.names.index(name), torch.Generator())
    classes = class_of_instance_id(CITYSCAPES20)[truth[name]]
    np.testing.assert_array_equal(sample.fields["semantic"].numpy(), classes)
    static = ~np.isin(truth[name], (1, 23))
    np.testing.assert_array_equal(sample.fields["reprojection_mask"].numpy(), static)


# --- stopped and continued ------------------------------------------------------------------------


def stop_after(frames):
    def progress(done, total):
        assert total == len(BETWEEN)
        if done == frames:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("frames", [0, 1, 3])
def test_stopped_and_called_again_it_writes_the_rest(
    scenes, knowing, tmp_path, monkeypatch, frames
):
    monkeypatch.setattr(pseudo_labels, "PIXELS", 2 * HEIGHT * WIDTH)  # batches of two
    whole = ensure(knowing(), CELL, scenes, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        ensure(knowing(), CELL, scenes, tmp_path / "out", stop_after(frames))
    folder = tmp_path / "out" / "gtFine" / "train"
    early = {path: path.stat().st_mtime_ns for path in folder.rglob("*.png")}
    assert len(early) == 2 * frames

    model, told = knowing(), []
    assert ensure(model, CELL, scenes, tmp_path / "out", lambda *n: told.append(n)) == folder
    assert told == [(done, 4) for done in range(frames, 5)]
    assert model.seen == {0: 4, 1: 4, 3: 2}[frames]  # whole batches, for the same last bits
    assert {path: path.stat().st_mtime_ns for path in early} == early
    assert contents(folder) == contents(whole)

    again = Oracle(never)
    ensure(again, CELL, scenes, tmp_path / "out", lambda *n: told.append(n))
    assert told[-1] == (4, 4)
    assert again.training, "its mode is as it was"


def test_a_frame_counts_once_its_instance_ids_are_there(scenes, knowing, tmp_path, monkeypatch):
    def fail(path, content, write=pseudo_frames._write):
        if path.name.endswith("instanceIds.png"):
            raise KeyboardInterrupt
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(pseudo_frames, "_write", fail)
        with pytest.raises(KeyboardInterrupt):
            ensure(knowing(), CELL, scenes, tmp_path / "out")
    folder = tmp_path / "out" / "gtFine" / "train"
    assert len(list(folder.rglob("*.png"))) == 1
    ensure(knowing(), CELL, scenes, tmp_path / "out")
    assert names_in(folder, LABELS) == set(BETWEEN)


# --- refusals -------------------------------------------------------------------------------------


def refused(message, model, cell, root, out):
    before = contents(out) if out.exists() else None
    with pytest.raises(ValueError, match=message) as error:
        ensure(model, cell, root, out)
    assert "\n" not in str(error.value)
    assert (contents(out) if out.exists() else None) == before


@pytest.mark.parametrize("where", [".", "gtFine", "gtFine/train", "gtFine/pseudo"])
def test_not_among_human_labels(scenes, unlabelled, where):
    for root in (scenes, unlabelled):
        refused("own labels belong there; choose another", Oracle(never), CELL, root, root / where)


def test_not_through_a_link(scenes, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "gtFine").symlink_to(scenes / "gtFine")
    refused("own labels belong there", Oracle(never), CELL, scenes, tmp_path / "out")


def test_not_where_labels_of_unknown_making_are(scenes, unlabelled):
    refused("not of this command's making", Oracle(never), CELL, unlabelled, scenes)


@pytest.fixture
def begun(scenes, knowing, tmp_path):
    ensure(knowing(), CELL, scenes, tmp_path / "out")
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("cell", "what"),
    [
        (with_pseudo(min_confidence=0.5), "min_confidence"),
        (with_pseudo(flip=True), "flip"),
        (with_pseudo(scales=(1.0, 2.0)), "passes, scales"),
        (with_recipe(evaluate=Evaluate(nms_kernel=5)), "nms_kernel"),
        (with_recipe(data=replace(CELL.recipe.data, height=32)), "input, passes"),
    ],
)
def test_not_among_labels_of_other_options(scenes, begun, cell, what):
    message = f"{re.escape(str(begun))} holds .* other {what}; choose another --out, or delete"
    refused(message, Oracle(never), cell, scenes, begun)


def test_not_among_labels_of_other_weights_or_data(scenes, begun, tmp_path):
    other = Oracle(never)
    other.weight.data += 1
    refused("other weights;", other, CELL, scenes, begun)
    changed = shutil.copytree(scenes, tmp_path / "changed")
    first = file(changed, SEQUENCE.folder, "syn00_000000_000000", "leftImg8bit.png")
    put_png(first, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    refused("other first frame;", Oracle(never), CELL, changed, begun)


def test_what_labels_do_not_depend_on_is_free(scenes, begun):
    cell = with_recipe(replace(CELL, seed=3), evaluate=Evaluate(nms_kernel=3, stuff_area=0))
    ensure(Oracle(never), cell, scenes, begun)


def test_a_damaged_record_is_named(scenes, begun):
    (begun / RECORD).write_text("{")
    refused(f"{RECORD} is damaged", Oracle(never), CELL, scenes, begun)


def test_what_cannot_be_labelled(scenes, knowing, tmp_path):
    out = tmp_path / "out"
    for wrong, message in (
        ({"scales": (1.0, 0.0)}, "must be > 0, not 0.0"),
        ({"scales": ()}, "must be non-empty"),
        ({"min_confidence": 1.5}, "must be <= 1, not 1.5"),
    ):
        with pytest.raises(ValueError, match=message):
            with_pseudo(**wrong)
    labelled = shutil.copytree(scenes, tmp_path / "labelled")
    for name in BETWEEN:
        path = file_of(labelled / "gtFine" / "train", LABELS, name)
        put_png(path, np.full((HEIGHT, WIDTH), 7, np.uint16))
    far = replace(CELL.recipe, data=replace(CELL.recipe.data, stride=3))
    refused("recipe.data.frames=4 or more", Oracle(never), CELL, labelled, out)
    refused("recipe.data.frames=8 or more", Oracle(never), replace(CELL, recipe=far), labelled, out)
    assert not out.exists()
    broken = knowing()
    broken.net = Net(lambda image: [map_ * torch.nan for map_ in broken.answer(image)])
    with pytest.raises(ValueError, match=r"not finite in a frame of .*syn00_000000_000001"):
        ensure(broken, CELL, scenes, out)
    assert not list(out.rglob("*.png"))


# --- scales and mirror images ---------------------------------------------------------------------


TASK = panoptic_of(CELL)


def ramps(image_B3HW):
    """Answers with what is linear across the image, and so survives any bilinear resize: the first
    two channels tell a pixel's place in the scene, whatever the size or side of the view."""

    height, width = image_B3HW.shape[2:]
    x, y = image_B3HW[:, :1], image_B3HW[:, 1:2]
    side = torch.sign(x[..., -1:] - x[..., :1])
    offset = torch.cat([(0.3 - y) * height, side * (0.8 - x) * width], 1)
    return torch.cat([x, 1 - x], 1).log(), y / 2 + 0.25, offset


def test_passes_agree_where_the_network_follows_the_image():
    rows, columns = torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5
    y, x = torch.meshgrid(rows / HEIGHT, columns / WIDTH, indexing="ij")
    image = torch.stack([x, y, x * 0])[None]
    plain = average(TASK, Net(ramps), image, [(HEIGHT, WIDTH)], flip=False)
    torch.testing.assert_close(plain["semantic"][:, :1], image[:, :1])
    inside = np.s_[..., 8:-8, 8:-8]  # borders are extended, which is not linear
    for scales, flip in (((1.0,), True), ((0.5, 1.0, 2.0), False), ((0.5, 1.5), True)):
        cell = with_pseudo(scales=scales)
        mean = average(TASK, Net(ramps), image, pass_sizes(cell.recipe), flip)
        assert mean.keys() == plain.keys()
        for name, whole in plain.items():
            torch.testing.assert_close(mean[name][inside], whole[inside], rtol=1e-4, atol=1e-4)


def test_passes_are_averaged():
    answers = iter((0.2, 0.6, 0.7))

    def net(image_B3HW):
        value = next(answers)
        shape = (1, 1, *image_B3HW.shape[2:])
        logits = torch.full(shape, value).logit()
        offset = torch.full((1, 2, *shape[2:]), 10 * value)
        return torch.cat([logits, logits * 0], 1), torch.full(shape, value), offset

    image = torch.zeros(1, 3, 16, 32)
    mean = average(TASK, Net(net), image, [(16, 32), (8, 32), (32, 16)], flip=False)
    torch.testing.assert_close(mean["semantic"][:, 0], torch.full((1, 16, 32), 0.5))
    torch.testing.assert_close(mean["center"], torch.full((1, 1, 16, 32), 0.5))
    y, x = 10 * (0.2 + 0.6 * 2 + 0.7 / 2) / 3, 10 * (0.2 + 0.6 + 0.7 * 2) / 3
    torch.testing.assert_close(mean["offset"][0, :, 0, 0], torch.tensor([y, x]))


def test_passes_have_sizes_that_the_network_divides():
    recipe = with_pseudo(scales=(0.1, 0.6, 1.0, 1.3)).recipe
    assert pass_sizes(recipe) == [(16, 16), (32, 80), (64, 128), (80, 160)]


def street(index):
    """A street of blocks of 2 x 2 pixels, so that half its size shows it whole."""
    ids = np.full((HEIGHT // 2, WIDTH // 2), 23, np.uint16)
    ids[14:] = 7
    ids[29:] = 1
    ids[12:16, 40] = 17  # a pole of a few pixels
    ids[10:18, 5 + index : 15 + index] = 26001
    ids[16:26, 26:38] = 26002
    ids[18:24, 50:53] = 24003
    return ids.repeat(2, 0).repeat(2, 1)


class StreetOracle(Oracle):
    """Knows a street by the image's corners, at any size; turns its answer with a mirrored one.

    Truth made of mirrored labels would not do: of a thing of even width the middle is rounded to
    the other side, and the mean of two such heat maps has two equal maxima.
    """

    def __init__(self):
        super().__init__(street)

    def answer(self, image_B3HW):
        assert torch.is_inference_mode_enabled()
        height, width = image_B3HW.shape[2:]
        parts = []
        for image in image_B3HW:
            left, right = (round(image[0, 0, x].item() * 255) for x in (0, -1))
            ids = self.ids_of(min(left, right) // 10)
            ids = cv2.resize(ids, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
            maps = self.frame(ids)
            if left > right:
                maps = [x.flip(-1) for x in maps]
                maps[2][1] *= -1
            parts.append(maps)
        return [torch.stack(part) for part in zip(*parts, strict=True)]


@pytest.fixture
def streets(tmp_path):
    """Five frames of one sequence, the middle one annotated; the images say which they are."""
    root = tmp_path / "streets"
    for frame in range(17, 22):
        image = np.full((HEIGHT, WIDTH, 3), 10 * (frame - 17), np.uint8)
        image[:, WIDTH // 2 :] += 5
        name = f"aachen_000000_{frame:06d}"
        put_png(file(root, "leftImg8bit_sequence", name, "leftImg8bit.png"), image)
    put_png(file(root, "leftImg8bit", "aachen_000000_000019", "leftImg8bit.png"), image)
    put_png(file(root, "gtFine", "aachen_000000_000019", "gtFine_instanceIds.png"), street(2))
    camera = file(root, "camera", "aachen_000000_000019", "camera.json")
    camera.parent.mkdir(parents=True)
    camera.write_text(json.dumps(CAMERA))
    return root


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (32, 64), (32, 128)])
@pytest.mark.parametrize(
    "options", [{}, {"flip": True}, {"scales": (1.0, 2.0)}, {"scales": (1.0, 2.0), "flip": True}]
)
def test_all_passes_and_sizes_give_the_labels_of_the_plain_one(streets, tmp_path, options, size):
    cell = with_pseudo(**options)
    data = replace(cell.recipe.data, height=size[0], width=size[1])
    folder = ensure(StreetOracle(), with_recipe(cell, data=data), streets, tmp_path / "out")
    for frame in (18, 20):
        ids = written(folder, f"aachen_000000_{frame:06d}")
        np.testing.assert_array_equal(ids, renumbered(street(frame - 17)))


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def trained(smoke_cell, tmp_path):
    """A run folder with a checkpoint of the smoke recipe, untrained."""
    return run_of(smoke_cell, tmp_path / "run")


def run_of(cell, directory):
    data = replace(cell.recipe.data, height=HEIGHT // 2, width=WIDTH // 2)
    cell = with_recipe(cell, data=data)
    directory.mkdir()
    write_json(directory / "cell.json", to_dict(cell))
    torch.manual_seed(0)
    state = {
        "format": checkpoint.FORMAT,
        "model": build_model(cell, tasks_of_cell(cell)).state_dict(),
    }
    torch.save(state, directory / "last.pt")
    return directory


def call(*words, code=0):
    result = CliRunner().invoke(app, ["pseudo-label", *(str(word) for word in words)])
    assert result.exit_code == code, result.output
    return result.output


def test_the_command_labels_goes_on_and_refuses(trained, unlabelled, tmp_path):
    out = tmp_path / "out"
    words = ("--checkpoint", trained, "--data", unlabelled, "--out", out, "--device", "cpu")
    words += ("--scales", "0.5,1", "--no-flip", "--min-confidence", "0.1")
    assert f"6 frames written, 0 there already: {out}/gtFine/train" in call(*words)
    record = json.loads((out / RECORD).read_text())
    assert record["scales"] == [0.5, 1.0]
    assert record["passes"] == [[16, 32], [32, 64]]
    assert (record["flip"], record["min_confidence"]) == (False, 0.1)
    ids = written(out / "gtFine" / "train", BETWEEN[0])
    assert ids.shape == (HEIGHT, WIDTH), "the frame's own size, not the recipe's"

    file_of(out / "gtFine" / "train", LABELS, BETWEEN[0]).unlink()
    words = ("--checkpoint", trained / "last.pt", *words[2:])
    assert "1 frames written, 5 there already" in call(*words)
    np.testing.assert_array_equal(written(out / "gtFine" / "train", BETWEEN[0]), ids)
    assert "made with other flip; choose another --out" in call(*words, "--flip", code=2)
    assert call(*words, "--quiet") == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scales", "1,x"], "--scales '1,x' is not numbers, such as"),
        (["--checkpoint", "nowhere"], "no run or checkpoint 'nowhere'"),
        (["--split", "tset"], "leftImg8bit/tset"),
    ],
)
def test_wrong_usage_of_the_command(trained, scenes, tmp_path, words, message):
    given = ("--checkpoint", trained, "--data", scenes, "--out", tmp_path / "out")
    output = call(*given, *words, code=2)
    assert message in output.replace("\n", "")
    assert not (tmp_path / "out").exists()


def test_a_cell_without_a_task_that_makes_labels_makes_none(smoke_cell, scenes, tmp_path):
    run = run_of(replace(smoke_cell, tasks=("depth",)), tmp_path / "depth")
    output = call("--checkpoint", run, "--data", scenes, "--out", tmp_path / "out", code=2)
    assert "has no task that makes labels" in output.replace("\n", " ")
    assert not (tmp_path / "out").exists()
