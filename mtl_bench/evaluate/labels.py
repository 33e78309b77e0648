"""Pseudo labels by several ranks: each labels its share of the frames that have none."""

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from mtl_bench.core.dataset import LabelFrames, LabelGroup
from mtl_bench.core.ranks import Ranks
from mtl_bench.core.task import Task


class Share:
    """Frames of which all but some count as labelled, so that a task labels these alone."""

    def __init__(self, frames: LabelFrames, own: Collection[str]) -> None:
        self.names, self.out, self.folder = frames.names, frames.out, frames.folder
        self._frames, self._done = frames, set(frames.names).difference(own)

    def groups(self) -> Iterator[LabelGroup]:
        return self._frames.groups()

    def image(self, name: str) -> Path:
        return self._frames.image(name)

    def done(self) -> set[str]:
        return self._done

    def stranger(self) -> Path | None:
        return self._frames.stranger()

    def record(self) -> dict[str, Any]:
        return self._frames.record()

    def write(self, name: str, ids_HW: NDArray[np.uint16]) -> None:
        self._frames.write(name, ids_HW)


def label(
    task: Task,
    model: nn.Module,
    frames: LabelFrames,
    device: torch.device,
    ranks: Ranks,
    progress: Callable[[int, int], None],
) -> Path:
    """As `Task.label`, with the same bytes, by several ranks that write into the same folder.

    A share is of frames that follow each other: a task predicts batches of all the frames, so only
    one that two ranks have a part of is predicted twice.

    Args:
        progress: told at the start, after each frame of this rank, when it takes the others to be
            as far, and at the end.

    Raises:
        LostError, KeyboardInterrupt: another rank has ended.
    """
    if ranks.size == 1:
        return task.label(model, frames, device, progress)
    lacking: list[int] = ranks.from_first(_lacking(frames) if ranks.first else None)
    count = len(lacking)
    start, end = (rank * count // ranks.size for rank in (ranks.rank, ranks.rank + 1))
    own = [frames.names[place] for place in lacking[start:end]]

    def note(labelled: int, of: int) -> None:
        made = labelled - (of - len(own))
        if made == 0 and ranks.first:
            ranks.gather(None)  # the folder is claimed
        ranks.still_all()
        progress(min(of - count + made * ranks.size, of), of)

    if not ranks.first:
        ranks.gather(None)
    folder = task.label(model, Share(frames, own), device, note)
    ranks.gather(None)  # every frame has its label
    progress(len(frames.names), len(frames.names))
    return folder


def _lacking(frames: LabelFrames) -> list[int]:
    """Places of the frames that have no label."""
    done = frames.done()
    return [place for place, name in enumerate(frames.names) if name not in done]
