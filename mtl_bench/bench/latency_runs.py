"""Takes the timings of a latency grid, one process after another, and keeps their rows.

runs/latency/
    claim       who is timing now: one launcher at a time, with one process at a time
    <id>.json   a timing's row, by rename at its end: what `mtl-bench latency --json` wrote, and
                `timing`, `code` (fingerprints), `seconds`
    <id>.log    what the process printed

A launcher that was killed is started again: rows that are there are reused. Cells that train in the
same runs folder hold still while a timing is taken.
"""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from mtl_bench import engines
from mtl_bench.bench import claim, launch, results
from mtl_bench.bench.timing import Timing
from mtl_bench.core import provenance
from mtl_bench.core.config import Recipe
from mtl_bench.core.fingerprint import Root, fingerprints, of_package
from mtl_bench.core.plain import to_dict
from mtl_bench.core.quiet import Quiet

Word = Literal["done", "stale", "wrong", "failed", "unavailable", "missing"]
WORDS: tuple[Word, ...] = get_args(Word)
BAD = ("wrong", "failed", "missing")  # what makes `ablate` end with 1; an engine may be absent
AGAIN: dict[str | None, tuple[Word, ...]] = {  # --rerun: what is timed again beside what lacks
    None: (),
    "failed": ("wrong",),
    "stale": ("stale",),
    "all": WORDS,
    "latency": WORDS,
}
POLL_S = 0.1

Command = Callable[[Timing, Path], Sequence[str]]  # a timing, and the file for its row
Lack = Callable[[Timing], str | None]  # why it cannot be taken here


@dataclass(frozen=True)
class State:
    word: Word
    why: str = ""
    row: dict[str, Any] | None = None

    @property
    def headline(self) -> str:
        metric = (self.row or {}).get("metric", {})
        if "latency.mean_ms" not in metric:
            return ""
        noisy = "  noisy" * bool(metric.get("latency.noisy"))
        return f"{metric['latency.mean_ms']:.1f} ms  FPS {metric['latency.fps']:.1f}{noisy}"


def path_of(timing: Timing, runs: Path) -> Path:
    return runs / "latency" / f"{timing.id}.json"


def inspect(timing: Timing, runs: Path) -> State:
    """A timing's status, why it is that, and its row where there is one.

    Raises:
        ValueError: a row that is damaged.
    """
    row = results.read_json(path_of(timing, runs))
    if row is None:
        return State("missing")
    changed = _changed(row["code"], timing) if row["status"] == "done" else ""
    if changed:
        return State("stale", changed, row)
    return State(row["status"], str(row.get("why", "")), row)


def to_run(timings: Iterable[Timing], runs: Path, rerun: str | None = None) -> list[Timing]:
    """The timings without a result or with that of a wrong engine mended since, and more.

    Args:
        rerun: `stale`: also those whose code changed. `failed`: also those whose output was wrong.
            `all`, `latency`: every one.
    """
    wanted = {"missing", "failed", "unavailable", *AGAIN[rerun]}
    states = [(timing, inspect(timing, runs)) for timing in timings]
    return [timing for timing, state in states if state.word in wanted or _mended(timing, state)]


def _mended(timing: Timing, state: State) -> bool:
    """Whether its output was wrong and may be right by now, since code has changed."""
    return state.word == "wrong" and bool(_changed((state.row or {})["code"], timing))


def rows(timings: Iterable[Timing], runs: Path) -> list[dict[str, Any]]:
    """One row per timing for a report: as stored where there is one, with the status of today."""
    found = []
    for timing in timings:
        state = inspect(timing, runs)
        blank = {**_identity(timing), "timing": to_dict(timing)}
        found.append({**blank, **(state.row or {}), "status": state.word, "why": state.why})
    return found


def summary(timings: Iterable[Timing], runs: Path) -> str:
    """`done 3   unavailable 1`, and what to do about some of them."""
    words = [inspect(timing, runs).word for timing in timings]
    hints = {"stale": " (--rerun stale)", "failed": " (tried again by the next ablate)"}
    hints["wrong"] = " (--rerun failed)"
    return "   ".join(
        f"{word} {words.count(word)}{hints.get(word, '')}" for word in WORDS if word in words
    )


def hours_to_run(todo: Sequence[Timing], timings: Iterable[Timing], runs: Path) -> float | None:
    """Expected duration: that of the done ones a pass and a pixel; None where none is done.

    A limit of seconds is not looked at: with one it is shorter.
    """
    known = [
        (timing, row["seconds"])
        for timing, row in ((timing, inspect(timing, runs).row) for timing in timings)
        if row is not None and row["status"] == "done"
    ]
    if not known:
        return None
    seconds = sum(seconds for _, seconds in known) / sum(_work(timing) for timing, _ in known)
    return seconds * sum(_work(timing) for timing in todo) / 3600


def _work(timing: Timing) -> int:
    return timing.passes * timing.height * timing.width


def timing_command(timing: Timing, file: Path, data: Path | None = None) -> list[str]:
    """What takes a timing, here or in a terminal, and writes its row to `file`."""
    words = ["--engine", timing.engine, "--precision", timing.precision, "--size", timing.size]
    words += ["--tasks", ",".join(timing.tasks), "--passes", str(timing.passes)]
    words += [] if timing.seconds is None else ["--seconds", str(timing.seconds)]
    if timing.weights is not None:
        words += ["--checkpoint", str(Path(timing.weights) / "last.pt")]
    else:
        words += ["--backbone", timing.backbone]
        words += [] if timing.recipe == Recipe().name else ["--recipe", timing.recipe]
        for key, value in timing.backbone_args.items():
            words += ["--set", f"backbone.{key}={json.dumps(value)}"]
    words += ["--device", timing.device, *(["--data", str(data)] if data is not None else [])]
    return [sys.executable, "-m", "mtl_bench", "latency", *words, "--json", str(file)]


# --- running --------------------------------------------------------------------------------------


def run(
    timings: Sequence[Timing],
    runs: Path,
    command: Command,
    lack: Lack,
    say: Callable[[str, bool], None],
    smoke: bool = False,
) -> None:
    """Take the timings, one after another; each leaves its row, whatever becomes of it.

    Args:
        lack: why a timing cannot be taken on this machine; then no process is started for it.
        say: is told a line, and whether it is about something that went wrong.
        smoke: stands in the rows.

    Raises:
        ClaimedError: another launcher takes timings in this runs folder.
        KeyboardInterrupt: after the running process has ended; its timing has no row then.
    """
    with claim.claim(runs / "latency"):
        for number, timing in enumerate(timings, 1):
            label = f"[{number}/{len(timings)}] {timing.label}"
            say(f"{label}  started", True)
            code, began = _code(timing), time.monotonic()
            why = lack(timing)
            row = _taken(timing, runs, command) if why is None else _unavailable(timing, why)
            seconds = time.monotonic() - began
            row |= {"timing": to_dict(timing), "smoke": smoke, "code": code, "seconds": seconds}
            results.write_json(path_of(timing, runs), row)
            state = inspect(timing, runs)
            ok = state.word not in BAD
            word = state.word if ok else state.word.upper()
            about = [state.headline or state.why]
            about += [] if ok else [f"log: {_log(timing, runs)}"]
            say("  ".join([f"{label}  {word}  {seconds:.0f}s", *about]), ok)


def _taken(timing: Timing, runs: Path, command: Command) -> dict[str, Any]:
    """What the timing's process wrote, or why it wrote nothing."""
    written = path_of(timing, runs).with_suffix(".new")
    written.unlink(missing_ok=True)
    with Quiet(runs).alone(_neighbours(runs)), _log(timing, runs).open("wb") as log:
        process = subprocess.Popen(
            command(timing, written),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=launch.child_environment(1),
            start_new_session=True,  # Ctrl-C reaches it once, through `_stop`
        )
        try:
            code = process.wait()
        except BaseException:
            _stop(process)
            raise
    if code in launch.INTERRUPTED:
        raise KeyboardInterrupt(f"{timing.label} was told to stop")
    row: dict[str, Any] | None = results.read_json(written)
    written.unlink(missing_ok=True)
    if row is None:
        text = _log(timing, runs).read_text(errors="replace")
        why = launch.explain_exit(code, text)
        return {**_identity(timing), "status": "failed", "why": why}
    return row


def _stop(process: "subprocess.Popen[bytes]") -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(launch.GRACE_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        process.wait()


def _unavailable(timing: Timing, why: str) -> dict[str, Any]:
    return {**_identity(timing), "status": "unavailable", "why": why}


def _identity(timing: Timing) -> dict[str, Any]:
    return {
        "kind": "latency",
        "backbone": timing.backbone,
        "tasks": list(timing.tasks),
        "engine": timing.engine,
        "precision": timing.precision,
        "height": timing.height,
        "width": timing.width,
    }


def _log(timing: Timing, runs: Path) -> Path:
    return path_of(timing, runs).with_suffix(".log")


def _neighbours(runs: Path) -> bool:
    """Whether cells are training in this runs folder; they need a moment to hold still."""
    claims = (path for path in runs.glob("*/claim") if path.parent != runs / "latency")
    return any(claim.claimed_by(path.parent) is not None for path in claims)


# --- what made a row ------------------------------------------------------------------------------


def roots(timing: Timing) -> list[Root]:
    """Of its network and frames only shapes count: training and data sets do not."""
    module, engine = engines.CLASSES[timing.engine]
    return [
        provenance.backbone_root(timing.backbone),
        Root(of_package("engines.timed"), ("row",)),
        Root(of_package(f"engines.{module}"), (engine,)),
        Root(of_package("deploy"), ("name_classes", "_camera", "_only")),
        Root(of_package("latency"), ("prepare",)),
        Root(of_package("model"), ("build_model", "side_by_side")),
    ]


def _code(timing: Timing) -> provenance.Code:
    return {"time": fingerprints("time", roots(timing))}


def _changed(before: Mapping[str, Any], timing: Timing) -> str:
    """What changed since fingerprints were taken, in words; empty for nothing."""
    try:
        now = _code(timing)
    except ValueError as error:  # a plug-in that has gone, or has a double now
        return str(error)
    words = {"backbone": f"backbones/{timing.backbone}.py", "harness": "harness"}
    return provenance.in_words(provenance.changes(before, now, words))
