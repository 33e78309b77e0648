"""Stands in for `mtl-bench latency` in tests of the grid: counts its runs, writes a row.

python fake_timing.py ACTION FILE ROW_JSON
"""

import os
import signal
import sys
import time
from pathlib import Path

ACTION, FILE, ROW = sys.argv[1:]


def main() -> None:
    folder = Path(FILE).parent
    with (folder / "history.txt").open("a") as history:
        history.write(f"{Path(FILE).stem}\n")
    others = folder / "running"
    others.mkdir()  # fails where another one runs
    try:
        print("about to", ACTION, flush=True)
        if ACTION == "crash":
            others.rmdir()
            os.kill(os.getpid(), signal.SIGKILL)
        if ACTION == "fail":
            sys.exit("RuntimeError: on purpose")
        if ACTION == "sleep":
            (folder / "asleep").touch()
            time.sleep(60)
        if ACTION != "silent":
            Path(FILE).write_text(ROW)
        sys.exit(1 if ACTION == "wrong" else 0)
    finally:
        others.rmdir()


if __name__ == "__main__":
    main()
