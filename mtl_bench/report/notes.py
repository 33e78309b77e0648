"""What a reader of the table must know, said only where it applies."""

from collections.abc import Iterator

from mtl_bench.report.tables import Table


def footnotes(table: Table) -> list[str]:
    """One sentence or two for each thing that occurs in the table; `+-` stands for the sign."""
    return list(_footnotes(table))


def _footnotes(table: Table) -> Iterator[str]:
    groups = table.groups
    if any(len(group.rows) > 1 for group in groups):
        yield (
            "Mean +- sample standard deviation over n seeds. Bold: ahead of every other plain line "
            "by more than either's spread, and of the trivial predictor by more than its own."
        )
    if any(len(group.rows) == 1 for group in [g for g in groups if not g.mark] or groups):
        yield (
            "n = 1: one seed has no spread, so a lead by it or over it cannot be told from chance, "
            "and nothing is bold."
        )
    if any(0 < e.count < len(g.rows) for g in groups for e in g.entries.values()):
        yield "A number with its own n is the mean over those seeds that have the value."
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
