"""`latency` and `export` on the command line."""

import json
import sys
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from mtl_bench.cli import deploy
from mtl_bench.cli.app import app
from mtl_bench.deploy import timer
from mtl_bench.deploy.subject import untrained
from mtl_bench.tasks.panoptic import THINGS_SHARE

SMALL = ["--backbone", "tiny", "--recipe", "smoke", "--size", "32x64"]


def invoke(*words):
    return CliRunner().invoke(app, list(words))


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
def test_a_row_is_written_and_printed(tmp_path):
    file = tmp_path / "row.json"
    quick = ["--passes", "3", "--batch", "1", "--json", str(file)]
    result = invoke("latency", *SMALL, "--engine", "eager", "--tasks", "depth", *quick)
    assert result.exit_code == 0, result.output
    row = json.loads(file.read_text())
    assert (row["status"], row["engine"], row["tasks"]) == ("done", "eager", ["depth"])
    assert (row["height"], row["width"], row["weights"]) == (32, 64, "random")
    assert f"{row['metric']['latency.mean_ms']:.1f} ms" in result.output
    assert "against plain" in result.output


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--size", "32x64"], "either --checkpoint RUN or --backbone NAME"),
        ([*SMALL, "--tasks", "dept"], "no task called 'dept'"),
        ([*SMALL, "--size", "32"], "'32' is not HxW"),
        ([*SMALL, "--size", "30x64"], "not divisible by the deepest stride 8"),
        ([*SMALL, "--engine", "eager", "--precision", "fp16", "--device", "cpu"], "it has fp32"),
        (["--checkpoint", "nowhere"], "no run or checkpoint 'nowhere'"),
    ],
)
@pytest.mark.usefixtures("threads")
def test_wrong_usage_is_one_line(words, why):
    result = invoke("latency", *words)
    assert result.exit_code == 2
    assert why in result.output
    assert len(result.output.strip().splitlines()) == 1


@pytest.mark.usefixtures("threads")
def test_a_wrong_engine_ends_with_1(tmp_path, monkeypatch):
    wrong = {"agreement.panoptic_equal": 0.5}
    monkeypatch.setattr(timer, "_measured", lambda *args: ("wrong", "differs from plain", wrong))
    result = invoke("latency", *SMALL, "--engine", "eager")
    assert result.exit_code == 1
    assert "wrong: differs from plain" in result.output


def test_all_runs_every_engine_in_a_process_of_its_own(tmp_path, monkeypatch):
    seen = []

    def run(command, **kwargs):
        seen.append(command)
        name = command[command.index("--engine", command.index("latency") + 3) + 1]
        row = {"engine": name, "precision": "fp32", "status": "unavailable", "why": "no", **ROW}
        if name in ("plain", "eager"):
            row |= {"status": "done", "metric": measured({"plain": 30.0, "eager": 20.0}[name])}
        Path(command[-1]).write_text(json.dumps(row))

    monkeypatch.setattr(deploy.subprocess, "run", run)
    file = tmp_path / "rows.json"
    words = ["latency", "--engine", "all", *SMALL, "--device", "cpu", "--json", str(file)]
    monkeypatch.setattr(sys, "argv", ["mtl-bench", *words])
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    assert [row["engine"] for row in json.loads(file.read_text())] == [
        *("plain", "compile", "eager", "onnxruntime", "openvino", "tensorrt")
    ]
    assert all(command[:3] == [sys.executable, "-m", "mtl_bench"] for command in seen)
    lines = result.output.splitlines()
    assert any("eager" in line and "1.50x" in line for line in lines)
    assert any("openvino" in line and "unavailable: no" in line for line in lines)


ROW = {"metric": {}}


def measured(ms):
    times = dict.fromkeys(("mean", "p95", "transfer", "network", "postprocess"), ms)
    metric = {f"latency.{key}_ms": value for key, value in times.items()}
    return metric | {"latency.fps": 1000 / ms, "latency.noisy": False}


def test_random_weights_see_no_more_things_than_a_street_has():
    _, model = untrained("tiny", "smoke", ())
    image = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8).permute(0, 3, 1, 2) / 255
    before = model.net.heads["semantic"][1].weight.clone()
    model.net.eval().like_trained(image)
    after = model.net.heads["semantic"][1].weight
    assert sorted(before.sum((1, 2, 3)).tolist()) == sorted(after.sum((1, 2, 3)).tolist())
    with torch.no_grad():
        seen = model.net(image).maps["panoptic"]["semantic"].argmax(1)
    share = sum(float((seen == thing).float().mean()) for thing in model.tasks[0].labels.things)
    assert share <= THINGS_SHARE + 1e-6


def test_export_prints_the_names(tmp_path):
    pytest.importorskip("onnx")
    out = tmp_path / "net.onnx"
    result = invoke("export", *SMALL, "--out", str(out), "--post", "none")
    assert result.exit_code == 0, result.output
    assert out.is_file()
    assert "outputs  semantic, center, offset, inverse_depth" in result.output
    assert f"{tmp_path / 'net.json'}  what each of them is" in result.output
