"""What a reader of the table must know, said only where it applies."""

from collections.abc import Iterator

from mtl_bench.report.columns import RELATIVE
from mtl_bench.report.tables import Table


def footnotes(table: Table) -> list[str]:
    """One sentence or two for each thing that occurs in the table; `+-` stands for the sign."""
    return list(_footnotes(table))


def _footnotes(table: Table) -> Iterator[str]:
    groups = table.groups
    if any(len(group.rows) > 1 for group in groups):
        floor = ", and of the trivial predictor by more than its own" if table.baseline else ""
        yield (
            "Mean +- sample standard deviation over n seeds. Bold: ahead of every other plain line "
            f"by more than either's spread{floor}."
        )
    if any(len(group.rows) == 1 for group in [g for g in groups if not g.mark] or groups):
        yield (
            "n = 1: one seed has no spread, so a lead by it or over it cannot be told from chance, "
            "and nothing is bold."
        )
    if any(0 < e.count < len(g.rows) for g in groups for e in g.entries.values()):
        yield "A number with its own n is the mean over those seeds that have the value."
    if "delta_flat" in [column.name for column in table.columns()]:
        yield _delta(table)
    if table.reference is not None:
        yield from _relative(table, table.reference)
    if table.baseline:
        yield (
            "Trivial predictor: the training split's mean depth image and most frequent class per "
            "pixel. It looks at no image; a network has to beat it. Its depth is in metres "
            "already, so nothing scales it under dgc."
        )
    stale = [row for group in groups if group.status == "stale" for row in group.rows]
    if stale:
        why = ", ".join(dict.fromkeys(str(row["error"]) for row in stale if row.get("error")))
        because = f" ({why})" if why else ""
        yield f"Stale: code changed after these cells ran{because}; run again with --rerun stale."
    if any(group.smoke for group in groups):
        yield "Smoke: a few training steps that show that the pipeline works. Not a result."


def _delta(table: Table) -> str:
    rows = [row for group in table.groups for row in group.rows if "delta_baseline" in row]
    against = " or ".join(dict.fromkeys(str(row["delta_baseline"]) for row in rows))
    return (
        "Delta: over PQ, mIoU, and median-scaled AbsRel, RMSE and delta1, relative to the baseline "
        f"({against}) of the same seed. Flat: mean relative loss over the five metrics, so that "
        "less is better and a negative one is a gain. Task: mean relative gain, first over a "
        "task's metrics and then over the two tasks, so that more is better. The baseline's own is "
        "0 by definition and not shown; bold is ahead of it, too."
    )


def _relative(table: Table, reference: str) -> Iterator[str]:
    if any(group.entries[column.name].count for group in table.groups for column in RELATIVE):
        yield f"x of {reference}: a line's mean over that of the line '{reference}'."
    else:
        yield f"Nothing is relative to '{reference}': no such line has numbers."
