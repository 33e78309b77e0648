"""Which cells `ablate`, `status` and `report` are about."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mtl_bench.commands import options as o

if TYPE_CHECKING:
    from mtl_bench.grids import Grid


@dataclass(frozen=True)
class Choice:
    """What was said about which cells to take."""

    grid: str
    recipe: str | None
    seeds: int | None
    smoke: bool
    settings: list[str] | None
    pretrained: str | None

    def load(self) -> "Grid":
        from mtl_bench.grids import load_grid

        return load_grid(
            self.grid,
            recipe=self.recipe,
            seeds=self.seeds,
            smoke=self.smoke,
            settings=self.settings or [],
            pretrained=o.weights(self.pretrained),
        )

    @property
    def command(self) -> str:
        """How to run the same cells again; files without their folders."""
        words = ["mtl-bench", "ablate", "--grid", Path(self.grid).name]
        for option, value in (
            ("--recipe", self.recipe and Path(self.recipe).name),
            ("--seeds", self.seeds),
            ("--pretrained", self.pretrained and Path(self.pretrained).name),
        ):
            words += [option, str(value)] if value is not None else []
        words += ["--smoke"] * self.smoke
        for setting in self.settings or []:
            words += ["--set", setting]
        return shlex.join(words)
