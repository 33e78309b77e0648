"""Cells that need others, whole, on the smoke recipe: single-task networks, the video stage."""

import json
from dataclasses import replace

import pytest
import torch
from typer.testing import CliRunner

from mtl_bench.bench import store
from mtl_bench.bench.jobs import with_parents
from mtl_bench.bench.run import run_cell
from mtl_bench.bench.stored import load_model, reevaluate
from mtl_bench.cli.app import app
from mtl_bench.core import locks
from mtl_bench.core.config import Cell, load_recipe, to_dict
from mtl_bench.core.files import write_json
from mtl_bench.core.task import tasks_of_cell
from mtl_bench.data import pseudo_frames
from mtl_bench.data.samples import open_samples
from mtl_bench.train import checkpoint
from mtl_bench.train.progress import Interrupted


@pytest.fixture(scope="module")
def cells():
    """Row -> cell: together, its video stage, and apart."""
    plain = Cell(load_recipe("smoke"), "tiny", "fixed_uncertainty")
    apart, video = replace(plain, single_task=True), replace(plain, video=True)
    panoptic, depth = apart.parents
    return {
        "together": plain,
        "video": video,
        "apart": apart,
        "panoptic": panoptic,
        "depth": depth,
    }


def execute(cell, runs, root):
    with locks.claim(store.run_dir(cell, runs)):
        directory, _ = store.begin(cell, runs)
        return run_cell(cell, directory, root, "cpu", echo=lambda line: None)


@pytest.fixture(scope="module")
def finished(cells, smoke_root, tmp_path_factory):
    """The run folders of all five cells."""
    runs = tmp_path_factory.mktemp("runs")
    for cell in with_parents([cells["apart"], cells["video"]]):
        execute(cell, runs, smoke_root)
    return runs


@pytest.fixture(scope="module")
def rows(cells, finished):
    return {name: store.load_row(finished / cell.slug) for name, cell in cells.items()}


def quality(row):
    return {k: v for k, v in row["metric"].items() if not k.startswith("latency.")}


def starting_with(prefixes, row):
    return {k: v for k, v in quality(row).items() if k.startswith(prefixes)}


# --- single tasks, side by side -------------------------------------------------------------------


def test_a_single_task_row_has_the_quality_of_each_network(rows):
    panoptic, depth = ("panoptic.", "semantic."), ("depth_median.", "depth.")
    assert starting_with(panoptic, rows["apart"]) == quality(rows["panoptic"])
    assert starting_with(depth, rows["apart"]) == starting_with(depth, rows["depth"])
    assert starting_with(panoptic, rows["apart"])
    assert starting_with(depth, rows["apart"])


def test_its_depth_gets_its_scale_from_the_other_networks_road(rows):
    assert rows["apart"]["protocol"]["dgc_ground"] == "predicted road"
    assert rows["depth"]["protocol"]["dgc_ground"] == "normals"
    assert (
        rows["apart"]["protocol"]["depth_range_m"] == rows["together"]["protocol"]["depth_range_m"]
    )


def test_its_cost_is_that_of_both(rows):
    alone = [rows["panoptic"], rows["depth"]]
    for key in ("latency.params_m", "latency.gmacs"):
        assert rows["apart"]["metric"][key] == pytest.approx(sum(r["metric"][key] for r in alone))
        assert rows["apart"]["metric"][key] > rows["together"]["metric"][key]
    weights_mib = sum(r["metric"]["latency.params_m"] for r in alone) * 4e6 / 2**20
    assert rows["apart"]["metric"]["latency.peak_mib"] > weights_mib
    for key in ("train_s", "step_ms"):
        assert rows["apart"]["time"][key] == sum(row["time"][key] for row in alone)
    assert rows["apart"]["time"]["peak_mib"] == max(row["time"]["peak_mib"] for row in alone)


def test_a_single_task_run_is_evaluated_again_from_its_parents(cells, finished, rows, smoke_root):
    directory = finished / cells["apart"].slug
    assert not (directory / "last.pt").exists()
    again = reevaluate(cells["apart"], directory / "last.pt", smoke_root, "cpu")
    assert again.metrics == quality(rows["apart"])


def test_a_row_says_what_kind_of_cell_it_is_of(rows):
    found = {name: (row["single_task"], row["video"], row["tasks"]) for name, row in rows.items()}
    both = ["panoptic", "depth"]
    assert found["apart"] == (True, False, both)
    assert found["video"] == (False, True, both)
    assert found["depth"] == (False, False, ["depth"])
    for row in rows.values():
        assert 50 < row["time"]["peak_mib"] < 1e5


# --- the video stage ------------------------------------------------------------------------------


def test_the_video_stage_labels_every_frame_that_it_can(cells, finished, rows, smoke_root):
    data = cells["video"].recipe.data
    frames = data.train_scenes * (data.frames - 3)
    assert rows["video"]["protocol"]["pseudo_frames"] == frames
    assert rows["video"]["time"]["pseudo_s"] > 0
    folder = finished / cells["video"].slug / "pseudo_labels"
    assert len(list(folder.rglob("*_instanceIds.png"))) == frames
    assert "pseudo_frames" not in rows["together"]["protocol"]


def test_it_goes_on_from_its_parents_weights(cells, finished, rows):
    before, after = (
        checkpoint.read(finished / cells[name].slug / "last.pt") for name in ("together", "video")
    )
    (counter, *_) = [key for key in before["model"] if key.endswith("num_batches_tracked")]
    steps = cells["video"].recipe.optim.steps
    assert before["step"] == after["step"] == before["model"][counter] == steps
    assert after["model"][counter] == 2 * steps
    assert quality(rows["video"]) != quality(rows["together"])


def test_it_trains_on_both_kinds_of_labels(cells, finished, smoke_root, tmp_path, monkeypatch):
    from mtl_bench.train import loop as train

    copy_parent(cells, finished, tmp_path)
    opened, open_samples = [], train.open_samples

    def spy(*given, **settings):
        opened.append(open_samples(*given, **settings))
        return opened[-1]

    monkeypatch.setattr(train, "open_samples", spy)
    row = execute(cells["video"], tmp_path, smoke_root)
    human = cells["video"].recipe.data.train_scenes
    assert [len(dataset) for dataset in opened] == [human + row["protocol"]["pseudo_frames"]]


def copy_parent(cells, finished, runs):
    (runs / cells["together"].slug).mkdir(parents=True)
    for name in ("row.json", "last.pt"):
        source = finished / cells["together"].slug / name
        (runs / cells["together"].slug / name).write_bytes(source.read_bytes())


def crash_in_labels(monkeypatch):
    write, count = pseudo_frames.CityscapesFrames.write, []

    def some(*given):
        count.append(1)
        if len(count) > 5:
            raise KeyboardInterrupt
        write(*given)

    monkeypatch.setattr(pseudo_frames.CityscapesFrames, "write", some)


def crash_in_training(monkeypatch):
    save = checkpoint.save

    def once(path, step, *given):
        save(path, step, *given)
        if step == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", once)


def crash_before_the_row(monkeypatch):
    def never(*given, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr("mtl_bench.bench.run.evaluate", never)


@pytest.mark.parametrize("crash", [crash_in_labels, crash_in_training, crash_before_the_row])
def test_stopped_anywhere_it_ends_with_the_same_row(
    cells, finished, rows, smoke_root, tmp_path, monkeypatch, crash
):
    copy_parent(cells, finished, tmp_path)
    with monkeypatch.context() as patched:
        crash(patched)
        with pytest.raises(KeyboardInterrupt):
            execute(cells["video"], tmp_path, smoke_root)
    assert store.status(cells["video"], tmp_path) == "interrupted"
    row = execute(cells["video"], tmp_path, smoke_root)
    assert quality(row) == quality(rows["video"])
    assert row["protocol"] == rows["video"]["protocol"]
    assert row["time"].keys() == rows["video"]["time"].keys()


def test_a_signal_during_the_labels_stops_it(cells, finished, smoke_root, tmp_path, monkeypatch):
    copy_parent(cells, finished, tmp_path)
    update = "mtl_bench.train.progress.Progress.update"
    monkeypatch.setattr(update, lambda self, stage, *given: setattr(self, "stop_asked", True))
    with pytest.raises(Interrupted, match="stopped at pseudo label 0 of 16"):
        execute(cells["video"], tmp_path, smoke_root)


def test_a_fresh_start_forgets_the_labels(cells, finished, tmp_path):
    folder = tmp_path / cells["video"].slug / "pseudo_labels" / "gtFine"
    folder.mkdir(parents=True)
    (tmp_path / cells["video"].slug / "taken.json").write_text("{}")
    store.clear(tmp_path / cells["video"].slug)
    assert list((tmp_path / cells["video"].slug).iterdir()) == []


# --- parents that are not there -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gone", "word"),
    [("last.pt", "here without its last.pt"), ("row.json", "interrupted"), ("", "stale")],
)
@pytest.mark.parametrize("child", ["video", "apart"])
def test_a_parent_without_a_usable_result_is_one_line(
    cells, finished, smoke_root, tmp_path, child, gone, word
):
    for parent in cells[child].parents:
        (tmp_path / parent.slug).mkdir()
        for name in {"row.json", "last.pt"} - {gone}:
            content = (finished / parent.slug / name).read_bytes()
            (tmp_path / parent.slug / name).write_bytes(content)
        if not gone:
            row = store.load_row(tmp_path / parent.slug)
            row["code"]["train"]["harness"] = "another"
            (tmp_path / parent.slug / "row.json").write_text(json.dumps(row))
    slug = cells[child].parents[0].slug
    with pytest.raises(ValueError, match=rf"this cell needs .*{slug}, which is {word}.*: run") as e:
        execute(cells[child], tmp_path, smoke_root)
    assert "\n" not in str(e.value)


def test_side_by_side_gives_each_networks_outputs(cells, finished):
    from mtl_bench.core.device import Compute

    compute = Compute(torch.device("cpu"), "fp32")
    apart, panoptic, depth = (
        load_model(cells[name], finished / cells[name].slug / "last.pt", compute).eval()
        for name in ("apart", "panoptic", "depth")
    )
    image = torch.rand(2, 3, 32, 64)
    both, first, second = (model.net(image) for model in (apart, panoptic, depth))
    for name, map_ in first.maps["panoptic"].items():
        assert torch.equal(both.maps["panoptic"][name], map_)
    assert torch.equal(both.maps["depth"]["inverse"], second.maps["depth"]["inverse"])
    assert both.maps.keys() == {"panoptic", "depth"}
    assert not any("pose" in name for name, _ in apart.named_parameters())


# --- only what changed code concerns ---


@pytest.fixture
def together(cells, finished, smoke_root):
    """`train CELL --stale` of a finished cell; its folder is afterwards as it was."""
    directory = finished / cells["together"].slug
    kept = {path: path.read_bytes() for path in directory.iterdir() if path.is_file()}

    def renew():
        arguments = ["train", str(directory / "cell.json"), "--stale", "--runs", str(finished)]
        done = CliRunner().invoke(app, [*arguments, "--data", str(smoke_root), "--device", "cpu"])
        assert done.exit_code == 0, done.output
        for name in ("last.pt", "curve.csv"):
            assert (directory / name).read_bytes() == kept[directory / name]
        assert not list(directory.glob("set-aside-*"))
        return done.output

    renew.state = lambda: store.inspect(cells["together"], finished)
    renew.directory = directory
    yield renew
    for path, content in kept.items():
        path.write_bytes(content)


def test_a_stale_evaluation_is_made_again_from_the_checkpoint(together, rows, change_harness):
    row = dict(rows["together"], metric=rows["together"]["metric"] | {"panoptic.pq": -1.0})
    write_json(together.directory / "row.json", row)
    change_harness("evaluate")
    assert together.state().why == "evaluate: harness changed"
    text = together()
    assert "evaluated in" in text
    assert "timed" not in text
    state = together.state()
    assert (state.word, state.row["metric"]) == ("done", rows["together"]["metric"])
    assert state.row["code"]["evaluate"]["harness"] == "edited"
    assert state.row["code"]["train"] == row["code"]["train"]
    assert "done already" in together()


AGAIN = {"latency.mean_ms": 12.5, "latency.p50_ms": 12.0}


def test_a_stale_latency_is_taken_again(together, rows, change_harness, monkeypatch):
    monkeypatch.setattr("mtl_bench.bench.stored.measure", lambda *given: dict(AGAIN))
    change_harness("time")
    text = together()
    assert "timed again" in text
    assert "evaluated" not in text
    state = together.state()
    assert state.word == "done"
    assert state.row["metric"] == rows["together"]["metric"] | AGAIN


FLAT = {"method": "a", "backbone": "b", "harness": "c"}


def test_a_row_of_an_older_version_is_stamped_anew_if_its_checkpoint_gives_it_back(together, rows):
    write_json(together.directory / "row.json", rows["together"] | {"code": FLAT})
    assert together.state().why == "stamped by an older version"
    assert "every metric is that of the row" in together()
    assert together.state().word == "done"
    assert together.state().row == rows["together"]


def test_and_otherwise_it_is_stale_for_training(together, rows):
    row = dict(rows["together"], code=FLAT, metric=dict(rows["together"]["metric"]))
    row["metric"]["panoptic.pq"] += 1e-12
    write_json(together.directory / "row.json", row)
    assert "1 of" in together()
    state = together.state()
    assert (state.word, state.trained) == ("stale", False)
    assert "its checkpoint does not give its row's metrics" in state.why
    assert state.row["metric"] == row["metric"]


# --- only the latency again -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["together", "apart"])
def test_latency_alone_can_be_taken_again(name, cells, finished, rows, smoke_root, monkeypatch):
    cell, before = cells[name], rows[name]
    seen = []
    monkeypatch.setattr(
        "mtl_bench.bench.stored.measure",
        lambda *given: seen.append(given) or dict(AGAIN),
    )
    arguments = [str(finished / cell.slug / "cell.json"), "--latency", "--runs", str(finished)]
    done = CliRunner().invoke(app, ["train", *arguments, "--data", str(smoke_root)])
    assert done.exit_code == 0, done.output
    assert "12.5 ms a frame" in done.output
    tasks, split = tasks_of_cell(cell), cell.recipe.evaluate.split
    frame = open_samples(cell.recipe, tasks, split, smoke_root, training=False).sample(0, None)
    assert frame.camera.pitch_rad_B != 0
    assert seen[0][2].pitch_rad_B == frame.camera.pitch_rad_B
    after = store.load_row(finished / cell.slug)
    assert after["metric"] == before["metric"] | AGAIN
    assert after["time"].keys() == before["time"].keys()
    assert {k: after[k] for k in ("cell", "code", "env")} == {
        k: before[k] for k in ("cell", "code", "env")
    }
    write_json(finished / cell.slug / "row.json", before)


def test_there_is_no_latency_to_take_again_without_a_row(cells, tmp_path, smoke_root):
    write_json(tmp_path / "cell.json", to_dict(cells["together"]))
    arguments = ["train", str(tmp_path / "cell.json"), "--latency", "--runs", str(tmp_path)]
    done = CliRunner().invoke(app, [*arguments, "--data", str(smoke_root)])
    assert done.exit_code == 2
    assert "no latency to take again" in done.output


def test_a_grid_times_its_finished_cells_again(cells, finished):
    todo = [cells["together"], replace(cells["together"], seed=7)]
    assert store.to_run(todo, finished, "latency") == todo
    assert store.to_run(todo, finished) == todo[1:]
