"""`benchmarks/gpu.sh`: rehearsed on the CPU, and what becomes of parts that fail or never end."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def test_the_whole_script_runs_on_the_cpu(tmp_path):
    command = [FOLDER / "gpu.sh", "--cpu-rehearsal", tmp_path]
    environment = {**os.environ, "PYTHON": sys.executable, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert found["ok"]
    assert found["rehearsal"]
    parts = found["parts"]
    assert {part["status"] for part in parts.values()} == {"done"}
    assert parts["environment"]["torch"]
    assert parts["scenes"]["frames"] == 20  # of four scenes and one; the annotated also as such
    assert parts["tests"]["passed"] == 1
    assert parts["latency eager fp32"]["latency.mean_ms"] > 0
    assert parts["training"]["step_ms"] > 0
    assert 0 <= parts["training"]["data_share"] < 1
    assert parts["training"]["peak_mib"] > 0
    assert [row["method"] for row in parts["methods"]["methods"]] == ["uncertainty"]


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    import gpu

    return gpu


def test_a_part_that_fails_or_never_ends_is_recorded_and_stops_no_other(gpu, tmp_path):
    def fails(plan, work):
        print("as far as here")
        raise ValueError("no such thing")

    def never_ends(plan, work):
        neighbour = subprocess.Popen(["sleep", "600"])
        (tmp_path / "pid").write_text(str(neighbour.pid))
        time.sleep(600)

    failed = gpu.take(fails, None, tmp_path, 20)
    assert failed["status"] == "failed"
    assert "as far as here" in failed["output"]
    assert "no such thing" in failed["output"]
    late = gpu.take(never_ends, None, tmp_path, 2)
    assert late["status"] == "late"
    state = Path(f"/proc/{(tmp_path / 'pid').read_text()}/stat")
    assert not state.exists() or state.read_text().split()[2] == "Z"  # killed with its part
    bad = gpu.take(lambda plan, work: {"good": False, "value": 1}, None, tmp_path, 20)
    assert (bad["status"], bad["value"]) == ("failed", 1)
    done = gpu.take(lambda plan, work: {"value": 1}, None, tmp_path, 20)
    assert (done["status"], done["value"]) == ("done", 1)
