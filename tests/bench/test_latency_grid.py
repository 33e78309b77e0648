"""A grid of latencies: what it expands to, what makes an id, running it, and its commands."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import fake_latency
import pytest
from typer.testing import CliRunner

from mtl_bench.bench import grid as grids
from mtl_bench.bench import jobs, launch, references, store
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.jobs import TIMINGS, Timing
from mtl_bench.cli.app import app
from mtl_bench.cli.display import Lines
from mtl_bench.core import config, fingerprint, locks
from mtl_bench.core.files import write_json
from mtl_bench.deploy import engines

FAKE = Path(__file__).parents[1] / "support" / "fake_timing.py"
GRID = """kind = "latency"
question = "How fast?"

[axes]
size = ["64x128", "32x64"]
backbone = ["tiny", "resnet18"]
engine = ["plain", "openvino", "tensorrt"]
precision = ["fp32", "bf16"]

[[skip]]
backbone = "resnet18"
size = ["32x64", "16x16"]
why = "too small"

[smoke]
size = "16x32"
engine = ["plain", "eager"]
passes = 2
"""


@pytest.fixture
def write(tmp_path):
    def write(text=GRID):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return str(path)

    return write


# --- the file -------------------------------------------------------------------------------------


def test_the_shipped_grid_has_what_the_paper_deploys():
    grid = load_grid("latency")
    assert grid.question.endswith("?")
    assert {t.size for t in grid.jobs} == {"384x1280", "512x1024", "1024x2048"}
    assert {t.tasks for t in grid.jobs} == {("panoptic",), ("panoptic", "depth")}
    assert {t.engine for t in grid.jobs} == set(engines.names())
    assert len({t.backbone for t in grid.jobs}) == 4
    assert {(t.passes, t.recipe, t.weights) for t in grid.jobs} == {(500, "paper", None)}
    assert len({t.id for t in grid.jobs}) == len(grid.jobs)
    TIMINGS.check(grid.jobs)


def test_it_stands_in_the_list_and_is_no_grid_of_cells():
    assert "latency" in grids.grid_names()
    assert grids.question_of("latency") == load_grid("latency").question
    with pytest.raises(ValueError, match="no cells to train"):
        _ = load_grid("latency").cells


def test_product_less_skips_and_precisions_that_an_engine_lacks(write):
    grid = load_grid(write())
    points = [(t.size, t.backbone, t.engine, t.precision) for t in grid.jobs]
    own = [("plain", "fp32"), ("openvino", "fp32"), ("openvino", "bf16"), ("tensorrt", "fp32")]
    places = [("64x128", "tiny"), ("64x128", "resnet18"), ("32x64", "tiny")]
    assert points == [(*place, *each) for place in places for each in own]
    reasons = [skip.why for skip in grid.skips]
    assert reasons.count("too small") == 6
    assert reasons.count("plain has no bf16 on cpu") == 3
    assert len(reasons) == 12


def test_on_cuda_the_engine_of_cuda_has_its_precisions(write):
    grid = load_grid(write(), device="cuda")
    assert {t.device for t in grid.jobs} == {"cuda"}
    assert {t.precision for t in grid.jobs if t.engine == "tensorrt"} == {"fp32", "bf16"}


def test_smoke_stands_in_place_of_axes_under_another_name(write):
    grid = load_grid(write(), smoke=True)
    assert grid.name == "mine-smoke"
    assert grid.smoke
    assert {(t.size, t.passes) for t in grid.jobs} == {("16x32", 2)}
    assert {t.engine for t in grid.jobs} == {"plain", "eager"}
    shipped = load_grid("latency", smoke=True)
    assert {t.engine for t in shipped.jobs} == {"plain", "eager", "onnxruntime", "openvino"}
    assert len(shipped.jobs) == 4
    assert not {t.id for t in shipped.jobs} & {t.id for t in load_grid("latency").jobs}


def test_settings_replace_an_axis_or_a_value(write):
    given = ["engine=plain", 'size=["8x8", "16x16", "8x8"]', "passes=7", "backbone.width=3"]
    grid = load_grid(write(), settings=given)
    assert {(t.engine, t.passes) for t in grid.jobs} == {("plain", 7)}
    assert [t.size for t in grid.jobs] == ["8x8", "8x8", "16x16"]  # equal ones count once
    assert {dict(t.backbone_args)["width"] for t in grid.jobs} == {3}
    grid = load_grid(write(), settings=['tasks=["depth"]', "quality.recipe=medium"])
    assert {t.tasks for t in grid.jobs} == {("depth",)}
    assert grid.quality == {"recipe": "medium"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"latency"', '"latncy"', r"line 1: no kind of grid 'latncy' \(did you mean 'latency'"),
        ("[smoke]", "[smok]", r"line 15: unknown key 'smok' \(did you mean 'smoke'"),
        ("[axes]", 'recipe = "small"\n[axes]', r"line 4: unknown key 'recipe'"),
        ("engine = [", "engin = [", r"line 7: unknown axis 'engin' \(did you mean 'engine'"),
        ('size = ["64x128", "32x64"]', 'size = ["64"]', r"size '64' is not HxW"),
        ('size = ["64x128", "32x64"]', "size = [64]", r"line 5: 'size' must be str, not 64"),
        ('engine = ["plain", "openvino", "tensorrt"]\n', "", r"line 4: axis 'engine' is missing"),
        ('why = "too small"\n', "", r"line 10: a \[\[skip\]\] needs its reason"),
        ('backbone = "resnet18"', 'bone = "x"', r"line 11: unknown key 'bone'"),
    ],
)
def test_mistakes_come_with_file_and_line(write, old, new, message):
    assert old in GRID
    with pytest.raises(ValueError, match=message):
        load_grid(write(GRID.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("pases=3", "unknown key 'pases' .did you mean 'passes'"),
        ("passes", "not key=value"),
        ("passes=x", "'passes' must be int"),
        ("recipe=smal", "no recipe called 'smal'"),
    ],
)
def test_wrong_settings(write, setting, message):
    with pytest.raises(ValueError, match=message):
        load_grid(write(), settings=[setting])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"engine": "openvin"}, "no engine called 'openvin' .did you mean 'openvino'"),
        ({"backbone": "resnet19"}, "resnet18"),
        ({"tasks": ("panoptik",)}, "no task called 'panoptik'"),
        ({"backbone_args": {"widht": 1}}, "backbone 'tiny' has no 'widht'"),
    ],
)
def test_what_a_timing_names_exists(changes, message):
    with pytest.raises(ValueError, match=message):
        TIMINGS.check([dataclasses.replace(Timing("tiny", "plain"), **changes)])


def test_the_backbones_axis_may_be_all(write):
    text = GRID.replace('backbone = ["tiny", "resnet18"]', 'backbone = "all"')
    assert len({t.backbone for t in load_grid(write(text)).jobs}) > 4


# --- identity -------------------------------------------------------------------------------------


def test_whatever_makes_the_number_makes_the_id():
    plain = Timing("tiny", "plain")
    changes = {
        "backbone": "resnet18",
        "engine": "eager",
        "precision": "bf16",
        "size": "64x128",
        "tasks": ("panoptic",),
        "device": "cuda",
        "passes": 50,
        "seconds": 3.0,
        "recipe": "small",
        "backbone_args": {"width": 2},
    }
    assert set(changes) == {f.name for f in dataclasses.fields(Timing)} - {"weights"}
    ids = {dataclasses.replace(plain, **{key: value}).id for key, value in changes.items()}
    assert len({*ids, plain.id}) == len(changes) + 1
    assert plain.id == Timing("tiny", "plain").id
    assert len(plain.id) == 12


def test_a_recipe_counts_by_its_values(tmp_path):
    same = tmp_path / "same.toml"
    same.write_text("[optim]\nsteps = 3\n")  # nothing that a forward pass sees
    assert Timing("tiny", "plain", recipe=str(same)).id == Timing("tiny", "plain").id


@pytest.fixture
def trained(tmp_path):
    """A run's folder as far as a timing reads it."""

    def trained(name="run", **changes):
        recipe = config.load_recipe(changes.pop("recipe", "smoke"))
        cell = config.Cell(recipe, changes.pop("backbone", "tiny"), "fixed", **changes)
        (tmp_path / name).mkdir()
        write_json(tmp_path / name / "cell.json", config.to_dict(cell))
        return tmp_path / name

    return trained


def test_weights_count_by_the_cell_that_trained_them(write, trained):
    first, second, other = trained("a"), trained("b"), trained("c", seed=1)

    def load(folder):
        given = [f"weights.tiny={folder}", "recipe=smoke", "engine=plain", "size=64x128"]
        return load_grid(write(), settings=given).jobs

    tiny, other_backbone = load(first)
    assert tiny.weights == str(first)
    assert other_backbone.weights is None
    assert load(second)[0].id == tiny.id
    assert load(other)[0].id != tiny.id
    command = jobs.timing_command(tiny, Path("row.json"))
    assert command[command.index("--checkpoint") + 1] == str(first / "last.pt")
    assert "--backbone" not in command


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"backbone": "resnet18"}, "trained resnet18"),
        ({"tasks": ("panoptic",)}, "no one network for the tasks panoptic, depth"),
        ({"single_task": True}, "no one network"),
        ({"recipe": "small"}, "another network: time it with --set recipe=small"),
    ],
)
def test_weights_that_do_not_fit_are_refused(write, trained, changes, message):
    given = [f"weights.tiny={trained(**changes)}", "recipe=smoke"]
    with pytest.raises(ValueError, match=message):
        load_grid(write(), settings=given)


def test_the_command_of_a_timing():
    one = Timing("tiny", "openvino", "bf16", "64x128", ("panoptic",), "cpu", 7, 2.5, "smoke")
    words = jobs.timing_command(one, Path("row.json"), Path("data"))[3:]
    text = " ".join(words)
    for part in (
        "latency --engine openvino --precision bf16 --size 64x128 --tasks panoptic --passes 7 "
        "--seconds 2.5",
        "--backbone tiny --recipe smoke",
        "--device cpu --data data --json row.json",
    ):
        assert part in text
    assert "--recipe" not in jobs.timing_command(Timing("tiny", "plain"), Path("x"))


# --- running --------------------------------------------------------------------------------------


@pytest.fixture
def timings(write):
    """Of three engines; TensorRT is nowhere."""
    given = ["size=64x128", "backbone=tiny", "precision=fp32"]
    return load_grid(write(), settings=given).jobs


class Said(Lines):
    """Keeps the lines, and whether each is about something that went well."""

    def __init__(self, lines):
        super().__init__()
        self.lines = lines

    def say(self, line):
        self.lines.append((line, True))

    def ended(self, run, line, ok):
        self.lines.append((line, ok))


@pytest.fixture
def take(tmp_path):
    """Runs timings with the stand-in; `take.said` is what it told, `take.history` who ran."""
    runs = tmp_path / "runs"
    runs.mkdir()

    def take(todo, actions=None, lack=None, **given):
        def command(one, file):
            action = (actions or {}).get(one.engine, "done")
            row = fake_latency.make_row(one.engine, one.backbone, size=one.size)
            row = {key: row[key] for key in row if key not in ("timing", "smoke")}
            if action == "wrong":
                row |= {"status": "wrong", "why": "logits differ by 3"}
                del row["metric"]
            return [sys.executable, str(FAKE), action, str(file), json.dumps(row)]

        missing = {"tensorrt": fake_latency.INSTALL} if lack is None else lack
        given["lack"] = lambda timing: missing.get(timing.engine)
        launch.Launcher(runs, command, Said(take.said), **given).run(todo)

    def history():
        file = runs / "latency" / "history.txt"
        return file.read_text().split() if file.is_file() else []

    take.said, take.runs, take.history = [], runs, history
    return take


def words(timings, runs):
    return [store.inspect(t, runs).word for t in timings]


def test_one_after_another_each_leaves_its_row(timings, take):
    take(timings, smoke=True)
    assert words(timings, take.runs) == ["done", "done", "unavailable"]
    assert take.history() == [t.id for t in timings[:2]]  # no process for what is not there
    row = json.loads((take.runs / "latency" / f"{timings[0].id}.json").read_text())
    assert row["timing"]["engine"] == "plain"
    assert row["smoke"] is True
    assert {stage: set(parts) for stage, parts in row["code"].items()} == {
        "time": {"backbone", "harness"}
    }
    assert row["seconds"] > 0
    lines = [line for line, _ in take.said]
    assert lines[0] == "[1/3] tiny panoptic,depth 64x128 plain fp32  started"
    assert "done" in lines[1]
    assert "FPS" in lines[1]
    assert "pip install mtl-bench[tensorrt]" in lines[-1]
    assert all(ok for _, ok in take.said)
    assert not list((take.runs / "latency").glob("*.new"))


def test_done_rows_are_reused_and_what_lacks_is_taken(timings, take):
    take(timings[:1])
    assert store.to_run(timings, take.runs) == list(timings[1:])
    take(timings[1:])
    assert store.to_run(timings, take.runs) == [timings[2]]  # it may be installed by now
    take([timings[2]], lack={})
    assert store.to_run(timings, take.runs) == []


@pytest.mark.parametrize(
    ("action", "why"),
    [
        ("fail", "exit code 1: RuntimeError: on purpose"),
        ("crash", "killed by SIGKILL"),
        ("silent", "ended without a row"),
    ],
)
def test_one_failing_timing_costs_its_row_only(timings, take, action, why):
    take(timings[:2], {"plain": action})
    assert words(timings[:2], take.runs) == ["failed", "done"]
    assert why in store.inspect(timings[0], take.runs).why
    (line,) = [line for line, ok in take.said if not ok]
    assert "FAILED" in line
    assert f"log: {take.runs}/latency/{timings[0].id}.log" in line
    assert store.to_run(timings[:2], take.runs) == [timings[0]]


def test_a_wrong_engine_has_no_time_and_is_tried_again_when_its_code_has_changed(
    timings, take, change_harness
):
    take(timings[:2], {"openvino": "wrong"})
    state = store.inspect(timings[1], take.runs)
    assert (state.word, state.why) == ("wrong", "logits differ by 3")
    assert store.to_run(timings[:2], take.runs) == []
    assert store.to_run(timings[:2], take.runs, "failed") == [timings[1]]
    change_harness()
    assert words(timings[:2], take.runs) == ["stale", "wrong"]  # it has no time to be stale
    assert store.to_run(timings[:2], take.runs) == [timings[1]]  # it may be right by now


def test_rerun(timings, take, change_harness):
    take(timings[:2])
    assert store.to_run(timings[:2], take.runs, "stale") == []
    assert store.to_run(timings[:2], take.runs, "all") == list(timings[:2])
    assert store.to_run(timings[:2], take.runs, "latency") == list(timings[:2])
    change_harness()
    state = store.inspect(timings[0], take.runs)
    assert (state.word, state.why) == ("stale", "time: harness changed")
    assert state.row is not None
    assert store.to_run(timings[:2], take.runs) == []
    assert store.to_run(timings[:2], take.runs, "stale") == list(timings[:2])


def test_a_time_depends_on_its_engine_and_not_on_training(timings):
    reached = {
        timing.engine: {
            path.relative_to(fingerprint.PACKAGE).as_posix()
            for path, _ in fingerprint.reach("time", jobs.roots(timing))
            if fingerprint.ours(path)
        }
        for timing in timings
    }
    assert "deploy/engines/openvino.py" in reached["openvino"]
    assert "deploy/engines/openvino.py" not in reached["plain"]
    for files in reached.values():
        assert {"deploy/timer.py", "deploy/maps.py", "core/task.py", "model/network.py"} <= files
        assert not files & {"train/loop.py", "data/cityscapes.py", "bench/store.py"}


def test_an_interruption_stops_the_process_and_leaves_no_row(timings, take):
    def interrupt():
        while not (take.runs / "latency" / "asleep").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        take(timings[:2], {"openvino": "sleep"})
    thread.join()
    assert time.monotonic() - began < 20
    assert words(timings[:2], take.runs) == ["done", "missing"]
    (take.runs / "latency" / "asleep").unlink()
    assert store.to_run(timings[:2], take.runs) == [timings[1]]
    take([timings[1]])
    assert words(timings[:2], take.runs) == ["done", "done"]


def test_a_second_launcher_is_refused(timings, take):
    with (
        locks.claim(take.runs / "latency"),
        pytest.raises(locks.ClaimedError, match=f"process {os.getpid()}"),
    ):
        take(timings[:1])
    assert take.history() == []


def test_cells_in_training_hold_still(timings, take):
    from mtl_bench.core.locks import Quiet

    seen = []

    def watch():
        while not (take.runs / "latency" / "running").exists():
            time.sleep(0.01)
        began = time.monotonic()
        Quiet(take.runs).pass_by()
        seen.append(time.monotonic() - began)

    thread = threading.Thread(target=watch)
    thread.start()

    def interrupt():
        while not (take.runs / "latency" / "asleep").exists():
            time.sleep(0.02)
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    stopper = threading.Thread(target=interrupt)
    stopper.start()
    with pytest.raises(KeyboardInterrupt):
        take(timings[:1], {"plain": "sleep"})
    thread.join()
    stopper.join()
    assert seen[0] > 0.3


def test_the_expected_duration_counts_passes_and_pixels(timings, take):
    assert store.hours_to_run(timings, timings, take.runs) is None
    take(timings[:1])
    row = store.inspect(timings[0], take.runs).row
    larger = dataclasses.replace(timings[1], size="128x256", passes=1000)
    hours = store.hours_to_run([larger], timings, take.runs)
    assert hours == pytest.approx(8 * row["seconds"] / 3600)


# --- commands -------------------------------------------------------------------------------------


@pytest.fixture
def ablate(tmp_path, write, take, monkeypatch):
    """The commands, with a stand-in for what takes a timing."""
    monkeypatch.chdir(tmp_path)
    write()
    row = {"status": "done", **fake_latency.make_row("plain", "tiny", size="64x128")}

    def command(one, file, data):
        action = actions.get(one.engine, "done")
        own = {**row, "engine": one.engine, "precision": one.precision, "smoke": False}
        own |= {"metric": fake_latency.metric(one, 10.0 if one.engine == "plain" else 5.0, 0.1)}
        del own["timing"]
        return [sys.executable, str(FAKE), action, str(file), json.dumps(own)]

    monkeypatch.setattr(jobs, "timing_command", command)
    monkeypatch.setattr(
        engines, "available", lambda name: fake_latency.INSTALL if name == "tensorrt" else None
    )
    actions = {}

    def ablate(*given, command="ablate", code=0):
        options = ["--set", "backbone=tiny", "--set", "size=64x128", "--set", "device=cpu"]
        words = [command, "--grid", "mine.toml", *options, *given]
        result = CliRunner().invoke(app, words)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == code, result.output
        return result.output

    ablate.actions, ablate.runs = actions, tmp_path / "runs"
    return ablate


def test_ablate_status_and_report(ablate, tmp_path):
    text = ablate("--dry-run")
    assert "4 timings of 500 passes on cpu = 3 engines x 2 precisions, less 2 skipped" in text
    assert "missing 4   to run 4" in text
    assert text.endswith("nothing was run (--dry-run)\n")
    assert "no timing of grid 'mine' is done" in ablate(command="report", code=2)
    text = ablate()
    assert "3 of 4 timings done; report: reports/mine/index.html" in text
    page = (tmp_path / "reports/mine/index.html").read_text()
    assert fake_latency.INSTALL in page
    text = ablate(command="status")
    assert "done 3   unavailable 1" in text
    assert "200.0" in text
    assert "skipped 1: plain has no bf16 on cpu" in text
    assert "to run 1" in ablate("--dry-run")  # TensorRT is looked for again
    assert ablate(command="report").endswith("reports/mine/index.html\n")


def test_a_failure_is_exit_code_1_and_the_report_is_there(ablate, tmp_path):
    ablate.actions["openvino"] = "fail"
    text = ablate("--quiet", code=1)
    assert "FAILED" in text
    assert "started" not in text
    assert "1 of 4 timings done" in text
    assert "on purpose" in (tmp_path / "reports/mine/table.md").read_text()
    assert "failed 2 (tried again by the next ablate)" in ablate(command="status")
    ablate.actions.clear()
    assert ablate("--quiet") == ""
    assert re.search(r"about \d+s one after another", ablate("--rerun", "all", "--dry-run"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--jobs", "2"), "--jobs 2: a latency is taken with nothing else of ours running"),
        (("--seeds", "3"), "--seeds 3: grid 'mine.toml' times, and trains nothing"),
        (("--pretrained", "timm"), "--pretrained timm: grid"),
        (("--wandb", "offline"), "--wandb offline"),
        (("--set", "engine=opnvino"), "no engine called 'opnvino'"),
    ],
)
def test_options_that_make_no_sense_are_told_in_one_line(ablate, words, message):
    text = ablate(*words, code=2)
    assert text.startswith("mtl-bench: ")
    assert message in text
    assert text.count("\n") == 1


def test_a_second_launcher_ends_with_one_line(ablate):
    with locks.claim(ablate.runs / "latency"):
        assert f"is being run by process {os.getpid()}" in ablate("--quiet", code=75)
        assert f"process {os.getpid()} is timing now" in ablate(command="status")


def test_quality_beside_the_speed_is_of_every_seed_that_is_done(monkeypatch, tmp_path):
    def rows(cells, runs):
        return [{"slug": c.slug, "status": "done" if c.seed < 2 else "missing"} for c in cells]

    monkeypatch.setattr(store, "rows", rows)
    grid = load_grid("latency")
    found = references.quality(grid, tmp_path)
    assert len(found) == 8
    assert references.quality(dataclasses.replace(grid, quality={}), tmp_path) == []


@pytest.mark.slow
def test_the_shipped_grid_runs_as_a_smoke(tmp_path):
    command = [sys.executable, "-m", "mtl_bench", "ablate", "--grid", "latency", "--smoke"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(path.read_text()) for path in (tmp_path / "runs/latency").glob("*.json")]
    assert {row["engine"] for row in rows} == {"plain", "eager", "onnxruntime", "openvino"}
    assert {row["status"] for row in rows} == {"done"}
    assert all(row["smoke"] for row in rows)
    page = (tmp_path / "reports/latency-smoke/index.html").read_text()
    assert "smoke: not a result" in page.lower()
