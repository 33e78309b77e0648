"""Atomic save and load of everything that the next training step depends on.

Only tensors and plain values are stored, and only they are read back (`weights_only`): loading a
stranger's checkpoint runs no code. The data position is the step itself (see `data/loader.py`). The
cell is in it, too, so that one file is enough to use what was trained.
"""

import pickle
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core.config import Cell, from_dict, to_travel
from mtl_bench.core.files import replacing

FORMAT = 1
WHOLE = {  # what training goes on from; to use a model needs no more than "model"
    **{"step": int, "model": dict, "method": dict, "optimizer": dict, "scaler": dict},
    **{"rng": Tensor, "rng_cuda": list, "cell": dict},
}
REMEDY = "put the right file there, or delete it to begin at step 0"


def save(
    path: Path,
    step: int,
    model: nn.Module,
    method: nn.Module,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    cell: Cell,
) -> None:
    """A killed save leaves the previous checkpoint."""
    state = {
        "format": FORMAT,
        "step": step,
        "model": model.state_dict(),
        "constants": dict(_constants(model)),
        "method": method.state_dict(),
        "optimizer": optimizer.state_dict(),
        "scaler": scaler.state_dict(),
        "rng": torch.get_rng_state(),
        "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "cell": owner(cell),
    }
    with replacing(path) as file:
        torch.save(state, file)


def owner(cell: Cell) -> dict[str, Any]:
    """What a checkpoint says of its cell: its id, and its values for another machine."""
    return {"id": cell.id, "values": to_travel(cell)}


def read(path: Path, lazily: bool = False) -> dict[str, Any]:
    """The stored state, on the CPU.

    Args:
        lazily: tensors come from the file when they are used.

    Raises:
        ValueError: no such file, not a checkpoint, or one of another format.
    """
    if not path.is_file():
        row = path.with_name("row.json").is_file()
        raise ValueError(f"no checkpoint {path}" + "; mtl-bench collect --weights brings it" * row)
    if not zipfile.is_zipfile(path):
        why = "it is no file of torch.save, or cut off" if path.stat().st_size else "it is empty"
        raise ValueError(f"{path} is not a readable checkpoint: {why}; {REMEDY}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=lazily)
    except pickle.UnpicklingError:  # whose text tells how to run a stranger's code
        why = "it holds more than tensors and plain values, or is damaged"
        raise ValueError(f"{path} is not a readable checkpoint: {why}; {REMEDY}") from None
    except (RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError) as error:
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise ValueError(f"{path} is not a readable checkpoint: {why}; {REMEDY}") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise ValueError(f"{path} is not a checkpoint of format {FORMAT}; {REMEDY}")
    _require(path, state, "model", *(["cell"] if "cell" in state else []))
    return state


def cell_of(path: Path) -> Cell:
    """The cell that a checkpoint is of.

    Raises:
        ValueError: not a checkpoint, or one of an older version, which does not say.
    """
    values = read(path, lazily=True).get("cell")
    if values is None:
        raise ValueError(
            f"{path} is of an older version, which did not keep its cell in it: put its cell.json "
            f"beside it"
        )
    try:
        return from_dict(Cell, values["values"])
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise ValueError(f"the cell in {path} is none of this version's: {error}") from error


def require(path: Path, cell: Cell) -> None:
    """Raises: ValueError: not a checkpoint, or one that another cell has written."""
    other = read(path, lazily=True).get("cell", {}).get("id", cell.id)
    if other != cell.id:
        raise ValueError(f"{path} is of cell {other}, not of {cell.id}; {REMEDY}")


def restore(
    path: Path,
    cell: Cell,
    model: nn.Module,
    method: nn.Module,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
) -> int:
    """Put a stored state back into freshly built objects; returns the number of steps done.

    Raises:
        ValueError: no checkpoint, or not one of this cell.
    """
    require(path, cell)
    state = read(path)
    _require(path, state, *(name for name in WHOLE if name != "cell"))
    load(path, state, "model", model)
    load(path, state, "method", method)
    load(path, state, "optimizer", optimizer)
    load(path, state, "scaler", scaler)
    torch.set_rng_state(state["rng"])
    for index, drawn in enumerate(state["rng_cuda"][: torch.cuda.device_count()]):
        torch.cuda.set_rng_state(drawn, index)  # of those that were visible then: the first is used
    return int(state["step"])


def restore_weights(path: Path, model: nn.Module, method: nn.Module) -> None:
    """Put only the model's and the method's state back: where another training begins."""
    state = read(path)
    _require(path, state, "method")
    load(path, state, "model", model)
    load(path, state, "method", method)


def load(path: Path, state: dict[str, Any], name: str, into: Any) -> None:
    """Put one part of a state back; of a model, what it does not learn either, too.

    Raises:
        ValueError: it is not of this cell's.
    """
    try:
        into.load_state_dict(state[name])
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        lines = str(error).splitlines()
        why = lines[min(1, len(lines) - 1)].strip()
        raise ValueError(f"{path} is not of this cell's {name}: {why}") from None
    if name == "model":
        for key, value in _constants(into):
            value.copy_(state.get("constants", {}).get(key, value))


def _constants(model: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """Buffers that its state leaves out, such as what images are normalised by."""
    kept = model.state_dict().keys()
    return ((name, value) for name, value in model.named_buffers() if name not in kept)


def _require(path: Path, state: dict[str, Any], *names: str) -> None:
    for name in names:
        if not isinstance(state.get(name), WHOLE[name]):
            raise ValueError(f"{path} is not a whole checkpoint: it has no '{name}'; {REMEDY}")
