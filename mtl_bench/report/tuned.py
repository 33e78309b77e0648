"""Which settings the trials of a tuned grid chose, and what was tried."""

from collections.abc import Mapping, Sequence
from typing import Any

from mtl_bench.bench.space import SPLIT, Tune
from mtl_bench.core.text import in_a_line
from mtl_bench.report.columns import Row, text
from mtl_bench.report.table import Head, Section, TableRow


def section(rows: Sequence[Row], tune: Tune) -> Section:
    """A line for each line and problem: the trial, and what it set.

    Args:
        rows: with `tuned`, where the settings are chosen.
        tune: the grid's section [tune].
    """
    found = {(r["tuned"]["line"], r["tuned"]["problem"]): r["tuned"] for r in rows if "tuned" in r}
    lines = [
        TableRow.of(line, problem, str(tuned["trial"]), _values(tuned))
        for (line, problem), tuned in found.items()
    ]
    heads = (*Head.words("line", "problem"), Head("trial"), Head("settings", left=True))
    return Section(
        heading="Chosen settings",
        heads=heads,
        lines=tuple(lines),
        source=note(tune),
        caption=f"Chosen settings. {note(tune)}",
    )


def note(tune: Tune) -> str:
    """What was tried, and by what was chosen, in three sentences."""
    space = "; ".join(f"{key} {_where(where)}" for key, where in tune.space.items())
    seeds = ", ".join(map(str, tune.seeds))
    return (
        f"Every line, the baseline too, was tuned on every problem by {tune.trials} trials: the "
        f"published setting (trial 0) and quasi-random draws of {space}; and of what its method "
        f"declares. The best mean log of the metrics on the split {SPLIT} was chosen, at the last "
        f"step, with seed{'s' * (len(tune.seeds) > 1)} {seeds}; a failed trial counts as the "
        "worst. The reported split was read by the results alone, with other seeds."
    )


def _values(tuned: Mapping[str, Any]) -> str:
    if tuned["failed"]:
        return "published, as all trials failed"
    said = [f"{key} = {_setting(value)}" for key, value in tuned["values"].items()]
    return ", ".join(said) or "published"


def _setting(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key}: {text(inner)}" for key, inner in value.items())
    return in_a_line(text(value))


def _where(where: Any) -> str:
    """`log 0.1x ... 10x`, or the values."""
    if isinstance(where, Mapping):
        ((form, of),) = where.items()
        return f"{form} {of[0]} ... {of[1]}"
    return f"in {{{text(list(where))}}}"
