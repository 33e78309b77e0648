"""A figure's file: whole under its name, or not there."""

import os
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """By a temporary sibling, of which an error leaves nothing; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
