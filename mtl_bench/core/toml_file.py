"""A TOML file that remembers its text, so that a mistake in it is told with its line."""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Place = tuple[str, int]  # a table's name and which of that name; ("", 0) is the part before tables
HEADER = re.compile(r"\s*\[{1,2}\s*([A-Za-z_][\w.-]*)\s*\]{1,2}\s*(#.*)?")


@dataclass(frozen=True)
class TomlFile:
    """Values and text of a file; tomllib keeps no positions."""

    path: Path
    text: str
    values: Mapping[str, Any]

    def error(self, message: str, key: str, *places: Place) -> ValueError:
        """With the line of a key in the first of these tables that has it; else of the table."""
        name = re.escape(key)
        assignment = re.compile(rf"""\s*({name}\s*[.=]|["']{name}["']\s*=)""")
        found = [
            (places.index(place), number)
            for number, place, line in self._lines()
            if place in places and assignment.match(line)
        ]
        found += [
            (len(places) + places.index(place), number)
            for number, place, line in self._lines()
            if place in places and HEADER.fullmatch(line)
        ]
        where = f", line {min(found)[1]}" if found else ""
        return ValueError(f"{self.path}{where}: {message}")

    def refuse_sections_in(self, *names: str) -> None:
        """Tables of settings have no tables in them: dotted keys stand there as quoted names.

        Raises:
            ValueError: TOML has read an unquoted `a.b = 1` as a table `a`.
        """
        for name in names:
            tables = self.values.get(name, [])
            for index, table in enumerate(tables if isinstance(tables, list) else [tables]):
                for key, value in table.items():
                    if isinstance(value, dict) and "." not in key:
                        inner = next(iter(value), "...")
                        message = f'quote a key with dots: "{key}.{inner}" = ...'
                        raise self.error(message, key, (name, index))

    def _lines(self) -> Iterator[tuple[int, Place, str]]:
        counts: dict[str, int] = {}
        place = ("", 0)
        for number, line in enumerate(self.text.splitlines(), 1):
            if header := HEADER.fullmatch(line):
                counts[header[1]] = counts.get(header[1], -1) + 1
                place = (header[1], counts[header[1]])
            yield number, place, line


def read(path: Path) -> TomlFile:
    """A file's values.

    Raises:
        ValueError: not UTF-8, with or without its mark, or not TOML; with line and column.
    """
    content = path.read_bytes()
    try:
        text = content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(f"{path}, line {line}: not UTF-8; save it in that encoding") from None
    try:
        return TomlFile(path, text, tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: {error}") from error
