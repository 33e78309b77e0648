"""Which cells `ablate`, `status` and `report` are about."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mtl_bench.cli import options as o

if TYPE_CHECKING:
    from mtl_bench.bench.grid import Grid
    from mtl_bench.bench.latency_grid import LatencyGrid


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
        from mtl_bench.bench.grid import load_grid

        return load_grid(
            self.grid,
            recipe=self.recipe,
            seeds=self.seeds,
            smoke=self.smoke,
            settings=self.settings or [],
            pretrained=o.weights(self.pretrained),
        )

    @property
    def is_latency(self) -> bool:
        """Whether the grid times networks instead of training cells."""
        from mtl_bench.bench import grid_file

        return grid_file.kind_of(grid_file.read(self.grid)) == grid_file.LATENCY

    def load_latency(self, device: o.Device = o.Device.auto) -> "LatencyGrid":
        """The same of a grid that times networks.

        Raises:
            ValueError: as `latency_grid.load`, or an option that is about training.
        """
        from mtl_bench.bench import latency_grid

        for option, value in (("--seeds", self.seeds), ("--pretrained", self.pretrained)):
            if value is not None:
                raise ValueError(f"{option} {value}: grid '{self.grid}' times, and trains nothing")
        settings = [f"recipe={self.recipe}"] if self.recipe is not None else []
        kind = device.value
        if kind == "auto":
            from mtl_bench.core.device import choose_device

            kind = choose_device(kind).type
        return latency_grid.load(
            self.grid,
            smoke=self.smoke,
            settings=[*settings, *(self.settings or [])],
            device=kind,
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
