"""A measured quantity: where a row has it, how it is written and what it counts for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """All facts of one measured quantity; tables, plots, deltas and headlines are made of them."""

    name: str  # in table.csv, and in the names of figures
    key: str  # dotted key of a row, or of its metrics
    title: str
    better: int  # +1: higher, -1: lower, 0: neither
    digits: int
    unit: str = ""
    note: str = ""  # how it was made, where one must know: median-scaled
    scale: float = 1.0  # from the row's unit to this one
    part: str = "quality"  # quality | cost
    task: str = ""
    in_delta: bool = False  # whether it counts in the multi-task delta
    headline: bool = False  # whether it is plotted, and stands on lists of published rows
    short: bool = False  # whether it stands where few columns fit; a headline always does
    scientific: bool = False  # written as 3e-07
    words: str = ""  # the title in a sentence, where that is another
    tex: str = ""  # the title in LaTeX, where that is another

    @property
    def about(self) -> str:
        """What stands under the title: unit and note."""
        return ", ".join(filter(None, (self.unit, self.note)))

    @property
    def in_words(self) -> str:
        return self.words or self.title


FPS = Column(
    *("fps", "latency.fps", "FPS", +1, 1),
    part="cost",
    headline=True,
    words="frames per second",
)
