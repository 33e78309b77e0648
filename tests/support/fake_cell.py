"""Stands in for `mtl_bench train` in tests of the launcher: claims, reports, writes a row.

    python fake_cell.py ACTION SECONDS CODE_JSON CELL.JSON [--stale]

Every start and end leaves a line in `history.txt` beside the run directories.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from mtl_bench.bench import store
from mtl_bench.core import locks
from mtl_bench.core.files import write_json
from mtl_bench.core.locks import CLAIMED, ClaimedError, claim

if "TEST_LEASE_S" in os.environ:
    locks.LEASE_S = float(os.environ["TEST_LEASE_S"])
    locks.BEAT_S = locks.LEASE_S / 8


def note(directory: Path, word: str) -> None:
    threads = os.environ.get("OMP_NUM_THREADS", "-")
    with (directory.parent / "history.txt").open("a") as file:
        gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "-")
        file.write(f"{word} {directory.name} {time.time()} {threads} {os.getpid()} {gpu}\n")


def interrupt(number, frame):
    signal.signal(number, signal.SIG_IGN)  # a queue may send it again
    raise KeyboardInterrupt


def main() -> None:
    action, seconds, code, file, *options = sys.argv[1:]
    signal.signal(signal.SIGTERM, interrupt)
    signal.signal(signal.SIGUSR1, interrupt)
    directory = Path(file).parent
    if action == "silent":
        sys.exit(0)
    try:
        with claim(directory):
            if (directory / "row.json").exists() and "--stale" not in options:
                return
            if "--stale" in options:
                store.set_aside(directory, "stale")
            note(directory, "start")
            write_json(directory / "code.json", json.loads(code))
            state = {"stage": "train", "step": 1, "steps": 2, "seconds": 1.0, "note": "loss 1"}
            write_json(directory / "progress.json", state)
            again = (directory / "saved").exists()
            time.sleep(0 if action == "resume" and again else float(seconds))
            if action == "fail":
                store.write_failure(directory, "ValueError: on purpose", "Traceback ...")
                sys.exit(1)
            if action == "crash":
                print("about to crash", flush=True)
                os.kill(os.getpid(), signal.SIGKILL)
            metric = {"panoptic.pq": 25.0, "latency.fps": 10.0}
            row = {"metric": metric, "code": json.loads(code), "time": {"train_s": 3600.0}}
            write_json(directory / "row.json", row)
            note(directory, "end")
    except ClaimedError:
        sys.exit(CLAIMED)
    except KeyboardInterrupt:
        note(directory, "saved")
        (directory / "saved").touch()
        sys.exit(130)


if __name__ == "__main__":
    main()
