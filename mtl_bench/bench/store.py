"""What is stored of jobs in runs/, and what that says about each.

runs/<method>-<backbone>-s<seed>-<id>/    of a cell
    cell.json      what to run, whole
    code.json      fingerprints of the code that began it, by stage, and a record of its data: a
                   checkpoint is continued by no other code for training and on no other data
    claim          who is running it now
    progress.json  how far that is
    last.pt        checkpoint          curve.csv  losses, weights, rate per step
    taken.json     memory, and seconds of pseudo labels, for a run that is continued
    pseudo_labels/ of a video cell, made by its parent's checkpoint
    log.txt        what the run printed
    row.json       the result; it appears by rename at the very end, so it exists = done
    failed.json    why there is none
    set-aside-N/   an earlier training, by code that has changed since
runs/latency/                             of timings
    claim          who is timing now: one launcher at a time, with one process at a time
    <id>.json      a timing's row, by rename at its end: what `mtl-bench latency --json` wrote, and
                   `timing`, `code`, `seconds`; its status tells why it has no numbers
    <id>.log       what the process printed
"""

import shutil
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtl_bench.bench.data_state import STAGES, Data
from mtl_bench.bench.jobs import NOTHING, Job, Kind, kind_of, load_cell, with_parents
from mtl_bench.core import plugins, provenance
from mtl_bench.core.config import Cell
from mtl_bench.core.files import read_json, write_json
from mtl_bench.core.locks import claimed_by, is_here
from mtl_bench.core.plain import to_dict

SECTIONS = ("metric", "protocol", "time", "code", "data", "env", "cell", "timing")  # of a row
TRAINED = ("last.pt", "curve.csv", "pseudo_labels", "row.json")
ASIDE = "set-aside-"
ELSEWHERE = "on another machine"
SHOWN_S = 60.0  # for a file that another machine has written to be seen on a shared folder
RENEWING = ("stale", "latency")  # ways to run again that keep a training of today's code
KEPT = ("cell.json", "log.txt", "claim")  # what a fresh start leaves in place


@dataclass(frozen=True)
class State:
    word: str  # one of the words of the job's kind
    why: str = ""
    row: dict[str, Any] | None = None
    stale: Mapping[str, str] = field(default_factory=dict)  # stage -> what of its code changed
    headline: str = ""

    @property
    def trained(self) -> bool:
        """Whether its training is done, by the code of today."""
        return self.word in ("done", "stale") and "train" not in self.stale


def run_dir(job: Job, runs: Path) -> Path:
    return runs / job.slug


def load_row(directory: Path) -> dict[str, Any] | None:
    return read_json(directory / "row.json")


def read_row(path: Path, job: Job) -> dict[str, Any] | None:
    """A job's row, where there is one.

    Raises:
        ValueError: it is damaged, or another job's.
    """
    row = read_json(path)
    if row is not None and (wrong := fault(row, job)):
        raise ValueError(f"{path} is {wrong}; delete it to run its {kind_of(job).noun} again")
    return row


def fault(row: Mapping[str, Any], job: Job) -> str:
    """Why a row cannot be this job's; empty where it can."""
    kind = kind_of(job)
    own = kind.identity(job)
    for key in row.keys() & kind.owner:
        if row[key] != own[key]:
            return f"another {kind.noun}'s: its {key} is {row[key]}, not {own[key]}"
    wrong = [section for section in row.keys() & SECTIONS if not isinstance(row[section], dict)]
    for section in {"metric", "time"}.difference(wrong):
        wrong += [key for key, value in row.get(section, {}).items() if not _fits(key, value)]
    if wrong:
        return f"damaged (its '{wrong[0]}')"
    return "" if row else "damaged (it says nothing)"


def _fits(key: str, value: Any) -> bool:
    """Metrics and times are numbers; a latency also says on what."""
    return isinstance(value, (int, float)) or key.startswith("latency.")


# --- status ---------------------------------------------------------------------------------------


def status(job: Job, runs: Path, data: Data | None = None) -> str:
    """Of a cell: done | stale | failed | interrupted | running | missing; of a timing: done | stale
    | wrong | failed | unavailable | missing"""
    return inspect(job, runs, data).word


def inspect(job: Job, runs: Path, data: Data | None = None) -> State:
    """A job's status, why it is that, and its row where there is one.

    Args:
        data: those that it would run on; a row of others is stale. None: not known.
    """
    if (owner := claimed_by(run_dir(job, runs))) is not None:
        return State("running", "" if not owner or is_here(owner) else ELSEWHERE)
    return stored(job, runs, data)


def inspect_done(job: Job, runs: Path, data: Data | None = None) -> State:
    """As `inspect`, of a job that is known to be done: what a shared folder's cache does not show
    yet is waited for."""
    deadline = time.monotonic() + SHOWN_S
    state = inspect(job, runs, data)
    while state.word in ("missing", "interrupted", "running") and time.monotonic() < deadline:
        time.sleep(0.5)
        for folder in (runs, run_dir(job, runs)):
            if folder.is_dir():
                list(folder.iterdir())  # reading a folder asks the server what is in it
        state = inspect(job, runs, data)
    return state


def stored(job: Job, runs: Path, data: Data | None = None) -> State:
    """The status that the files give, whoever runs the job at the moment; of damaged ones, what is
    to be done about them."""
    directory = run_dir(job, runs)
    try:
        row = read_row(kind_of(job).row_file(job, runs), job)
        failure = read_json(directory / "failed.json")
    except ValueError as error:
        return State("failed", str(error))
    if row is not None:
        return state_of(row, job, data)
    if failure is not None:
        return State("failed", str(failure.get("error", "")))
    if any((directory / name).exists() for name in ("code.json", "progress.json", "last.pt")):
        return State("interrupted")
    return State("missing")


def state_of(row: dict[str, Any], job: Job, data: Data | None = None) -> State:
    """The status of a job that has a row."""
    kind = kind_of(job)
    headline = kind.headline(row.get("metric", {}))
    try:
        stale = changed({**row.get("code", {}), "data": row.get("data")}, job, data)
        changes = provenance.in_words(stale)
    except ValueError as error:  # a plug-in or a data set that has gone, or is no such thing
        stale, changes = dict.fromkeys(kind.stages, str(error)), str(error)
    word = row.get("status", "done")
    if word != "done":
        return State(word, str(row.get(kind.why, "")), row, stale, headline)
    return State("stale" if stale else "done", changes, row, stale, headline)


def changed(before: Mapping[str, Any], job: Job, data: Data | None = None) -> dict[str, str]:
    """Stage -> what of its code or data changed since `before` was taken; empty for nothing.

    Raises:
        ValueError: a plug-in that is not there, or is no Python; data that lack what it needs.
    """
    kind = kind_of(job)
    found = provenance.changes(before, kind.code(job), kind.parts(job))
    if data is not None and isinstance(job, Cell):
        for stage, why in data.changes(job, before.get("data")).items():
            found[stage] = why if found.get(stage, why) == why else f"{found[stage]}, {why}"
    return found


def data_for(needed: Job, cell: Cell, data: Data | None) -> Data | None:
    """What a cell that another needs is compared with: what both are trained on.

    None for what a cell continues, which may be of another data set or folder.
    """
    before = with_parents([] if cell.continues is None else [cell.continues])
    return None if needed.id in [each.id for each in before] else data


@plugins.listed_once()
def rows(
    jobs: Iterable[Job],
    runs: Path,
    names: Mapping[str, str] = NOTHING,
    data: Data | None = None,
) -> list[dict[str, Any]]:
    """One row per job for a report: as stored where there is one, with the status of today.

    Args:
        names: id -> what the grid calls it.
    """
    found = []
    for job in jobs:
        state, kind = inspect(job, runs, data), kind_of(job)
        named = {"name": names[job.id]} if job.id in names else {}
        today = {"status": state.word, kind.why: state.why}
        found.append({**kind.identity(job), **(state.row or {}), **named, **today})
    return found


def all_rows(runs: Path) -> list[dict[str, Any]]:
    """The rows of all finished cells, with the status of today; a damaged one is told."""
    found = []
    for path in sorted(runs.glob("*/row.json")):
        try:
            cell = load_cell(path.with_name("cell.json"))
            row = read_row(path, cell) or {}
        except ValueError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        state = state_of(row, cell)
        found.append({**row, "status": state.word, "error": state.why})
    return found


@plugins.listed_once()
def to_run(
    jobs: Iterable[Job], runs: Path, rerun: str | None = None, data: Data | None = None
) -> list[Job]:
    """The jobs without a result, those asked for again, and before them what they need.

    An output that was wrong is tried again once its code has changed.

    Args:
        rerun: `stale`: also those whose code changed, each from the first stage on that this
            concerns. `failed`: cells that failed begin at step 0 rather than at their checkpoint,
            and timings whose output was wrong are taken again. `all`: every job, from the start.
            `latency`: of cells that are done, only the latency; every timing.
    """
    found: dict[str, bool] = {}

    def wanted(job: Job) -> bool:
        if job.id not in found:
            state, kind = inspect(job, runs, data), kind_of(job)
            words = {*kind.unfinished, *kind.again.get(rerun or "", ())}
            found[job.id] = state.word in words or bool(state.word == "wrong" and state.stale)
        return found[job.id]

    return [job for job in with_parents(filter(wanted, jobs)) if wanted(job)]


@plugins.listed_once()
def summary(kind: Kind[Any], jobs: Iterable[Job], runs: Path, data: Data | None = None) -> str:
    """`done 3   failed 1`, and what to do about some of them."""
    states = [inspect(job, runs, data) for job in jobs]
    reasons = "; ".join(sorted({state.why for state in states if state.word == "stale"}))
    hints = {"stale": f" ({reasons}; --rerun stale)", "failed": " (tried again by the next ablate)"}
    hints["wrong"] = " (--rerun failed)"
    counts = {word: sum(state.word == word for state in states) for word in kind.words}
    return "   ".join(f"{word} {n}{hints.get(word, '')}" for word, n in counts.items() if n)


@plugins.listed_once()
def hours_to_run(
    todo: Sequence[Job],
    jobs: Iterable[Job],
    runs: Path,
    rerun: str | None = None,
    data: Data | None = None,
) -> float | None:
    """Expected duration one after another, from those that are done; None where none is.

    Args:
        rerun: as in `to_run`. What keeps its training takes what its row says of the rest.
    """
    work = seconds = 0.0
    for job in jobs:
        kind, row = kind_of(job), inspect(job, runs).row
        if row is not None and kind.work(job) and kind.seconds(row):
            work += kind.work(job)
            seconds += kind.seconds(row)
    rest, left = 0.0, 0
    for job in todo:
        kind, state = kind_of(job), inspect(job, runs, data)
        if rerun in RENEWING and state.trained and state.row is not None:
            rest += kind.seconds(state.row, trained=True)
        else:
            left += kind.work(job)
    if left and not work:
        return None
    return (rest + (left and seconds / work * left)) / 3600


# --- beginning and failing ------------------------------------------------------------------------


def done_already(cell: Cell, runs: Path, renew: bool = False, data: Data | None = None) -> str:
    """A line that says so, and how to run it again; empty where it is not, or is stale and `renew`
    is said."""
    state = stored(cell, runs, data)
    if state.row is None or (renew and state.word == "stale"):
        return ""
    stale = f", but stale: {state.why}" if state.word == "stale" else ""
    remedy = f"{'--stale' if stale else '--rerun'} runs it again"
    return f"done already{stale} ({remedy}): {run_dir(cell, runs) / 'row.json'}"


def begin(cell: Cell, runs: Path, data: Data | None = None) -> tuple[Path, str]:
    """Make a claimed run directory ready; what was begun by other code for training, or on other
    data, is set aside.

    Returns:
        The directory, and a line about an earlier start that is not continued (empty for none).

    Raises:
        ValueError: a plug-in that is not there, or is no Python.
    """
    directory = run_dir(cell, runs)
    before, line = read_json(directory / "code.json"), ""
    if before is not None and "train" in (stale := changed(before, cell, data)):
        line = set_aside(directory, stale["train"])
    (directory / "failed.json").unlink(missing_ok=True)
    for remains in set(directory.glob(".*.tmp")).difference(directory.glob(".cell.json.*")):
        remains.unlink()  # of a killed run; a launcher that has no claim writes cells
    write_json(directory / "cell.json", to_dict(cell))
    record = data.of(cell) if data is not None else {}
    known = {"data": record} if record else {}
    write_json(directory / "code.json", {**provenance.code(cell), **known})
    return directory, line


def can_renew(cell: Cell, runs: Path, data: Data | None = None) -> bool:
    """Whether a stale row can be brought up to date, or at least tried, without training.

    Raises:
        ValueError: it could, were its weights here: nobody asked for a training.
    """
    state, weights = stored(cell, runs, data), run_dir(cell, runs) / "last.pt"
    if state.word != "stale" or not (state.trained or unsure(state.stale)):
        return False
    if not cell.single_task and not weights.is_file():
        raise ValueError(
            f"{state.why}, and {weights} is not here to evaluate again: mtl-bench collect "
            f"--weights brings it, --rerun trains anew"
        )
    return True


def unsure(stale: Mapping[str, str]) -> bool:
    """Whether the training may be as good as it was, which an evaluation as before tells.

    Not so where the files of training alone were written anew: that one would not see them.
    """
    return all(stale.get(stage) in provenance.UNSURE for stage in STAGES)


def set_aside(directory: Path, why: str) -> str:
    """Move an earlier training into a folder of its own, so that another begins at step 0.

    Returns:
        A line that says so and why; empty where nothing was trained.
    """
    if not any((directory / name).exists() for name in TRAINED):
        clear(directory)
        return ""
    numbers = [int(path.name.removeprefix(ASIDE)) for path in directory.glob(f"{ASIDE}*")]
    aside = directory / f"{ASIDE}{max(numbers, default=0) + 1}"
    aside.mkdir()
    for path in _of_a_start(directory):
        path.rename(aside / path.name)
    if (directory / "cell.json").is_file():
        shutil.copy(directory / "cell.json", aside)
    return f"starting over ({why}); what there was is kept in {aside}"


def clear(directory: Path) -> None:
    """Forget checkpoint, row and failure: the next start begins at step 0."""
    for path in _of_a_start(directory):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _of_a_start(directory: Path) -> list[Path]:
    """What a run directory has of its last start."""
    paths = list(directory.iterdir()) if directory.is_dir() else []
    return [p for p in paths if p.name not in KEPT and not p.name.startswith(ASIDE)]


def write_failure(directory: Path, error: str, trace: str = "", code: int | None = None) -> None:
    """Leave `failed.json`: the error in one line, the end of its traceback, the exit code."""
    tail = "\n".join(trace.splitlines()[-30:])
    write_json(directory / "failed.json", {"error": error, "traceback": tail, "exit_code": code})
