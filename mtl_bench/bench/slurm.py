"""Cells as jobs of Slurm: arrays of one cell a task, parents by dependency, plain `sbatch`.

runs/.slurm/<token>/    of an array
    script.sh, commands, folders   what Slurm runs; a line a task
    array.json          {"job": Slurm's number, "ids": of the cells}
    <task>.log          what Slurm itself has to say
State is what lies in the run directories; Slurm's own is only joined to it. Rules that are easily
got wrong, each tried on Slurm 22.05: a cell is a step (`srun`), as only steps get their signals in
time; a stopped cell is requeued only while Slurm says RUNNING (preempted, or at its time limit), as
an unconditional requeue brings back what was cancelled; what is requeued is A_i, not the array.
"""

import os
import shlex
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mtl_bench.bench.executors import Executor, Status, Task
from mtl_bench.core.files import read_json, write_json, write_text
from mtl_bench.core.locks import CLAIMED

FOLDER = ".slurm"
NAME = "mtl-bench"  # of every job, by which they are asked for
OWN = {  # options that the script sets
    *("array", "dependency", "hold", "job-name", "kill-on-invalid-dep", "open-mode", "output"),
    *("requeue", "signal"),
}
LARGEST = 1000  # tasks of an array; a cluster's default limit is 1001
NOTICE_S = 60  # before the time limit
QUEUED = ("PENDING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "RESV_DEL_HOLD", "SPECIAL_EXIT")
RUNNING = ("CONFIGURING", "RUNNING", "COMPLETING", "SUSPENDED", "STOPPED", "SIGNALING", "STAGE_OUT")
SCRIPT = """
# A cell is a step of its own, so that Slurm signals it itself: USR1 before the time limit, TERM
# when it is preempted or cancelled. It saves, and ends with 130; this script outlives it.
unset MTL_BENCH_LAUNCHER MTL_BENCH_SIDE_BY_SIDE
export MTL_BENCH_ORDERED=1
[ -z "$SLURM_CPUS_PER_TASK" ] || export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK
mapfile -t commands < {place}/commands
mapfile -t folders < {place}/folders
me=${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID
folder=${{folders[$SLURM_ARRAY_TASK_ID]}}
trap : TERM USR1
eval "srun --unbuffered ${{commands[$SLURM_ARRAY_TASK_ID]}} >> \\"\\$folder/log.txt\\" 2>&1 &"
step=$!
code=143
while kill -0 $step 2> /dev/null; do wait $step; code=$?; done
case $code in
  0) ;;
  {claimed}|130|138|143)  # another process runs it, or: told to stop
    case "$(scontrol show job $me)" in
      *JobState=RUNNING*) scontrol requeue $me; sleep 60 & wait ;;  # else it was cancelled
    esac ;;
  *)
    if [ ! -e "$folder/failed.json" ]; then
      printf '{{"error": "exit code %d in Slurm job %s", "traceback": "", "exit_code": %d}}\\n' \\
        $code $me $code > "$folder/.failed.$me.tmp"
      mv "$folder/.failed.$me.tmp" "$folder/failed.json"
    fi ;;
esac
exit $code
"""


def options_of(text: str) -> dict[str, str]:
    """`partition=gpu,time=4:00:00,exclusive` -> options of sbatch without their dashes.

    Raises:
        ValueError: no name, or an option that the script sets itself.
    """
    found = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, _, value = part.partition("=")
        name = name.lstrip("-")
        if not name.replace("-", "").isalnum() or set(value) & set("\n\r"):
            raise ValueError(f"--slurm '{part}' is no option of sbatch: say NAME=VALUE,NAME=VALUE")
        if name in OWN:
            raise ValueError(f"--slurm '{part}': mtl-bench sets {name} itself")
        found[name] = value
    return found


@dataclass
class Slurm(Executor):
    """The queue of a cluster.

    Args:
        runs: the runs folder, on a file system that all nodes see.
        options: of sbatch, see `options_of`.
        cap: most tasks of an array at a time.
    """

    runs: Path
    options: Mapping[str, str] = field(default_factory=dict)
    cap: int | None = None
    submitted: list[int] = field(default_factory=list)  # Slurm's numbers

    @property
    def _given(self) -> list[str]:
        return [
            f"--{name}={value}" if value else f"--{name}" for name, value in self.options.items()
        ]

    def check(self) -> None:
        """Whether it would take a job with these options; nothing is queued.

        Raises:
            ValueError: it would not, or there is no Slurm here.
        """
        _call("sbatch", "--test-only", *self._given, "--wrap", "true")

    def script(self, place: Path, tasks: int) -> str:
        """What sbatch gets for an array of so many tasks."""
        cap = "" if self.cap is None else f"%{self.cap}"
        own = [f"--job-name={NAME}", f"--array=0-{tasks - 1}{cap}", f"--output={place}/%a.log"]
        own += ["--open-mode=append", "--requeue", "--kill-on-invalid-dep=yes"]
        own += [f"--signal=USR1@{NOTICE_S}"]
        head = "\n".join(["#!/bin/bash", *(f"#SBATCH {line}" for line in [*own, *self._given])])
        return head + SCRIPT.format(place=shlex.quote(str(place)), claimed=CLAIMED)

    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue all; where that fails in the middle, none stays.

        Raises:
            ValueError: no Slurm here, or it refuses.
        """
        numbers = {key: number for key, (number, _) in self._states().items()}
        try:
            for level in arrays(tasks):
                job = self._submit(level, held=any(task.after for task in level))
                for index, task in enumerate(level):
                    numbers[task.id] = f"{job}_{index}"
                for index, task in enumerate(level):
                    before = [numbers[key] for key in task.after if key in numbers]
                    if before:
                        after = f"Dependency=afterok:{':'.join(before)}"
                        _call("scontrol", "update", f"JobId={job}_{index}", after)
                if any(task.after for task in level):
                    _call("scontrol", "release", str(job))
        except BaseException:
            self.cancel()
            raise

    def _submit(self, tasks: Sequence[Task], held: bool) -> int:
        place = self.runs.resolve() / FOLDER / os.urandom(4).hex()
        place.mkdir(parents=True)
        write_text(place / "commands", "".join(shlex.join(t.command) + "\n" for t in tasks))
        write_text(place / "folders", "".join(f"{t.log.parent.resolve()}\n" for t in tasks))
        write_text(place / "script.sh", self.script(place, len(tasks)))
        told = _call("sbatch", "--parsable", *["--hold"] * held, str(place / "script.sh"))
        job = int(told.strip().partition(";")[0])  # behind it a cluster's name
        self.submitted.append(job)
        write_json(place / "array.json", {"job": job, "ids": [task.id for task in tasks]})
        return job

    def states(self) -> dict[str, Status]:
        return {key: status for key, (_, status) in self._states().items()}

    def _states(self) -> dict[str, tuple[str, Status]]:
        """Cell -> Slurm's number and state of its last job, as long as Slurm knows it."""
        records = (self.runs / FOLDER).glob("*/array.json")
        arrays = sorted(filter(None, map(read_json, records)), key=lambda array: array["job"])
        if not arrays:
            return {}
        told = _call("squeue", "-h", "-r", "-t", "all", "-n", NAME, "-o", "%i|%T|%r")
        known = {}
        for line in told.splitlines():
            number, state, reason = line.strip().split("|", 2)
            word = "queued" if state in QUEUED else "running" if state in RUNNING else "ended"
            why = f" ({reason})" if reason not in ("None", "") else ""
            about = f"Slurm {number} {state}{why}"
            known[number] = Status(word, about=about)  # type: ignore[arg-type]
        found = {}
        for array in arrays:
            for index, key in enumerate(array["ids"]):
                number = f"{array['job']}_{index}"
                if number in known:
                    found[key] = number, known[number]
        return found

    def cancel(self) -> None:
        if self.submitted:
            _call("scancel", *map(str, self.submitted))


def arrays(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    """Tasks by how many stand one after another before them: those of an array need none of it."""
    depth: dict[str, int] = {}
    for task in tasks:
        depth[task.id] = 1 + max((depth[key] for key in task.after if key in depth), default=-1)
    for level in range(max(depth.values(), default=-1) + 1):
        these = [task for task in tasks if depth[task.id] == level]
        for begin in range(0, len(these), LARGEST):
            yield these[begin : begin + LARGEST]


def _call(*words: str) -> str:
    try:
        done = subprocess.run(words, capture_output=True, text=True)
    except FileNotFoundError:
        raise ValueError(f"no {words[0]} here: --on slurm is for a machine of a cluster") from None
    if done.returncode:
        why = " ".join((done.stderr or done.stdout).split())
        raise ValueError(f"{words[0]} says: {why or f'exit code {done.returncode}'}")
    return done.stdout
