"""A grid file's section [report]: how its rows are tabulated."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mtl_bench.core.plain import did_you_mean, from_dict
from mtl_bench.report import FIGURES
from mtl_bench.report.columns import BY_NAME, ONLY


@dataclass(frozen=True)
class Layout:
    """What [report] may say.

    Raises:
        ValueError: a column, figure or part that does not exist.
    """

    rows: str = "backbone"  # the field of a cell that names a line, or "name": the file's [[row]]s
    first: tuple[str, ...] = ()  # columns that stand before the others
    only: str | None = None  # "cost": step time and memory alone, without figures
    reference: str | None = None  # the line (value of `rows`) that these two are relative to, too
    readme: tuple[str, ...] = ("pq_fps", "rmse_fps")  # figures beside the table in a README

    def __post_init__(self) -> None:
        _known("column", self.first, BY_NAME)
        _known("figure", self.readme, FIGURES)
        _known("part", () if self.only is None else (self.only,), ONLY)

    @staticmethod
    def of(values: Mapping[str, Any]) -> "Layout":
        """From a grid file's section.

        Raises:
            ValueError: an unknown key, a value of another type, or what `Layout` raises.
        """
        return from_dict(Layout, values, "report.")


def _known(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = tuple(known)
    for name in names:
        if name not in known:
            raise ValueError(f"[report] names no {kind} '{name}'{did_you_mean(name, known)}")
