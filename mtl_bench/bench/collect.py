"""Results from elsewhere: of other runs folders, and of a grid's rows kept as one file.

What comes in is what `store` calls done by the code of today, and goes where nothing good is yet;
on request also what other code made, where nothing is.
A pack is text, compressed by xz: a line that says what it is, then a line a job, in the order of
their folders' names. `xzcat FILE` shows it; the same rows make the same bytes.
"""

import json
import lzma
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from mtl_bench.bench import store
from mtl_bench.bench.jobs import Job, Timing, kind_of, load_cell
from mtl_bench.core import provenance
from mtl_bench.core.config import Cell, to_travel
from mtl_bench.core.files import read_json, replacing, write_json, write_text
from mtl_bench.core.locks import ClaimedError, claim
from mtl_bench.core.plain import from_dict, to_dict
from mtl_bench.train import curve

FORMAT = {"format": "mtl-bench rows", "version": 1}
CURVE = "curve.csv"
BESIDE = (CURVE, "env.json", "samples.npz")  # what a report reads, and what ran
WEIGHTS = ("taken.json", "code.json", "last.pt")  # the last: what is there is whole
FAILED = ("code.json", "failed.json")
PRESET = 6 | lzma.PRESET_EXTREME  # a window of 8 MiB, some hundred rows
KINDS: dict[str, type[Job]] = {"cell": Cell, "timing": Timing}  # a line's key -> what is in it
NAMED = 3  # of those that were left out, for each reason


@dataclass(frozen=True)
class Found:
    """A job's result elsewhere, or how it failed."""

    job: Job
    row: dict[str, Any]  # of a failed cell empty
    failed: Mapping[str, Any] = field(default_factory=dict)  # FAILED -> what these files say
    beside: Mapping[str, Path | str] = field(default_factory=dict)  # files, or their text
    stale: bool = False  # made by other code

    @property
    def name(self) -> str:
        return self.job.slug


@dataclass(frozen=True)
class Left:
    """What is not taken, and why."""

    name: str
    kind: str  # stale | failed | unfinished | unreadable | already here | running here | ...
    why: str = ""


# --- reading --------------------------------------------------------------------------------------


def from_folder(
    runs: Path, weights: bool = False, failures: bool = False, stale: bool = False
) -> Iterator[Found | Left]:
    """What is in a runs folder, by name.

    Args:
        weights: take checkpoints along.
        failures: take cells, too, that failed by the code of today.
        stale: take rows, too, that other code made.
    """
    for path in sorted(runs.iterdir()):
        if (path / "cell.json").is_file() or (path / "row.json").is_file():
            yield _judged(path.name, partial(_of_cell, path, weights, failures), stale)
    for path in sorted((runs / "latency").glob("*.json")):
        yield _judged(f"latency/{path.stem}", partial(_of_timing, path), stale)


def _judged(name: str, read: Callable[[], Found | Left], stale: bool) -> Found | Left:
    """What can be read, as the store judges it: done by the code of today, or not."""
    try:
        found = read()
        return found if isinstance(found, Left) else _by_the_store(found, stale)
    except ValueError as error:
        return Left(name, "unreadable", " ".join(str(error).split()))


def _by_the_store(found: Found, stale: bool) -> Found | Left:
    if found.failed:
        changed = store.changed(found.failed["code.json"], found.job)
        return Left(found.name, "stale", provenance.in_words(changed)) if changed else found
    state = store.state_of(found.row, found.job)
    if state.word == "done" or (stale and state.word == "stale"):
        return replace(found, stale=state.word == "stale")
    return Left(found.name, state.word, state.why)


def _of_cell(directory: Path, weights: bool, failures: bool) -> Found | Left:
    cell = load_cell(directory / "cell.json")
    row = store.read_row(directory / "row.json", cell)
    if row is None:
        files = {name: read_json(directory / name) for name in FAILED}
        failed = {name: values for name, values in files.items() if values is not None}
        if failures and len(failed) == len(FAILED):
            return Found(cell, {}, failed)
        why = str(failed.get("failed.json", {}).get("error", ""))
        return Left(directory.name, "failed" if "failed.json" in failed else "unfinished", why)
    names = [*BESIDE, *(WEIGHTS if weights else ())]
    beside = {name: directory / name for name in names if (directory / name).is_file()}
    if CURVE in beside:
        curve.read(directory / CURVE)
    if "last.pt" in beside:
        from mtl_bench.train import checkpoint  # takes seconds, for torch

        checkpoint.require(directory / "last.pt", cell)
    return Found(cell, row, beside=beside)


def _of_timing(path: Path) -> Found | Left:
    values = (read_json(path) or {}).get("timing")
    if not isinstance(values, Mapping):
        raise ValueError(f"{path} is no row of a timing")
    timing = from_dict(Timing, values)
    row = store.read_row(path, timing)
    assert row is not None
    return Found(timing, row)


def read_pack(path: Path, stale: bool = False) -> Iterator[Found | Left]:
    """What is in a pack; `stale` as above.

    Raises:
        ValueError: it is no pack, of a newer version, or damaged.
    """
    for number, values in enumerate(_lines(path), 2):
        yield _judged(f"line {number} of {path}", partial(_of_line, values), stale)


def _of_line(values: Any) -> Found:
    if not isinstance(values, dict):
        raise ValueError("no job with its row")
    kind = next((kind for kind in KINDS if isinstance(values.get(kind), dict)), None)
    if kind is None or not isinstance(row := values.get("row"), dict):
        raise ValueError("no job with its row")
    job = from_dict(KINDS[kind], values[kind])
    failed = {name: values[name] for name in FAILED if isinstance(values.get(name), dict)}
    if len(failed) == len(FAILED):
        return Found(job, {}, failed)
    if wrong := store.fault(row, job):
        raise ValueError(f"the row is {wrong}")
    if not isinstance(values.get(CURVE, ""), str):
        raise ValueError(f"its {CURVE} is no text")
    return Found(job, row, beside={k: values[k] for k in (CURVE,) if k in values})


def _lines(path: Path) -> Iterator[Any]:
    """What the lines behind the first say, each a value of JSON."""
    try:
        with lzma.open(path, "rt", encoding="utf-8") as file:
            head = json.loads(next(file, "null"))
            if not isinstance(head, dict) or head.get("format") != FORMAT["format"]:
                raise ValueError("it begins with other words")
            if head.get("version") != FORMAT["version"]:
                own, its = FORMAT["version"], head.get("version")
                raise ValueError(f"it is of version {its}, and this one reads {own}")
            yield from map(json.loads, file)
    except (lzma.LZMAError, EOFError, ValueError) as error:
        raise ValueError(
            f"{path} is no pack of rows, or damaged ({error}); copy it again, or write one with "
            f"mtl-bench collect --pack"
        ) from None


# --- writing --------------------------------------------------------------------------------------


def write_pack(path: Path, jobs: Iterable[Found], curves: bool = False) -> None:
    """All or nothing: the file appears when it is whole.

    Args:
        curves: with them, which may be a hundred times as large.
    """
    with replacing(path) as file, lzma.open(file, "wb", preset=PRESET) as packed:

        def write(values: Mapping[str, Any]) -> None:
            packed.write(json.dumps(values, separators=(",", ":")).encode() + b"\n")

        write(FORMAT)
        for found in sorted(jobs, key=lambda found: found.name):
            job = found.job
            own = {"cell": to_travel(job)} if isinstance(job, Cell) else {"timing": to_dict(job)}
            log = found.beside.get(CURVE)
            kept = {CURVE: log.read_bytes().decode()} if curves and isinstance(log, Path) else {}
            write({**own, "row": found.row, **found.failed, **kept})


def put(found: Found, runs: Path) -> Left | None:
    """Take a result into a runs folder, where there is none as good; a stale, failed or unfinished
    one is set aside. Of one that is here already, files that are not here are taken.

    Returns:
        Why it is left out; None: it is in.
    """
    if isinstance(found.job, Timing):
        return _put_timing(found, runs)
    try:
        with claim(store.run_dir(found.job, runs)):
            return _put_cell(found, runs)
    except ClaimedError:
        return Left(found.name, "running here")


def _put_timing(found: Found, runs: Path) -> Left | None:
    if store.stored(found.job, runs).word in _as_good(found):
        return Left(found.name, "already here")
    file = kind_of(found.job).row_file(found.job, runs)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, found.row)
    return None


def _put_cell(found: Found, runs: Path) -> Left | None:
    directory, here = store.run_dir(found.job, runs), store.stored(found.job, runs)
    if found.failed and here.word != "missing":
        return Left(found.name, "already here", "tried here, too")
    good = here.word in _as_good(found)
    if good and here.row != found.row:
        return Left(found.name, "already here")
    lacking = [name for name in found.beside if not (directory / name).is_file()]
    if good and not lacking:
        return Left(found.name, "already here")
    if not good:
        store.set_aside(directory, "a collected result takes its place")
        write_json(directory / "cell.json", to_dict(found.job))
        lacking = list(found.beside)
    for name in lacking:
        _copy(found.beside[name], directory / name)
    for name, values in found.failed.items():
        write_json(directory / name, values)
    if not good and not found.failed:
        write_json(directory / "row.json", found.row)  # last: it is what makes a result
    return None


def _as_good(found: Found) -> tuple[str, ...]:
    """Words of the store for what a result must not replace."""
    return ("done", "stale") if found.stale else ("done",)


def _copy(source: Path | str, to: Path) -> None:
    if isinstance(source, str):
        write_text(to, source)
        return
    with source.open("rb") as opened, replacing(to) as file:
        shutil.copyfileobj(opened, file)


# --- both -----------------------------------------------------------------------------------------


def collect(
    sources: Iterable[Path],
    runs: Path,
    weights: bool = False,
    failures: bool = False,
    stale: bool = False,
) -> tuple[int, list[Left]]:
    """Take all that fits from runs folders and packs; how many were taken, and the rest.

    Args:
        weights, failures, stale: as in `from_folder`.

    Raises:
        ValueError: a source that is neither, before anything is taken.
    """
    sources = list(sources)
    for source in sources:
        if source.is_dir() and source.resolve() == runs.resolve():
            raise ValueError(f"{source} is --runs itself: name another folder")
        if source.is_dir() and not any(from_folder(source)):
            raise ValueError(f"no runs in {source}: a runs folder has folders with a row.json each")
        for _ in () if source.is_dir() else _lines(source):
            pass  # a damaged file is told before half of it is in
    taken, left = 0, []
    for source in sources:
        folder = source.is_dir()
        every = (
            from_folder(source, weights, failures, stale) if folder else read_pack(source, stale)
        )
        for each in every:
            why = each if isinstance(each, Left) else put(each, runs)
            taken += why is None
            left += [] if why is None else [why]
    return taken, left


def pack(
    path: Path,
    runs: Path,
    jobs: Iterable[Job] | None = None,
    curves: bool = False,
    failures: bool = False,
    stale: bool = False,
) -> tuple[int, list[Left]]:
    """Write a pack of what is done in a runs folder; how many jobs, and what was left out.

    Args:
        jobs: of these alone; without them, of all that are there.
        failures, stale: as in `from_folder`.

    Raises:
        ValueError: there is none.
    """
    every = list(from_folder(runs, failures=failures, stale=stale)) if runs.is_dir() else []
    if jobs is not None:
        names = {job.slug for job in jobs}
        every = [each for each in every if each.name in names]
        here = {each.name for each in every}
        every += [Left(name, "missing") for name in sorted(names - here)]
    found = [each for each in every if isinstance(each, Found)]
    if not found:
        raise ValueError(f"nothing to pack: no job that is done in {runs}")
    write_pack(path, found, curves)
    return len(found), [each for each in every if isinstance(each, Left)]


def told(left: Iterable[Left]) -> list[str]:
    """A line for each kind of what was left out."""
    kinds: dict[str, list[Left]] = {}
    for each in left:
        kinds.setdefault(each.kind, []).append(each)
    lines = []
    for kind, several in kinds.items():
        reasons = list(dict.fromkeys(each.why for each in several if each.why))
        names = [each.name for each in several]
        shown = ", ".join([*names[:NAMED], *[f"{len(names) - NAMED} more"] * (len(names) > NAMED)])
        why = f" ({'; '.join(reasons[:NAMED])})" if reasons else ""
        lines.append(f"left out, {kind}: {len(names)}{why}: {shown}")
    return lines
