"""Files that are no plug-ins stop nothing, and names that are none are refused everywhere alike."""

import json
import os

import pytest
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import plugins

METHOD = '''"""Mine: does what its test needs.

Source: none.
"""
from mtl_bench.core.method import LossMethod


class Mine(LossMethod):
    def total(self, step):
        return step.loss_K.sum()
'''
EXITING = METHOD.replace("        return", "        raise SystemExit(0)\n        return")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    found = tmp_path / "methods"
    found.mkdir()
    (found / "mine.py").write_text(METHOD)
    monkeypatch.setenv(plugins.VARIABLE, str(tmp_path))
    return found


def run(*words):
    return CliRunner().invoke(app, list(words))


def loop(folder):
    (folder / "odd.py").symlink_to("odd.py")


def nowhere(folder):
    (folder / "odd.py").symlink_to("gone.py")


def loop_of_folders(folder):
    (folder / "odd").symlink_to("odd")
    (folder / "odd.py").mkdir()


def pipe(folder):
    os.mkfifo(folder / "odd.py")


@pytest.mark.parametrize("make", [loop, nowhere, loop_of_folders, pipe])
@pytest.mark.parametrize("kind", ["methods", "plain"])
def test_what_is_no_file_is_listed_as_broken_and_hurts_nobody(folder, make, kind, monkeypatch):
    if kind == "plain":  # a folder of plug-ins of any kind
        folder = folder.rename(folder.with_name("plain"))
        monkeypatch.setenv(plugins.VARIABLE, str(folder))
    make(folder)
    listed = run("list", "methods")
    assert listed.exit_code == 0, listed.output
    assert "Mine: does what its test needs." in listed.output
    if kind == "methods":
        assert "BROKEN: ValueError: no file to read" in listed.output
        checked = run("check", "odd")
        assert checked.exit_code != 0
        assert "no file to read" in checked.output
    assert plugins.load("methods", "mine")
    assert "odd" not in plugins.readable("methods")


@pytest.mark.parametrize("name", ["méthode", "Upper", "with-hyphen", "n" * 65])
def test_what_is_no_name_is_refused_alike_by_list_check_and_train(folder, name):
    (folder / f"{name}.py").write_text(METHOD)
    assert "is no name" in next(d.error for d in plugins.describe("methods") if d.name == name)
    for words in (["check", name], ["new", "method", name]):
        found = run(*words)
        assert found.exit_code == 2, found.output
        assert "is no name: a lower-case letter, then at most 63" in found.output
    with pytest.raises(ValueError, match="is no name"):
        plugins.load("methods", name)


@pytest.mark.parametrize("text", ["import sys\nsys.exit(0)\n" + METHOD, EXITING])
def test_a_plug_in_that_exits_passes_no_check(folder, text):
    (folder / "mine.py").write_text(text)
    found = run("check", "mine")
    assert found.exit_code == 1, found.output
    assert "FAILED" in found.output
    assert "SystemExit" in found.output


def test_a_plug_in_that_exits_while_it_trains_is_a_failure(folder, tmp_path, smoke_root):
    (folder / "mine.py").write_text(EXITING)
    words = ["--recipe", "smoke", "--backbone", "tiny", "--method", "mine"]
    runs = tmp_path / "runs"
    found = run("train", *words, "--runs", str(runs), "--data", str(smoke_root), "--quiet")
    assert found.exit_code == 1
    assert "a plug-in has called sys.exit(0)" in found.output
    (failed,) = runs.glob("*/failed.json")
    assert "SystemExit" in json.loads(failed.read_text())["error"]


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--backbone", "tiny", "--method", "mine", "--recipe", "n" * 300],
        ["train", "--backbone", "tiny", "--method", "n" * 300],
        ["ablate", "--grid", "n" * 300],
        ["check", "n" * 300],
        ["list", "--plugins", "n" * 300],
        ["new", "method", "n" * 300],
        ["evaluate", "n" * 300],
        ["train", "n" * 300],
    ],
)
def test_a_name_of_300_letters_is_one_line(folder, words):
    found = run(*words)
    assert found.exit_code == 2
    assert found.exception is None or isinstance(found.exception, SystemExit)
    assert len(found.output.strip().splitlines()) <= 12  # Typer's own usage errors are framed
