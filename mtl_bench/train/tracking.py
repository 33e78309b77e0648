"""Weights & Biases, off unless asked for; imported only then."""

from pathlib import Path
from typing import Any

from mtl_bench.core.config import Cell, to_dict

MODES = ("off", "offline", "online")


class Tracker:
    """Logs a cell's curve and metrics; its id is wandb's run id, so that a resume continues it.

    Raises:
        ValueError: an unknown mode.
    """

    def __init__(self, mode: str, cell: Cell, run_dir: Path):
        if mode not in MODES:
            raise ValueError(f"no wandb mode '{mode}' (known: {', '.join(MODES)})")
        self._run: Any = None
        if mode != "off":
            import wandb

            self._run = wandb.init(
                project="mtl-bench",
                mode=mode,  # type: ignore[arg-type]
                id=cell.id,
                name=cell.slug,
                resume="allow",
                dir=str(run_dir),
                config=to_dict(cell),
            )

    def log(self, values: dict[str, float], step: int | None = None) -> None:
        if self._run is not None:
            self._run.log(values, step=step)

    def finish(self) -> None:
        if self._run is not None:
            self._run.finish()
