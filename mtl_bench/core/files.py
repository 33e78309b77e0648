"""Files that a reader sees whole or not at all."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO


def is_litter(name: str) -> bool:
    """Whether a file or folder is an operating system's own, or hidden, in a folder of data."""
    return name.startswith(".") or name in ("Thumbs.db", "desktop.ini", "__MACOSX", "@eaDir")


def utf8_name(path: Path, reader: str) -> str:
    """A path as text for a library in C or Rust.

    Raises:
        ValueError: a name that is not UTF-8, at which such a library crashes.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ValueError(
            f"{os.fsencode(path)!r}: {reader} reads and writes no file whose name is not UTF-8; "
            f"rename it"
        ) from None
    return str(path)


@contextlib.contextmanager
def replacing(path: Path, synced: bool = True) -> Iterator[BinaryIO]:
    """A file to write, which appears under its name when the block ends, and not if it fails.

    Args:
        synced: wait until the disk has it, which takes milliseconds; for what can be made again
            in no time, or is checked when it is read, that is not needed.
    """
    temporary = path.with_name(f".{path.name}.{os.urandom(6).hex()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            if synced:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def content(path: Path) -> bytes:
    """A file's bytes.

    Raises:
        ValueError: what has this name is no file that can be read, such as a link to nowhere.
    """
    if not path.is_file():
        raise ValueError(f"no file to read: {path}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"no file to read, {error.strerror}: {path}") from None


def write_bytes(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


def write_text(path: Path, text: str) -> None:
    """UTF-8, lines ended as they are given."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(value, indent=1) + "\n")


def read_json(path: Path) -> dict[str, Any] | None:
    """The values of a file of ours; None where there is none.

    Raises:
        ValueError: a file that is no JSON, or not of named values.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"{type(values).__name__} in place of named values")
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it to run its cell again") from error
    return values
