"""Commands, messages and exit codes; nothing is trained here."""

import json
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest
from launching import fake, history, hold
from typer.testing import CliRunner

from mtl_bench.bench import jobs, store
from mtl_bench.bench.grid import load_grid
from mtl_bench.cli import options
from mtl_bench.cli.app import app
from mtl_bench.core import fingerprint, plugins, provenance
from mtl_bench.core.config import Cell, Recipe, load_recipe
from mtl_bench.core.files import write_json
from mtl_bench.core.locks import CLAIMED

GRID = """question = "Does it work?"
recipe = "smoke"

[axes]
backbone = ["tiny"]
method = ["fixed"]
seed = [0, 1]
"""


@pytest.fixture(autouse=True)
def isolated(tmp_path, monkeypatch):
    """An empty working directory, and no plug-in folders but the package's own."""
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("mtl_bench.data.scenes.make.render_all", refuse_to_render)
    monkeypatch.chdir(tmp_path)


def refuse_to_render(*args, **settings):
    raise AssertionError("a test of the command line may not render")


def call(*words, code=0):
    """The output of a command that must end with this exit code."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def one_line(*words):
    """The line that a command says instead of running."""
    text = call(*words, code=2)
    assert text.startswith("mtl-bench: ")
    assert text.count("\n") == 1, text
    return text


# --- looking around -------------------------------------------------------------------------------


def test_list_has_everything_and_says_what_it_is():
    text = call("list")
    for word in ("fixed_uncertainty", "resnet18", "smoke", "backbones", "Which backbone"):
        assert word in text
    assert "Kendall" in call("list", "methods", "-v")
    assert "resnet18" not in call("list", "methods")


def test_list_survives_a_broken_plugin(tmp_path):
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "odd.py").write_text("def (:\n")
    text = call("list", "methods")
    assert "odd" in text
    assert "BROKEN: SyntaxError" in text
    assert "fixed_uncertainty" in text


@pytest.mark.parametrize("kind", ["method", "backbone"])
def test_new_writes_what_check_passes(kind, tmp_path):
    call("new", kind, "my_own")
    assert (tmp_path / f"{kind}s" / "my_own.py").is_file()
    assert "my_own" in call("list", f"{kind}s")
    text = call("check", "my_own")
    assert "FAILED" not in text
    assert text.count("  ok") >= 4
    assert "there is a" in one_line("new", kind, "my_own")


def test_new_in_a_folder_and_check_by_file(tmp_path):
    call("new", "method", "mine", "--dir", "place")
    path = tmp_path / "place" / "mine.py"
    assert "mine" not in call("list", "methods")
    assert "Mine: one line" in call("list", "methods", "--plugins", "place")
    path.write_text(path.read_text().replace("fixed_K * step.loss_K", "step.loss_K * float('nan')"))
    assert "FAILED" in call("check", path, code=1)
    assert "is no name" in one_line("new", "method", "Not-A-Name")


def test_check_of_something_else(tmp_path):
    assert "did you mean 'fixed'" in one_line("check", "fixd")
    (tmp_path / "x.py").write_text("x = 1\n")
    assert "is none: a plug-in imports" in one_line("check", "x.py")
    assert "no plug-in folder or file" in one_line("check", "gone.py")


def test_env_tells_the_fingerprint_and_the_versions():
    text = call("env", "--device", "cpu")
    for stage, roots in provenance.HARNESS_ROOTS.items():
        assert f"{stage} {fingerprint.fingerprints(stage, roots)['harness']}" in text
    for word in ("torch", "timm", "python", "threads", "git_commit"):
        assert word in text


# --- wrong usage ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("ablate --grid backbone", "no grid called 'backbone' (did you mean 'backbones'?)"),
        ("status --grid backbone", "did you mean 'backbones'"),
        ("report --grid backbone", "did you mean 'backbones'"),
        ("report --grid backbones", "no cell of grid 'backbones' is done in 'runs'"),
        ("ablate --grid backbones --recipe smal", "no recipe called 'smal' (did you mean 'small'"),
        ("ablate --grid backbones --set recipe.optim.lrr=1", "did you mean 'lr'"),
        ("ablate --grid backbones --set method.innit=1", "has no 'innit' (did you mean 'init'?)"),
        ("ablate --grid backbones --set method=fixd", "no method called 'fixd' (did you mean"),
        ("ablate --grid backbones --seeds 0", "at least 1"),
        ("ablate --grid backbones --data gone", "no data folder 'gone'"),
        ("ablate --grid backbones --data .", "no data set in '.'"),
        ("ablate --grid backbones --recipe cityscapes", "say where it is, --data DIR"),
        ("ablate --grid backbones --pretrained gone.pth", "no weights file 'gone.pth'"),
        ("ablate --grid backbones --plugins gone", "no plug-in folder or file 'gone'"),
        ("train --backbone resnet --method fixed", "no backbone called 'resnet' (did you mean"),
        ("train --backbone tiny --method fxed", "no method called 'fxed' (did you mean 'fixed'"),
        ("train --backbone tiny --method fixed --recipe x", "no recipe called 'x' (known:"),
        ("train --backbone tiny --method fixed --tasks dept", "'dept' (did you mean 'depth'?)"),
        ("train --backbone tiny --method fixed --tasks ,", "a cell needs a task"),
        ("train --backbone tiny", "--backbone NAME and --method NAME"),
        ("train gone.json", "no cell file 'gone.json'"),
        ("evaluate gone", "no run or checkpoint 'gone'"),
        ("data synthetic --out x --size 64", "--size '64' is not HxW"),
        ("data check gone", "gone"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(words, message):
    assert message in one_line(*words.split())


def test_a_data_set_without_a_check_says_so(tmp_path):
    (tmp_path / "camera.txt").write_text("1 1 0 0 1\n")
    plug_ins = Path(__file__).parents[1] / "plugins"
    said = one_line("data", "check", tmp_path, "--plugins", plug_ins)
    assert "the data set 'rooms' has no check; `mtl-bench check rooms` tests" in said


@pytest.mark.parametrize(
    "words", ["ablat", "ablate", "ablate --grid", "list thing", "ablate --jobs 0"]
)
def test_usage_of_the_command_line_itself(words):
    call(*words.split(), code=2)


def test_an_unreadable_data_folder_is_one_line(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    (tmp_path / "data").mkdir()
    monkeypatch.setattr(Path, "iterdir", refuse)
    text = one_line("ablate", "--grid", "backbones", "--data", "data")
    assert text == "mtl-bench: Permission denied: data\n"


def test_a_full_disk_is_one_line_and_a_bug_is_not(monkeypatch):
    def fail(error):
        def raise_it(*args, **settings):
            raise error

        monkeypatch.setattr("mtl_bench.bench.store.inspect", raise_it)

    fail(OSError(28, "No space left on device", "runs/x"))
    assert "No space left on device: runs/x" in one_line("status", "--grid", "backbones")
    for bug in (KeyError("x"), OSError(5, "Input/output error")):
        fail(bug)
        with pytest.raises(type(bug)):
            call("status", "--grid", "backbones")


# --- grids ----------------------------------------------------------------------------------------


@pytest.fixture
def ablate(tmp_path, monkeypatch):
    """`ablate` of two cells with stand-ins for rendering, training and drawing."""
    runs, built = tmp_path / "runs", []
    (tmp_path / "mine.toml").write_text(GRID)
    monkeypatch.setattr(options, "data_root", lambda *given: tmp_path)
    monkeypatch.setattr("mtl_bench.bench.references.measure_trivial", lambda *given, **named: None)

    def build(grid, rows, out_dir, *given):
        built.append((grid.name, [row["status"] for row in rows], out_dir))
        run.rows = rows
        return out_dir / "index.html"

    monkeypatch.setattr("mtl_bench.report.grid.build", build)

    def run(*words, code=0, **behaviour):
        command = fake(runs, **behaviour)
        monkeypatch.setattr(jobs, "cell_command", lambda cell, *given: command(cell))
        return call("ablate", "--grid", "mine.toml", *words, code=code)

    run.runs, run.built, run.rows = runs, built, []
    return run


def test_ablate_runs_then_reports_then_has_nothing_to_do(ablate):
    text = ablate()
    assert "2 of 2 cells done; report: reports/mine/index.html" in text
    assert [str(where) for *_, where in ablate.built] == ["reports/mine"]
    assert "to run 0" in ablate()
    assert len(history(ablate.runs)) == 4  # two starts, two ends
    assert [words for _, words, _ in ablate.built] == [["done", "done"]] * 2


def test_ablate_says_1_when_a_cell_failed_and_reports_the_others(ablate):
    text = ablate(actions={1: "fail"}, code=1)
    assert "FAILED" in text
    assert "1 of 2 cells done" in text
    assert ablate.built[0][1] == ["done", "failed"]
    assert "failed 1 (tried again by the next ablate)" in ablate("--dry-run")
    ablate()


def test_dry_run_runs_nothing_and_tells_how_long(ablate):
    text = ablate("--dry-run", "--seeds", "3")
    assert "3 cells = 1 backbone x 1 method x 3 seeds, less 0 skipped" in text
    assert "missing 3   to run 3" in text
    assert text.endswith("nothing was run (--dry-run)\n")
    assert not ablate.runs.exists()
    ablate()
    assert "about 1h00 one after another" in ablate("--dry-run", "--seeds", "3")


def test_smoke_goes_elsewhere(ablate):
    assert "reports/mine-smoke" in ablate("--smoke")


def test_quiet_says_nothing_unless_something_failed(ablate):
    assert ablate("--quiet") == ""
    assert "FAILED" in ablate("--quiet", "--rerun", "all", actions={0: "fail"}, code=1)


def test_status_lists_every_cell(ablate):
    ablate(actions={1: "fail"}, code=1)
    text = call("status", "--grid", "mine.toml")
    first, second, total = text.splitlines()
    assert "done" in first
    assert "PQ 25.0" in first
    assert "ValueError: on purpose" in second
    assert "done 1   failed 1" in total


def test_report_of_what_there_is(ablate):
    ablate(actions={1: "fail"}, code=1)
    assert call("report", "--grid", "mine.toml") == "reports/mine/index.html\n"


ROWS = (
    GRID.split("method =")[0]
    + """
[[row]]
name = "Apart"
method = "fixed"
single_task = true

[[row]]
name = "Uncertain"
method = "fixed_uncertainty"

[[row]]
name = "Longer"
method = "fixed_uncertainty"
video = true

[baseline]
method = "fixed"
single_task = true

[report]
rows = "name"
"""
)


def test_what_cells_need_is_announced_run_and_listed_but_in_no_row(ablate, tmp_path):
    (tmp_path / "mine.toml").write_text(ROWS)
    text = ablate("--dry-run")
    assert "3 cells and 2 that they need = 1 backbone x 3 rows, less 0 skipped" in text
    assert "missing 5   to run 5" in text
    assert "3 of 3 cells done" in ablate("--jobs", "2")
    assert len(history(ablate.runs)) == 10
    assert [row["name"] for row in ablate.rows] == ["Apart", "Uncertain", "Longer"]
    lines = call("status", "--grid", "mine.toml").splitlines()
    assert [("needed by another" in line) for line in lines] == [True, True, *[False] * 4]
    assert "Uncertain" in lines[3]
    assert lines[5] == "done 5"


def test_a_failed_parent_is_told_and_exits_1(ablate, tmp_path):
    (tmp_path / "mine.toml").write_text(ROWS)
    grid = load_grid("mine.toml")
    parent = grid.cells[0].parents[0]
    text = ablate(actions={parent.id: "fail"}, code=1)
    assert f"NOT RUN  needs {parent.slug}, which is failed (ValueError: on purpose)" in text
    assert "2 of 3 cells done" in text
    assert [row["status"] for row in ablate.rows] == ["missing", "done", "done"]
    assert "NOT RUN" in ablate("--quiet", actions={parent.id: "fail"}, code=1)
    ablate()


def test_rows_carry_their_delta_to_the_stored_baseline(ablate, tmp_path):
    axes, _, row, longer = ROWS.split("[[row]]")
    text = f"{axes}[[row]]{row}{longer[longer.index('[baseline]') :]}"
    (tmp_path / "mine.toml").write_text(text)
    ablate()
    (row,) = ablate.rows
    assert "delta.flat" not in row["metric"]
    numbers = {"panoptic.pq": 20.0, "semantic.miou": 40.0, "depth_median.abs_rel": 0.2}
    numbers |= {"depth_median.rmse": 8.0, "depth_median.delta1": 0.8}
    cell = load_grid("mine.toml").cells[0]
    apart = Cell(cell.recipe, "tiny", "fixed", single_task=True)
    for each, factor in ((cell, 1.1), (apart, 1.0)):
        directory = store.run_dir(each, ablate.runs)
        directory.mkdir(exist_ok=True)
        metric = {key: value * factor for key, value in numbers.items()}
        row = {"code": provenance.code(each), "metric": metric}
        write_json(directory / "row.json", row)
    call("report", "--grid", "mine.toml")
    # three of five metrics are a tenth better, two worse; of depth one and two; flat is a loss
    assert ablate.rows[0]["metric"]["delta.flat"] == pytest.approx(-2.0)
    assert ablate.rows[0]["metric"]["delta.task"] == pytest.approx((10 - 10 / 3) / 2)


# --- one cell -------------------------------------------------------------------------------------

CELL = ("--recipe", "smoke", "--backbone", "tiny", "--method", "fixed", "--tasks", "depth")


@pytest.fixture
def train(tmp_path, monkeypatch):
    """`train` with a stand-in for the training, which `behave` may replace."""
    module = types.ModuleType("mtl_bench.bench.run")
    seen = []

    def run_cell(cell, directory, root, device, wandb, echo, ranks):
        seen.append((cell, device, wandb))
        run.behave(directory)
        write_json(
            directory / "row.json", {"code": provenance.code(cell), "metric": {}, "time": {}}
        )

    def run(*words, code=0):
        return call("train", *words, code=code)

    run.behave, run.seen = (lambda directory: None), seen

    def renew(cell, directory, root, device, echo):
        run.renewed.append(cell)

    run.renewed = []
    module.run_cell, module.renew = run_cell, renew
    monkeypatch.setitem(sys.modules, "mtl_bench.bench.run", module)
    monkeypatch.setattr(options, "data_root", lambda *given: tmp_path)
    return run


def test_train_makes_the_cell_that_the_options_say(train):
    train(*CELL, "--seed", "3", "--set", "recipe.optim.lr=0.5", "--device", "cpu")
    cell, device, wandb = train.seen[0]
    assert (cell.seed, cell.tasks, cell.recipe.optim.lr) == (3, ("depth",), 0.5)
    assert (device, wandb) == ("cpu", "off")
    file = Path("runs") / cell.slug / "cell.json"
    assert "done already" in train(file)
    train(file, "--rerun")
    assert train.seen[1][0] == cell


def test_train_options_name_a_cell_of_any_kind(train):
    train(*CELL[:-2], "--granularity", "tasks", "--set", "method.weights.panoptic=2.5")
    cell = train.seen[0][0]
    assert (cell.granularity, cell.method_args) == ("tasks", {"weights": {"panoptic": 2.5}})
    assert "'granularity' must be terms or tasks, not 'task'" in one_line(
        "train", *CELL, "--granularity", "task"
    )
    assert "exclude each other" in one_line("train", *CELL[:-2], "--video", "--single-task")


def test_train_runs_what_the_cell_needs_first(train):
    text = train(*CELL[:-2], "--single-task")
    assert "fixed tiny s0 single-task needs fixed tiny s0 panoptic first" in text
    assert [cell.tasks for cell, *_ in train.seen] == [("panoptic",), ("depth",), Recipe.tasks]
    for cell, *_ in train.seen:
        assert store.status(cell, Path("runs")) == "done"
    train(*CELL[:-2], "--single-task", "--rerun")
    assert len(train.seen) == 4  # not its parents
    assert "needs" not in train(*CELL)


def test_train_stops_at_a_parent_that_fails_and_leaves_the_child_alone(train):
    def fail(directory):
        raise ValueError("on purpose")

    train.behave = fail
    assert "on purpose" in train(*CELL[:-2], "--video", code=2)
    cell = Cell(load_recipe("smoke"), "tiny", "fixed", video=True)
    assert store.status(cell.parents[0], Path("runs")) == "failed"
    assert store.status(cell, Path("runs")) == "missing"
    train.behave = lambda directory: None
    train(*CELL[:-2], "--video")
    assert store.status(cell, Path("runs")) == "done"


def test_train_does_not_build_on_a_stale_parent(train, change_harness):
    train(*CELL[:-2])
    change_harness()
    text = one_line("train", *CELL[:-2], "--video")
    assert (
        "is stale, train, evaluate, time: harness changed: mtl-bench train runs/fixed-tiny-s0-"
        in text
    )
    assert len(train.seen) == 1


def test_train_stale_trains_only_where_training_is_concerned(train, change_harness):
    train(*CELL)
    cell = train.seen[0][0]
    directory = Path("runs") / cell.slug
    assert "done already" in train(*CELL, "--stale")
    (directory / "last.pt").write_text("state")
    change_harness("evaluate")
    assert "done already, but stale: evaluate: harness changed (--stale" in train(*CELL)
    train(*CELL, "--stale")
    assert (train.renewed, len(train.seen)) == ([cell], 1)
    change_harness("train")
    assert "starting over (train: harness changed" in train(*CELL, "--stale")
    assert (train.renewed, len(train.seen)) == ([cell], 2)
    aside = directory / "set-aside-1"
    assert (aside / "last.pt").read_text() == "state"
    assert (aside / "row.json").is_file()


def test_train_writes_down_why_it_failed(train):
    def fail(directory):
        (directory / "last.pt").write_text("state")
        raise ValueError("on purpose")

    train.behave = fail
    assert "on purpose" in train(*CELL, code=2)
    cell = Cell(load_recipe("smoke"), "tiny", "fixed", ("depth",))
    state = store.inspect(cell, Path("runs"))
    assert (state.word, state.why) == ("failed", "ValueError: on purpose")
    failure = json.loads((Path("runs") / cell.slug / "failed.json").read_text())
    assert "in fail\n" in failure["traceback"]
    train.behave = lambda directory: None
    train(*CELL)
    assert store.status(cell, Path("runs")) == "done"


def test_train_leaves_a_claimed_cell_alone(train):
    cell = Cell(load_recipe("smoke"), "tiny", "fixed", ("depth",))
    hold(Path("runs") / cell.slug, os.getppid())
    assert "is being run by process" in train(*CELL, code=CLAIMED)
    assert train.seen == []


def test_train_tells_when_a_checkpoint_is_of_other_code(train, change_harness):
    def stop(directory):
        (directory / "last.pt").write_text("state")
        raise KeyboardInterrupt

    train.behave = stop
    assert "interrupted" in train(*CELL, code=130)
    cell = Cell(load_recipe("smoke"), "tiny", "fixed", ("depth",))
    assert store.status(cell, Path("runs")) == "interrupted"
    change_harness()
    train.behave = lambda directory: None
    assert "starting over (harness changed); what there was is kept" in train(*CELL)
    assert not (Path("runs") / cell.slug / "last.pt").exists()
    assert (Path("runs") / cell.slug / "set-aside-1" / "last.pt").read_text() == "state"


# --- as a program ---------------------------------------------------------------------------------


def program(code, *words, **options):
    done = subprocess.run(
        [sys.executable, "-m", "mtl_bench", *words], capture_output=True, text=True, **options
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def test_errors_go_to_stderr_without_a_traceback():
    done = program(2, "ablate", "--grid", "backbone")
    assert done.stdout == ""
    assert done.stderr.startswith("mtl-bench: no grid called 'backbone'")
    assert "Traceback" not in done.stderr
    loud = program(2, "ablate", "--grid", "x", env={**os.environ, "MTL_BENCH_TRACEBACK": "1"})
    assert "Traceback" in loud.stderr


def test_a_cut_off_pipe_is_no_error():
    command = f"{sys.executable} -m mtl_bench list -v | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert done.stdout == "methods\n"
    assert "Traceback" not in done.stderr
