"""What a reader must know before reading a grid's table: one sentence or two for each thing."""

from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from mtl_bench.core import quality
from mtl_bench.core.columns import Column
from mtl_bench.report.columns import DELTA, RELATIVE
from mtl_bench.report.delta import counted
from mtl_bench.report.table import FEWER

if TYPE_CHECKING:
    from mtl_bench.report.grid import Results

NUMERALS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def footnotes(results: "Results") -> Iterator[str]:
    """One sentence or two for each thing that occurs in the table; `+-` stands for the sign."""
    groups = results.groups
    if results.control is not None:
        yield (
            f"Mean +- sample standard deviation over n seeds. Bold: ahead of {results.control}, by "
            "differences paired by seed: their 95 % interval is on the better side of 0, and p is "
            "at most 0.05 by Holm over the other lines (Student's test)."
        )
    elif any(len(group.rows) > 1 for group in groups):
        floor = ", and of the trivial predictor by more than its own" if results.baseline else ""
        where = f" in {results.problem}, where nothing is tested" if results.problem else ""
        yield (
            f"Mean +- sample standard deviation over n seeds. Bold{where}: ahead of every other "
            f"plain line by more than either's spread{floor}."
        )
    if any(len(group.rows) == 1 for group in [g for g in groups if not g.mark] or groups):
        yield (
            "n = 1: one seed has no spread, so a lead by it or over it cannot be told from chance, "
            "and nothing is bold."
        )
    if any(len(group.rows) < results.seeds for group in groups):
        yield f"{FEWER} Fewer seeds than another line: mean and spread are not over the same."
    if any(0 < e.count < len(g.rows) for g in groups for e in g.entries.values()):
        yield "A number with its own n is the mean over those seeds that have the value."
    if DELTA[0] in results.columns():
        yield from _delta(results)
    if results.reference is not None:
        yield from _relative(results, results.reference)
    if results.baseline and results.tasks():
        yield _trivial(results.tasks())
    stale = [row for group in groups if group.status == "stale" for row in group.rows]
    if stale:
        why = ", ".join(dict.fromkeys(str(row["error"]) for row in stale if row.get("error")))
        because = f" ({why})" if why else ""
        yield f"Stale: code changed after these cells ran{because}; run again with --rerun stale."
    if any(group.smoke for group in groups):
        yield "Smoke: a few training steps that show that the pipeline works. Not a result."


def _delta(results: "Results") -> Iterator[str]:
    rows = [row for group in results.groups for row in group.rows]
    own = [row for row in rows if "delta_baseline" in row]
    against = " or ".join(dict.fromkeys(str(row["delta_baseline"]) for row in own))
    metrics = counted(rows)
    tasks = list(dict.fromkeys(column.task for column in metrics))
    joint = ", and " if len(metrics) > len(tasks) else ", "
    named = joint.join(_named([c for c in metrics if c.task == task]) for task in tasks)
    of = f" of {results.problem}" if results.problem else ""
    over = f"Delta{of}: over {named}, relative to the baseline ({against}) of the same seed."
    # of a suite it is said once, whatever a problem's metrics are
    counts = [" " + _count(things) for things in (metrics, tasks)] if not of else ["", ""]
    defined = (
        f"Flat: mean relative loss over the{counts[0]} metrics, so that "
        "less is better and a negative one is a gain. Task: mean relative gain, first over a "
        f"task's metrics and then over the{counts[1]} tasks, so that more is better. "
        "Log gain: likewise, of the ratios' logarithms, so that a halved and a doubled error weigh "
        "the same. The baseline's own is 0 by definition and not shown"
    )
    bold = "." if results.control is not None else "; bold is ahead of it, too."
    yield from (over, defined + bold) if of else (f"{over} {defined}{bold}",)


def _named(metrics: Sequence[Column]) -> str:
    """The titles, with what was done to all of them before: `median-scaled A, B and C`."""
    titles = [column.title for column in metrics]
    if not metrics[0].note:
        return ", ".join(titles)
    joined = " and ".join(filter(None, (", ".join(titles[:-1]), titles[-1])))
    return f"{metrics[0].note} {joined}"


def _count(things: Sequence[Any]) -> str:
    return NUMERALS[len(things)] if len(things) < len(NUMERALS) else str(len(things))


def _relative(results: "Results", reference: str) -> Iterator[str]:
    if any(group.entries[column.name].count for group in results.groups for column in RELATIVE):
        yield f"x of {reference}: a line's mean over that of the line '{reference}'."
    else:
        yield f"Nothing is relative to '{reference}': no such line has numbers."


def _trivial(tasks: Collection[str]) -> str:
    made = " and ".join(sorted(quality.words("trivial", tasks)))
    note = f"Trivial predictor: the training split's {made}. It looks at no image; a network has to"
    return " ".join([f"{note} beat it.", *quality.words("trivial_note", tasks)])
