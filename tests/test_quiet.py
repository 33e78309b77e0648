"""While one process is timed, others wait; a dead one holds nobody back."""

import signal
import subprocess
import sys
import time

from mtl_bench.core.quiet import Quiet

HOLD = """
import sys, time
from pathlib import Path
from mtl_bench.core.quiet import Quiet
with Quiet(Path(sys.argv[1])).alone(neighbours=False):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def hold(runs, seconds):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(runs), str(seconds)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    return process, time.monotonic()


def test_others_pass_by_when_the_timing_is_over(tmp_path):
    quiet = Quiet(tmp_path)
    quiet.pass_by()
    process, began = hold(tmp_path, 1.0)
    quiet.pass_by()
    assert time.monotonic() - began > 0.8
    process.wait()
    with quiet.alone(neighbours=False):
        pass
    quiet.pass_by()


def test_a_killed_process_releases_the_others(tmp_path):
    process, began = hold(tmp_path, 60)
    process.send_signal(signal.SIGKILL)
    process.wait()
    Quiet(tmp_path).pass_by()
    assert time.monotonic() - began < 30


def test_neighbours_get_time_to_finish_their_step(tmp_path):
    began = time.monotonic()
    with Quiet(tmp_path).alone(neighbours=True):
        assert time.monotonic() - began >= 1.0
