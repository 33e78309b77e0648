"""The run directory of a cell: what is stored there, and what that says about the cell.

runs/<method>-<backbone>-s<seed>-<id>/
    cell.json      what to run, whole
    code.json      fingerprints of the code that began it, by stage: a checkpoint is continued by
                   no other code for training
    claim          who is running it now
    progress.json  how far that is
    last.pt        checkpoint          curve.csv  losses, weights, rate per step
    taken.json     memory, and seconds of pseudo labels, for a run that is continued
    pseudo_labels/ of a video cell, made by its parent's checkpoint
    log.txt        what the run printed
    row.json       the result; it appears by rename at the very end, so it exists = done
    failed.json    why there is none
    set-aside-N/   an earlier training, by code that has changed since
"""

import json
import os
import shutil
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

from mtl_bench.bench.claim import claimed_by
from mtl_bench.core import plugins, provenance
from mtl_bench.core.config import Cell, from_dict, to_dict
from mtl_bench.core.fingerprint import STAGES

Word = Literal["done", "stale", "failed", "interrupted", "running", "missing"]
WORDS: tuple[Word, ...] = get_args(Word)
HEADLINES = (  # metric, title, digits
    ("panoptic.pq", "PQ", 1),
    ("semantic.miou", "mIoU", 1),
    ("depth_median.rmse", "RMSE", 2),
    ("depth_median.abs_rel", "AbsRel", 3),
    ("latency.fps", "FPS", 1),
)
TRAINED = ("last.pt", "curve.csv", "pseudo_labels", "row.json")
ASIDE = "set-aside-"
KEPT = ("cell.json", "log.txt", "claim")  # what a fresh start leaves in place


@dataclass(frozen=True)
class State:
    word: Word
    why: str = ""
    row: dict[str, Any] | None = None
    stale: Mapping[str, str] = field(default_factory=dict)  # stage -> what of its code changed

    @property
    def trained(self) -> bool:
        """Whether its training is done, by the code of today."""
        return self.word in ("done", "stale") and "train" not in self.stale

    @property
    def headline(self) -> str:
        return headline((self.row or {}).get("metric", {}))


def run_dir(cell: Cell, runs: Path) -> Path:
    return runs / cell.slug


def write_json(path: Path, value: Any) -> None:
    """Atomic: a reader sees the old file or the new one, whole."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(value, file, indent=1)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read_json(path: Path) -> Any:
    """None where there is no such file.

    Raises:
        ValueError: a file that is no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it to run its cell again") from error


def load_row(directory: Path) -> dict[str, Any] | None:
    row: dict[str, Any] | None = read_json(directory / "row.json")
    return row


def load_cell(path: Path) -> Cell:
    """The cell of a `cell.json`.

    Raises:
        ValueError: no such file, or not a cell.
    """
    values = read_json(path)
    if values is None:
        raise ValueError(f"no cell file '{path}'")
    try:
        return from_dict(Cell, values)
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a cell: {error}") from error


# --- status ---------------------------------------------------------------------------------------


def status(cell: Cell, runs: Path) -> Word:
    """done | stale | failed | interrupted | running | missing"""
    return inspect(cell, runs).word


def inspect(cell: Cell, runs: Path) -> State:
    """A cell's status, why it is that, and its row where there is one."""
    if claimed_by(run_dir(cell, runs)) is not None:
        return State("running")
    return stored(cell, runs)


def stored(cell: Cell, runs: Path) -> State:
    """The status that the files give, whoever runs the cell at the moment."""
    directory = run_dir(cell, runs)
    row = load_row(directory)
    if row is not None:
        return state_of(row, cell)
    failure = read_json(directory / "failed.json")
    if failure is not None:
        return State("failed", str(failure.get("error", "")))
    if any((directory / name).exists() for name in ("code.json", "progress.json", "last.pt")):
        return State("interrupted")
    return State("missing")


def state_of(row: dict[str, Any], cell: Cell) -> State:
    """The status of a cell that has a row."""
    try:
        stale = changed(row.get("code", {}), cell)
    except ValueError as error:  # a plug-in that has gone, has a double now, or is no Python
        return State("stale", str(error), row, dict.fromkeys(STAGES, str(error)))
    return State("stale" if stale else "done", provenance.in_words(stale), row, stale)


def changed(before: Mapping[str, Any], cell: Cell) -> dict[str, str]:
    """Stage -> what of its code changed since fingerprints were taken; empty for nothing.

    Raises:
        ValueError: a plug-in that is not there, or is no Python.
    """
    words = {
        "method": " or ".join(f"methods/{name}.py" for name in plugins.part_names(cell.method)),
        "backbone": f"backbones/{cell.backbone}.py",
        "harness": "harness",
    }
    return provenance.changes(before, provenance.code(cell), words)


def rows(
    cells: Iterable[Cell], runs: Path, names: Mapping[str, str] = MappingProxyType({})
) -> list[dict[str, Any]]:
    """One row per cell for a report: as stored where there is one, with the status of today.

    Args:
        names: cell id -> what the grid calls it.
    """
    found = []
    for cell in cells:
        state = inspect(cell, runs)
        blank = {
            "cell_id": cell.id,
            "slug": cell.slug,
            "method": cell.method,
            "backbone": cell.backbone,
            "tasks": list(cell.tasks),
            "seed": cell.seed,
            "video": cell.video,
            "single_task": cell.single_task,
            "granularity": cell.granularity,
            "recipe": cell.recipe.name,
            "smoke": cell.recipe.smoke,
            "cell": to_dict(cell),
        }
        named = {"name": names[cell.id]} if cell.id in names else {}
        today = {"status": state.word, "error": state.why}
        found.append({**blank, **(state.row or {}), **named, **today})
    return found


def headline(metric: Mapping[str, Any]) -> str:
    """The first numbers that one wants to see of a row's metrics."""
    known = [item for item in HEADLINES if isinstance(metric.get(item[0]), (int, float))]
    return "  ".join(f"{title} {metric[key]:.{digits}f}" for key, title, digits in known)


# --- beginning and failing ------------------------------------------------------------------------


def begin(cell: Cell, runs: Path) -> tuple[Path, str]:
    """Make a claimed run directory ready; what other code for training had begun is set aside.

    Returns:
        The directory, and a line about an earlier start that is not continued (empty for none).

    Raises:
        ValueError: a plug-in that is not there, or is no Python.
    """
    directory = run_dir(cell, runs)
    before, line = read_json(directory / "code.json"), ""
    if before is not None and "train" in (stale := changed(before, cell)):
        line = set_aside(directory, stale["train"])
    (directory / "failed.json").unlink(missing_ok=True)
    write_json(directory / "cell.json", to_dict(cell))
    write_json(directory / "code.json", provenance.code(cell))
    return directory, line


def can_renew(cell: Cell, runs: Path) -> bool:
    """Whether a stale row can be brought up to date, or at least tried, without training."""
    state = stored(cell, runs)
    older = provenance.STAMPED_BEFORE in state.stale.values()
    there = cell.single_task or (run_dir(cell, runs) / "last.pt").is_file()
    return state.word == "stale" and there and (state.trained or older)


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
