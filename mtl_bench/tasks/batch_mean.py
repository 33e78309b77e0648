"""The mean of batches' means, as published dense tables have it: `legacy_batch_mean`.

Those tables average a metric over each batch of the test loader, and then over batches, so that a
frame of few valid pixels counts as much as a full one, and a median is a mean of medians.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

KEY = "legacy_batch_mean"


class BatchMeans:
    """Means of batches of frames, of several quantities of one frame's pixels.

    Args:
        batch: frames of a batch; the published protocols evaluate with the training's.
        summaries: by name, of a batch's values, such as `np.median`.
    """

    def __init__(self, batch: int, summaries: Mapping[str, Callable[[NDArray[Any]], Any]]) -> None:
        self.batch, self.summaries = batch, summaries
        self.sums = np.zeros(len(summaries))
        self.batches = 0
        self.open: list[NDArray[Any]] = []  # frames [quantities,N] of the unfinished batch

    def add(self, *values_N: NDArray[Any]) -> None:
        """The next frame's valid pixels, one array for each quantity."""
        self.open.append(np.stack(values_N))
        if len(self.open) == self.batch:
            self.sums, self.batches = self._closed()
            self.open = []

    def _closed(self) -> tuple[NDArray[np.float64], int]:
        """Sums and number of batches, the unfinished one among them if it has a valid pixel."""
        values = np.concatenate(self.open, 1) if self.open else np.empty((len(self.sums), 0))
        if not values.size:
            return self.sums, self.batches
        pairs = zip(self.summaries.values(), values, strict=True)
        return self.sums + [float(summary(v)) for summary, v in pairs], self.batches + 1

    def state(self) -> dict[str, NDArray[Any]]:
        return {
            "legacy.sums": self.sums,
            "legacy.batches": np.array(self.batches),
            "legacy.open": np.concatenate(self.open or [np.empty((len(self.sums), 0))], 1),
            "legacy.sizes": np.array([frame.shape[1] for frame in self.open], np.int64),
        }

    def join(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on with the frames of another one's state."""
        self.sums = self.sums + state["legacy.sums"]
        self.batches += int(state["legacy.batches"])
        ends = state["legacy.sizes"].cumsum()[:-1]
        for frame in np.split(state["legacy.open"], ends, 1) if len(state["legacy.sizes"]) else ():
            self.add(*frame)

    def compute(self, prefix: str) -> dict[str, float]:
        """Keys of a row: `<prefix>.legacy_batch_mean.<name>`; none without a valid pixel."""
        sums, batches = self._closed()
        found = zip(self.summaries, (sums / max(batches, 1)).tolist(), strict=True)
        return {f"{prefix}.{KEY}.{name}": value for name, value in found} if batches else {}
