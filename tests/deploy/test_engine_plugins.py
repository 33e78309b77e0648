"""Engines as plug-ins: found by their files, described by text, checked, timed from anywhere."""

import importlib
import json

import pytest
import torch
from small_networks import SIZE, subject
from typer.testing import CliRunner

from mtl_bench.bench import jobs, scaffold
from mtl_bench.bench.check import check
from mtl_bench.bench.grid import load_grid
from mtl_bench.cli.app import app
from mtl_bench.core import plugins
from mtl_bench.core.engine import Engine, Setting
from mtl_bench.deploy import engines, timer

SHIPPED = ["plain", "compile", "eager", "onnxruntime", "openvino", "tensorrt"]
CPU = torch.device("cpu")

MINE = '''"""torch without a compiler, once more.

Source: a test.
"""

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.graph import GraphEngine, strided


class Mine(GraphEngine):
    {declared}

    def build(self, net, setting):
        self.graph = strided(net, (setting.batch, *setting.size), setting.dtype)
        self.count = 0

    def strided(self, image):
        maps = dict(zip(self.graph.names, self.graph(image), strict=True))
        self.count += 1
        {line}
        return maps
'''
DECLARED = 'precisions = {"cpu": ("fp32",), "cuda": ("fp32",)}'


@pytest.fixture(autouse=True)
def isolated(tmp_path, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def put(tmp_path):
    def put(line="pass", declared=DECLARED, place="mine/engines/myengine.py"):
        path = tmp_path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(MINE.format(line=line, declared=declared))
        return path

    return put


# --- found and described --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "place", ["engines/myengine.py", "mine/engines/myengine.py", "mine/x/e.py"]
)
def test_engines_are_found_in_their_folders(put, tmp_path, place):
    assert engines.names() == SHIPPED
    path = put(place=place)
    if place.startswith("mine"):
        plugins.add_folder(path if "x" in path.parts else tmp_path / "mine")
    assert set(engines.names()) == {*SHIPPED, path.stem}
    assert engines.load(path.stem).__name__ == "Mine"
    assert plugins.kinds_of(path.stem) == ["engines"]


def test_what_an_engine_declares_is_read_from_its_text(put):
    put(declared=DECLARED + "\n    packages = ('nowhere',)\n    extra = ('a', 'b>=1')")
    plugins.add_folder("mine")
    found = engines.facts("myengine")
    assert found.text == "fp32 on cpu; fp32 on cuda"
    assert (found.packages, found.extra) == (("nowhere",), ("a", "b>=1"))
    assert engines.available("myengine") == "lacks the package nowhere: pip install 'a' 'b>=1'"
    with pytest.raises(ValueError, match="engine myengine has no bf16 on cpu: it has fp32 on cpu"):
        engines.check("myengine", "bf16", "cpu")


def test_what_is_no_literal_is_read_from_the_class(put):
    put(declared="precisions = dict(cpu=('fp32', 'bf16'))")
    plugins.add_folder("mine")
    assert engines.facts("myengine") == engines.Facts({"cpu": ("fp32", "bf16")}, ("torch",), ())


def test_shipped_engines_declare_literals_and_what_their_classes_say():
    for name in SHIPPED:
        assert "precisions" in plugins.attributes("engines", name)
        kind, found = engines.load(name), engines.facts(name)
        assert issubclass(kind, Engine)
        assert (kind.precisions, kind.packages) == (found.precisions, found.packages)
        assert kind.extra == found.extra


@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_a_file_called_like_its_package_leaves_the_package_alone(name):
    pytest.importorskip(name)
    engine = engines.load(name)
    assert engine.__module__ == f"mtl_bench.deploy.engines.{name}"
    assert "site-packages" in importlib.import_module(name).__file__


def test_a_broken_engine_hurts_only_those_who_choose_it(put):
    put().write_text("class Mine(:\n")
    plugins.add_folder("mine")
    assert engines.names() == SHIPPED
    listed = CliRunner().invoke(app, ["list", "engines"]).output
    assert "BROKEN" in listed
    assert "fp32, bf16, fp16 on cuda" in listed
    with pytest.raises(ValueError, match=r"myengine\.py"):
        engines.load("myengine")


# --- checked --------------------------------------------------------------------------------------


def failed(name="myengine"):
    return [result.name for result in check("engines", name) if not result.ok]


@pytest.mark.parametrize(
    ("line", "caught"),
    [
        ("maps['inverse'] = maps['inverse'] * 1.1", "agrees with plain"),
        ("maps['offset'] = maps['offset'] + 1e-3 * self.count", "same image, same maps"),
        ("maps.pop('center')", "maps of the contract"),
        ("maps['offset'] = maps['offset'].flip(0)", "a batch of 2"),
    ],
)
def test_a_wrong_engine_is_caught(put, line, caught):
    put(line)
    plugins.add_folder("mine")
    assert caught in failed()


def test_an_unknown_precision_is_caught_and_a_lacking_package_is_said(put):
    put(declared='precisions = {"cpu": ("int4",)}\n    packages = ("nowhere",)')
    plugins.add_folder("mine")
    results = {result.name: result for result in check("engines", "myengine")}
    assert "known: fp32" in results["declared"].detail
    assert results["agrees with plain"].ok
    assert "not tried: lacks the package nowhere" in results["agrees with plain"].detail


def test_the_file_to_start_from_passes(tmp_path):
    path = scaffold.write("engines", "started", tmp_path / "mine" / "engines")
    plugins.add_folder(path)
    assert failed("started") == []


# --- timed ----------------------------------------------------------------------------------------


def test_an_engine_from_a_users_folder_is_timed(put, tmp_path):
    put()
    quick = ["--backbone", "tiny", "--recipe", "smoke", "--size", "32x64", "--passes", "3"]
    words = ["--engine", "myengine", "--batch", "2", "--json", "row.json", "--plugins", "mine"]
    result = CliRunner().invoke(app, ["latency", *quick, *words])
    assert result.exit_code == 0, result.output
    row = json.loads((tmp_path / "row.json").read_text())
    assert (row["status"], row["engine"]) == ("done", "myengine")
    assert row["metric"]["latency.throughput_batch"] == 2
    assert "torch" in row["env"]


def test_a_grid_takes_a_users_engine_and_skips_what_it_lacks(put, tmp_path):
    put()
    plugins.add_folder("mine")
    axes = 'backbone = ["tiny"]\nsize = ["64x128"]\ntasks = [["depth"]]\n'
    axes += 'engine = ["plain", "myengine"]\nprecision = ["fp32", "bf16"]\n'
    (tmp_path / "g.toml").write_text(f'kind = "latency"\nquestion = "?"\n\n[axes]\n{axes}')
    grid = load_grid("g.toml")
    jobs.TIMINGS.check(grid.jobs)
    assert [(t.engine, t.precision) for t in grid.jobs] == [
        ("plain", "fp32"),
        ("myengine", "fp32"),
    ]
    assert "myengine has no bf16 on cpu" in {skip.why for skip in grid.skips}
    assert jobs.lack(grid.jobs[1]) is None


def test_named_maps_are_those_of_the_contract():
    with torch.inference_mode():
        made = timer.make(subject(), "eager", Setting(1, *SIZE, "fp32", CPU, 1))
        found = made.run(made.transfer(subject().images[0]))
    maps = {"semantic", "semantic.class", "center", "offset"}
    assert set(found) == {f"panoptic.{name}" for name in maps} | {"depth.inverse"}
    assert found["panoptic.semantic.class"].shape == (1, *SIZE)
    assert found["panoptic.offset"].shape == (1, 2, *SIZE)
