"""A disk that is full while scenes are rendered is one line, and leaves nothing behind."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("scenes", [1, 4])  # in this process, and by workers
def test_a_full_disk_is_one_line_and_leaves_nothing(scenes, tmp_path):
    out = tmp_path / "scenes"
    command = f"{sys.executable} -m mtl_bench data synthetic --size 64x128 --frames 3"
    command += f" --scenes {scenes} --val-scenes 0 --test-scenes 0 --out {out}"
    limited = f"ulimit -f 4; exec {command} --quiet"  # no file above 4 KiB
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("mtl-bench: File too large")
    assert {path.name for path in tmp_path.iterdir()} <= {"scenes.lock"}
