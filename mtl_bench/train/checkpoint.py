"""Atomic save and load of everything that the next training step depends on.

Only tensors and plain values are stored, and only they are read back (`weights_only`): loading a
stranger's checkpoint runs no code. The data position is the step itself (see `data/loader.py`).
"""

import os
import pickle
from pathlib import Path
from typing import Any

import torch
from torch import nn

FORMAT = 1


def save(
    path: Path,
    step: int,
    model: nn.Module,
    method: nn.Module,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
) -> None:
    """Write to a temporary sibling and rename: a killed save leaves the previous checkpoint."""
    state = {
        "format": FORMAT,
        "step": step,
        "model": model.state_dict(),
        "method": method.state_dict(),
        "optimizer": optimizer.state_dict(),
        "scaler": scaler.state_dict(),
        "rng": torch.get_rng_state(),
        "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def read(path: Path) -> dict[str, Any]:
    """The stored state, on the CPU.

    Raises:
        ValueError: no such file, not a checkpoint, or one of another format.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ValueError(f"no checkpoint {path}") from None
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        why = str(error).splitlines()[0]
        raise ValueError(f"{path} is not a readable checkpoint: {why}") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise ValueError(f"{path} is not a checkpoint of format {FORMAT}")
    return state


def restore(
    state: dict[str, Any],
    model: nn.Module,
    method: nn.Module,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
) -> int:
    """Put a stored state back into freshly built objects; returns the number of steps done."""
    model.load_state_dict(state["model"])
    method.load_state_dict(state["method"])
    optimizer.load_state_dict(state["optimizer"])
    scaler.load_state_dict(state["scaler"])
    torch.set_rng_state(state["rng"])
    if state["rng_cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["rng_cuda"])
    return int(state["step"])


def restore_weights(state: dict[str, Any], model: nn.Module, method: nn.Module) -> None:
    """Put only the model's and the method's state back: where another training begins."""
    model.load_state_dict(state["model"])
    method.load_state_dict(state["method"])
