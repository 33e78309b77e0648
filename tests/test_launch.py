import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from mtl_bench.bench import claim, launch, results
from mtl_bench.cli.display import Lines, Running, duration, label
from mtl_bench.core import provenance
from mtl_bench.core.config import Cell, Recipe

FAKE = Path(__file__).with_name("fake_cell.py")


def cells(count):
    return [Cell(Recipe(), "tiny", "fixed", seed=seed) for seed in range(count)]


def fake(runs, action="ok", seconds=0.0, actions=None):
    """A command that behaves as told, for some seeds (or cells, by id) otherwise."""
    actions = actions or {}

    def command(cell):
        code = json.dumps(provenance.code(cell))
        chosen = actions.get(cell.id, actions.get(cell.seed, action))
        file = results.run_dir(cell, runs) / "cell.json"
        return [sys.executable, str(FAKE), chosen, str(seconds), code, str(file)]

    return command


def run(todo, runs, jobs=1, rerun=None, **behaviour):
    launcher = launch.Launcher(runs, fake(runs, **behaviour), Lines(quiet=True), jobs, rerun)
    states = launcher.run(todo)
    return [states[cell.id].word for cell in todo]


def history(runs):
    """[(word, slug, time, threads)]"""
    lines = (runs / "history.txt").read_text().splitlines()
    fields = [line.split() for line in lines]
    return [(f[0], f[1], float(f[2]), f[3]) for f in fields]


def wait_for(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def test_runs_each_cell_once_in_order_and_then_nothing(tmp_path):
    todo = cells(3)
    assert run(todo, tmp_path) == ["done"] * 3
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert starts == [cell.slug for cell in todo]
    assert launch.to_run(todo, tmp_path) == []
    assert results.load_cell(tmp_path / todo[0].slug / "cell.json") == todo[0]
    assert not (tmp_path / todo[0].slug / "claim").exists()


def test_a_failure_costs_one_cell_and_is_tried_again(tmp_path, capsys):
    todo = cells(4)
    actions = {0: "fail", 1: "crash", 2: "silent"}
    assert run(todo, tmp_path, actions=actions) == ["failed", "failed", "failed", "done"]
    why = [results.inspect(cell, tmp_path).why for cell in todo]
    assert why[0] == "ValueError: on purpose"
    assert why[1].startswith("killed by SIGKILL (out of memory?")
    assert why[1].endswith("about to crash")
    assert why[2] == "ended without a row"
    assert capsys.readouterr().out.count("FAILED") == 3  # quiet or not
    assert launch.to_run(todo, tmp_path) == todo[:3]
    assert run(todo[:3], tmp_path) == ["done"] * 3
    assert not (tmp_path / todo[0].slug / "failed.json").exists()


def test_jobs_run_side_by_side_never_more_and_share_the_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "cores", lambda: 8)
    run(cells(4), tmp_path, jobs=2, seconds=0.3)
    running = peak = 0
    for word, *_ in sorted(history(tmp_path), key=lambda event: event[2]):
        running += 1 if word == "start" else -1
        peak = max(peak, running)
    assert peak == 2
    assert {threads for *_, threads in history(tmp_path)} == {"4"}


def test_one_job_leaves_the_threads_alone(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert "OMP_NUM_THREADS" not in launch.child_environment(1)
    monkeypatch.setattr(launch, "cores", lambda: 2)
    assert launch.child_environment(3)["OMP_NUM_THREADS"] == "1"


def test_stale_rows_are_kept_until_asked_for(tmp_path, change_harness):
    todo = cells(2)
    run(todo, tmp_path)
    change_harness()
    assert launch.to_run(todo, tmp_path) == []
    assert "stale 2 (train, evaluate, time: harness changed; --rerun stale)" in launch.summary(
        todo, tmp_path
    )
    again = launch.to_run(todo, tmp_path, "stale")
    assert again == todo
    (tmp_path / todo[0].slug / "last.pt").write_text("of the old code")
    assert run(again, tmp_path, rerun="stale") == ["done"] * 2
    assert not (tmp_path / todo[0].slug / "last.pt").exists()
    aside = tmp_path / todo[0].slug / "set-aside-1"
    assert (aside / "last.pt").read_text() == "of the old code"
    assert {"row.json", "code.json", "cell.json"} <= {path.name for path in aside.iterdir()}


def test_rerun_all_and_failed_begin_at_step_0(tmp_path):
    todo = cells(2)
    run(todo, tmp_path, actions={1: "fail"})
    for cell in todo:
        (tmp_path / cell.slug / "last.pt").write_text("state")
    assert launch.to_run(todo, tmp_path, "all") == todo
    assert launch.to_run(todo, tmp_path) == launch.to_run(todo, tmp_path, "failed") == todo[1:]
    run(todo[1:], tmp_path, actions={1: "fail"})
    assert (tmp_path / todo[1].slug / "last.pt").exists()
    run(todo[1:], tmp_path, rerun="failed")
    assert not (tmp_path / todo[1].slug / "last.pt").exists()
    run(todo, tmp_path, rerun="all")
    assert not (tmp_path / todo[0].slug / "last.pt").exists()


def test_two_launchers_share_a_grid(tmp_path):
    todo, words = cells(6), []
    threads = [
        threading.Thread(target=lambda: words.append(run(todo, tmp_path, seconds=0.2)))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert words == [["done"] * 6] * 2
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert sorted(starts) == sorted(cell.slug for cell in todo)


def hold(directory, pid):
    directory.mkdir(parents=True, exist_ok=True)
    owner = {"pid": pid, "machine": claim._machine()}
    (directory / "claim").write_text(json.dumps(owner))


@pytest.mark.parametrize(("action", "word"), [("ok", "done"), ("fail", "failed")])
def test_a_cell_that_another_process_runs_is_waited_for(tmp_path, action, word):
    (cell,) = todo = cells(1)
    directory = tmp_path / cell.slug
    directory.mkdir()
    other = subprocess.Popen(fake(tmp_path, action, 0.6)(cell))
    wait_for(lambda: claim.claimed_by(directory) is not None)
    assert run(todo, tmp_path) == [word]
    other.wait()
    assert [w for w, *_ in history(tmp_path) if w == "start"] == ["start"]


def test_a_cell_whose_process_died_is_taken_over(tmp_path):
    (cell,) = todo = cells(1)
    other = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    hold(tmp_path / cell.slug, other.pid)
    threading.Timer(0.5, other.kill).start()
    assert run(todo, tmp_path) == ["done"]
    other.wait()


# --- cells that need others -----------------------------------------------------------------------


@pytest.fixture
def video():
    """A video cell and, before it, its parent."""
    child = Cell(Recipe(), "tiny", "fixed", video=True)
    return [*child.parents, child]


def test_parents_are_run_before_their_children_each_once(tmp_path):
    plain = Cell(Recipe(), "tiny", "fixed")
    own = [replace(plain, single_task=True), plain, replace(plain, video=True)]
    todo = launch.to_run(own, tmp_path)
    assert [cell.tasks for cell in todo[:2]] == [("panoptic",), ("depth",)]
    assert todo[2:] == own
    assert run(todo, tmp_path, jobs=2, seconds=0.3) == ["done"] * 5
    times = {(word, slug): when for word, slug, when, _ in history(tmp_path)}
    assert len(history(tmp_path)) == len(times) == 10
    for cell in own:
        for parent in cell.parents:
            assert times["end", parent.slug] <= times["start", cell.slug]


def test_a_waiting_child_keeps_nobody_from_running_and_keeps_its_place(tmp_path, video):
    parent, child = video
    others = cells(4)[1:]
    assert run([parent, child, *others], tmp_path, jobs=2, seconds=0.5) == ["done"] * 5
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert set(starts[:2]) == {parent.slug, others[0].slug}
    assert child.slug in starts[2:4]


def test_what_a_done_cell_needed_is_not_run_again(tmp_path, video):
    parent, child = video
    run(video, tmp_path)
    (tmp_path / parent.slug / "row.json").unlink()
    assert launch.to_run([child], tmp_path) == []
    assert launch.to_run([child], tmp_path, "all") == video
    assert launch.to_run(video, tmp_path) == [parent]


def test_a_failed_parent_leaves_its_child_missing(tmp_path, video, capsys):
    parent, child = video
    other = cells(2)[1]
    words = run([*video, other], tmp_path, actions={parent.id: "fail"})
    assert words == ["failed", "missing", "done"]
    line = f"NOT RUN  needs {parent.slug}, which is failed (ValueError: on purpose)"
    assert line in capsys.readouterr().out  # quiet or not
    assert not (tmp_path / child.slug).exists()
    assert launch.to_run([child], tmp_path) == video
    assert run(video, tmp_path) == ["done", "done"]


def test_a_stale_parent_is_not_used(tmp_path, video, change_harness, capsys):
    parent, child = video
    run([parent], tmp_path)
    change_harness()
    assert launch.to_run([child], tmp_path) == [child]
    assert run([child], tmp_path) == ["missing"]
    why = "train, evaluate, time: harness changed"
    line = f"needs {parent.slug}, which is stale ({why}; --rerun stale)"
    assert line in capsys.readouterr().out
    assert launch.to_run([child], tmp_path, "stale") == video
    assert run(video, tmp_path, rerun="stale") == ["done", "done"]


@pytest.mark.parametrize(("action", "words"), [("ok", ["done"]), ("fail", ["missing"])])
def test_a_parent_that_another_process_runs_is_waited_for(tmp_path, video, action, words):
    parent, child = video
    directory = tmp_path / parent.slug
    directory.mkdir()
    other = subprocess.Popen(fake(tmp_path, action, 0.8)(parent))
    wait_for(lambda: claim.claimed_by(directory) is not None)
    assert run([child], tmp_path) == words
    other.wait()
    starts = [slug for word, slug, *_ in history(tmp_path) if word == "start"]
    assert starts == [parent.slug, child.slug][: 1 + (action == "ok")]


LAUNCH = """
import json, signal, sys
from pathlib import Path
from mtl_bench.bench import launch
from mtl_bench.cli.display import Lines
sys.path.insert(0, {tests!r})
from test_launch import cells, fake

def interrupt(number, frame):
    raise KeyboardInterrupt
signal.signal(signal.SIGTERM, interrupt)
runs = Path({runs!r})
try:
    launch.Launcher(runs, fake(runs, seconds=60), Lines(), 2).run(cells(3))
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.fixture
def launcher(tmp_path):
    """A launcher in a process of its own, with two cells running."""
    code = LAUNCH.format(tests=str(FAKE.parent), runs=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    wait_for(lambda: len(list(tmp_path.glob("*/progress.json"))) == 2)
    yield process
    if process.poll() is None:
        process.kill()
    process.stdout.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interruption_reaches_the_cells_and_waits_for_them(launcher, tmp_path, number):
    launcher.send_signal(number)
    assert launcher.wait(20) == 130
    assert sorted(word for word, *_ in history(tmp_path)) == ["saved", "saved", "start", "start"]
    assert list(tmp_path.glob("*/claim")) == []
    assert list(tmp_path.glob("*/failed.json")) == []
    words = [results.status(cell, tmp_path) for cell in cells(3)]
    assert words == ["interrupted", "interrupted", "missing"]
    assert launch.to_run(cells(3), tmp_path) == cells(3)


def test_cells_end_with_a_launcher_that_was_killed(launcher, tmp_path):
    os.kill(launcher.pid, signal.SIGKILL)
    launcher.wait()
    wait_for(lambda: [w for w, *_ in history(tmp_path)].count("saved") == 2)
    wait_for(lambda: not list(tmp_path.glob("*/claim")))
    assert [results.status(cell, tmp_path) for cell in cells(2)] == ["interrupted"] * 2


def test_any_process_ends_with_a_launcher_that_was_killed(tmp_path):
    timing = (
        "import pathlib, os, time\nfrom mtl_bench import claim\nclaim.end_with_launcher()\n"
        f"pathlib.Path({str(tmp_path / 'pid')!r}).write_text(str(os.getpid()))\ntime.sleep(60)"
    )
    code = (
        "import subprocess, sys\nfrom mtl_bench import launch\n"
        f"subprocess.run([sys.executable, '-c', {timing!r}], env=launch.child_environment(1))"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    time.sleep(2 * claim.POLL_S)
    assert process.poll() is None  # while the launcher lives, so does it
    process.kill()
    process.wait()
    pid = int((tmp_path / "pid").read_text())
    wait_for(lambda: not Path(f"/proc/{pid}").exists(), seconds=5)


def test_an_interrupted_cell_is_no_failure(tmp_path):
    (cell,) = todo = cells(1)
    command = fake(tmp_path, seconds=60)
    runner = launch.Launcher(tmp_path, command, Lines(quiet=True))
    found = {}
    thread = threading.Thread(target=lambda: found.update(runner.run(todo)))
    thread.start()
    wait_for(lambda: (tmp_path / cell.slug / "progress.json").exists())
    os.kill(json.loads((tmp_path / cell.slug / "claim").read_text())["pid"], signal.SIGTERM)
    thread.join()
    assert found[cell.id].word == "interrupted"
    assert results.status(cell, tmp_path) == "interrupted"


# --- what is shown --------------------------------------------------------------------------------


def test_lines_tell_start_end_and_numbers(tmp_path, capsys):
    launch.Launcher(tmp_path, fake(tmp_path), Lines()).run(cells(1))
    start, end = capsys.readouterr().out.splitlines()
    assert "[1/1] fixed tiny s0  started" in start
    assert "[1/1] fixed tiny s0  done" in end
    assert "PQ 25.0  FPS 10.0" in end


def test_bars_show_running_and_ended_cells(tmp_path, monkeypatch):
    from rich import progress
    from rich.console import Console

    from mtl_bench.cli.display import Bars

    console = Console(file=(out := (tmp_path / "out.txt").open("w+")), width=120)
    monkeypatch.setattr(progress, "get_console", lambda: console)
    with Bars(2) as bars:
        launch.Launcher(tmp_path / "runs", fake(tmp_path / "runs", seconds=0.5), bars, 2).run(
            cells(2)
        )
    out.seek(0)
    text = out.read()
    assert "fixed tiny s1  done" in text
    assert "2/2" in text


def test_time_left_is_from_the_pace_in_this_stage(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    job = Running(1, 2, cells(1)[0], Path("x"))
    assert job.text == "starting"
    job.see({"stage": "train", "step": 50, "steps": 100, "note": "loss 2"})  # resumed
    assert job.left_s is None
    now[0] += 10
    job.see({"stage": "train", "step": 60, "steps": 100, "note": "loss 2"})
    assert job.left_s == pytest.approx(40)
    assert job.text == "train 60/100, 40s left  loss 2"
    job.see({"stage": "evaluate", "step": 0, "steps": 10})
    assert job.left_s is None


def test_labels_tell_cells_apart():
    plain = Cell(Recipe(), "net", "way")
    other = Cell(Recipe(), "net", "way", ("panoptic",), 2, True, method_args={"init": 0.5})
    assert label(plain) == "way net s0"
    assert label(other) == "way net s2 panoptic video init=0.5"
    apart = Cell(Recipe(), "net", "way", single_task=True, granularity="tasks")
    assert label(apart) == "way net s0 single-task by tasks"


def test_durations_and_headlines():
    assert [duration(s) for s in (12.4, 59.6, 250, 10950)] == ["12s", "1m00", "4m10", "3h02"]
    assert results.headline({"panoptic.pq": 34.1}) == "PQ 34.1"
    assert results.headline({}) == ""


def test_expected_hours_come_from_the_cells_that_are_done(tmp_path):
    todo = cells(3)
    assert launch.hours_to_run(todo, todo, tmp_path) is None
    run(todo[:1], tmp_path)  # the stand-in claims one hour
    apart = replace(todo[0], single_task=True)  # nothing is trained for it but its parents
    assert launch.hours_to_run([*todo[1:], apart], todo, tmp_path) == pytest.approx(2.0)
