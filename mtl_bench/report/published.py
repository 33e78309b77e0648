"""The paper's comparison tables as `literature/*.toml` hold them: what is printed, and its source.

Numbers stay as printed (63.05, 63 and 5.240): `Decimal` keeps their digits.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

from mtl_bench.core.plain import did_you_mean, from_dict
from mtl_bench.report.columns import BY_NAME, Column

FOLDER = Path(__file__).parent / "literature"
TEXTS = {  # columns of words: their titles
    "method": "Method",
    "backbone": "Backbone",
    "input": "Input size",
    "data": "DS",
    "device": "Device",
    "protocol": "Protocol",
    "frames": "Frames",
}
NUMBERS = {  # columns of numbers; {depth} is where a protocol's depth metrics are
    column.name: column
    for column in (
        Column("pq", "PQ", "panoptic.pq", +1, 1, note="%"),
        Column("abs_rel", "AbsRel", "{depth}.abs_rel", -1, 3),
        Column("rmse", "RMSE", "{depth}.rmse", -1, 3, note="m"),
        Column("delta1", "delta1", "{depth}.delta1", +1, 3, note="< 1.25"),
        Column("delta2", "delta2", "{depth}.delta2", +1, 3, note="< 1.25^2"),
        Column("delta3", "delta3", "{depth}.delta3", +1, 3, note="< 1.25^3"),
        Column("runtime_ms", "Runtime", "latency.mean_ms", -1, 1, note="ms"),
        BY_NAME["fps"],
    )
}


@dataclass(frozen=True)
class Literature:
    """One table of the paper, and what may stand beside it."""

    name: str  # of the data set, as one writes it
    title: str
    label: str  # of the table in the paper's source
    source: str
    datasets: tuple[str, ...]  # of cells measured on it
    built_in: tuple[str, ...]  # of cells measured on rendered scenes in its layout
    split: str
    frames: int  # of the split, as papers report it
    columns: tuple[str, ...]  # of TEXTS and NUMBERS, in their order
    narrow: tuple[str, ...]  # those that fit on a page of a paper
    sort: str  # the column
    data: str = ""  # what the column of training images says of measured rows
    protocols: tuple[str, ...] = ()  # of depth that the table compares; none: no depth in it
    width_first: bool = False  # how a size is written
    titles: Mapping[str, str] = field(default_factory=dict)  # other than in TEXTS
    notes: tuple[str, ...] = ()
    symbols: Mapping[str, str] = field(default_factory=dict)  # behind a method: what it says
    row: tuple[Mapping[str, Any], ...] = ()  # columns, details, source; symbols, note, printed_as

    @property
    def numbers(self) -> list[Column]:
        return [NUMBERS[name] for name in self.columns if name in NUMBERS]


def names() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(name: str) -> Literature:
    """A table by its name.

    Raises:
        ValueError: no such table.
    """
    if name not in names():
        raise ValueError(f"no table called '{name}'{did_you_mean(name, names())}")
    text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    return from_dict(Literature, tomllib.loads(text, parse_float=Decimal))
