"""Which data a cell is trained and evaluated on: names, sizes and times of its files.

A row and a checkpoint keep this record, stage by stage. Other names or sizes are other data. Where
times alone differ, as in a copy, an evaluation tells: see `bench.run.renew`. Of generated data,
which may be rendered again at any time, the settings count and times do not.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtl_bench.core.config import Cell
from mtl_bench.core.provenance import STAMPED_BEFORE, TOUCHED

if TYPE_CHECKING:
    from mtl_bench.core.dataset import Dataset

CONTENTS = "MTL_BENCH_HASH_DATA"  # set: what is in the files is kept, too; it reads all of them
STAGES = ("train", "evaluate")

Record = dict[str, Any]  # frames, files, bytes; names, times and perhaps contents as hashes


@dataclass
class Data:
    """The data that a command is given.

    Args:
        root: their folder; None: the built-in ones.
    """

    root: Path | None
    _known: dict[Any, dict[str, Record]] = field(default_factory=dict)

    def of(self, cell: Cell, contents: bool = False) -> dict[str, Record]:
        """Stage -> record; of built-in data that may be still to render, the settings alone.

        Raises:
            ValueError: the folder lacks what the cell needs.
        """
        contents |= CONTENTS in os.environ
        key = (cell.recipe.data, cell.recipe.evaluate, cell.tasks, contents)
        if key not in self._known:
            self._known[key] = self._look(cell, contents)
        return self._known[key]

    def changes(self, cell: Cell, before: Mapping[str, Any] | None) -> dict[str, str]:
        """Stage -> in what its data differ from those of an earlier record; empty for nothing."""
        if before is None:
            return self._unrecorded(cell)
        now = self.of(cell)
        found = {stage: self._difference(cell, stage, before.get(stage, {})) for stage in now}
        return {stage: why for stage, why in found.items() if why}

    def _unrecorded(self, cell: Cell) -> dict[str, str]:
        """Of an older version's row only a recipe's own data are known to be the same."""
        if self.root is None:
            return {}
        from mtl_bench.core.dataset import dataset_of

        kind, data = dataset_of(cell.recipe), cell.recipe.data
        same = kind.built_in and kind.made_from(data, None) == kind.made_from(data, self.root)
        return {} if same else dict.fromkeys(STAGES, STAMPED_BEFORE)

    def _difference(self, cell: Cell, stage: str, before: Mapping[str, Any]) -> str:
        now = self.of(cell)[stage]
        if None not in (own := (before.get("made_from"), now["made_from"])):
            if own[0] != own[1]:
                return "other data, generated from other settings"
            return TOUCHED if _differ("names", before, now) else ""
        if before.get("names") != now.get("names"):
            return f"other data: {_words(now)}, before {_words(before)}"
        if not _differ("times", before, now):
            return ""
        if "contents" not in before:
            return TOUCHED
        same = self.of(cell, contents=True)[stage]["contents"] == before["contents"]
        return "" if same else "other data: other contents"

    def _look(self, cell: Cell, contents: bool) -> dict[str, Record]:
        from mtl_bench.core.dataset import dataset_of  # takes seconds, for torch

        made_from = dataset_of(cell.recipe).made_from(cell.recipe.data, self.root)
        if self.root is None:
            known = made_from is not None
            return {stage: {"made_from": made_from} for stage in STAGES if known}
        from mtl_bench.core.task import tasks_of_cell
        from mtl_bench.data.samples import open_samples
        from mtl_bench.evaluate.walk import open_walks

        tasks = tasks_of_cell(cell)
        samples = {
            "train": [open_samples(cell.recipe, tasks, "train", self.root, training=True)],
            "evaluate": [walk.samples for walk in open_walks(cell.recipe, tasks, self.root)],
        }
        return {
            stage: {
                "made_from": made_from,
                **_record([s.dataset for s in samples[stage]], self.root, contents),
            }
            for stage in STAGES
        }


def _differ(key: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    return key in before and key in now and before[key] != now[key]


def _record(datasets: "Iterable[Dataset]", root: Path, contents: bool) -> Record:
    datasets = list(datasets)
    names = [name for dataset in datasets for name in dataset.names]
    files = sorted({file for each in datasets for path in each.paths() for file in _below(path)})
    states = [(Path(os.path.relpath(file, root)).as_posix(), file.stat()) for file in files]
    found: Record = {
        "frames": len(names),
        "files": len(files),
        "bytes": sum(state.st_size for _, state in states),
        "names": _hash([*names, *((name, state.st_size) for name, state in states)]),
        "times": _hash(state.st_mtime_ns for _, state in states),
    }
    if contents:
        found["contents"] = _hash(map(_digest, files))
    return found


def _below(path: Path) -> Iterator[Path]:
    """The file, or all files in the folder that are not hidden; nothing of what is in memory."""
    if path.is_file():
        yield path
    for folder, folders, names in os.walk(path):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(folder, name) for name in names if not name.startswith("."))


def _hash(values: Iterable[Any]) -> str:
    return hashlib.sha256("\n".join(map(str, values)).encode()).hexdigest()[:12]


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _words(record: Mapping[str, Any]) -> str:
    if "files" not in record:
        return "the built-in ones"
    return f"{record['frames']} frames in {record['files']} files of {record['bytes']} bytes"
