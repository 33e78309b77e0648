"""Puts reports' tables and pictures into a README, each between two marker lines.

<!-- results:backbones -->
(replaced)
<!-- /results -->

`python -m mtl_bench.report.readme README.md reports` does it for every pair of markers.
"""

import os
import re
import sys
import tomllib
from pathlib import Path

from mtl_bench.bench.grid import GRIDS
from mtl_bench.report import FIGURES
from mtl_bench.report.layout import Layout

START = re.compile(r"<!-- results:(\S+) -->\n")


def names(readme: Path) -> list[str]:
    """The reports that a README asks for, in its order."""
    return START.findall(readme.read_text(encoding="utf-8"))


def filled(readme: Path, name: str, report_dir: Path) -> str:
    """The README's text with what belongs between `name`'s markers; nothing is written.

    Raises:
        ValueError: no such markers, or no report to take the table from.
    """
    table = report_dir / "readme.md"
    if not table.is_file():
        raise ValueError(f"no {table}: make the report first (mtl-bench report --grid {name})")
    before = readme.read_text(encoding="utf-8")
    start = f"<!-- results:{name} -->"
    pattern = re.compile(rf"({re.escape(start)}\n).*?(<!-- /results -->)", re.DOTALL)
    if not pattern.search(before):
        raise ValueError(f"{readme} has no line '{start}' with a line '<!-- /results -->' after it")
    where = Path(os.path.relpath(report_dir, readme.parent)).as_posix()
    pictures = [
        f"![{FIGURES[stem]}]({where}/{stem}.png)"
        for stem in _pictures(name)
        if (report_dir / f"{stem}.png").is_file()
    ]
    page = f"The whole report: [{where}/index.html]({where}/index.html)"
    content = "\n\n".join([table.read_text(encoding="utf-8").rstrip("\n"), *pictures, page])
    return pattern.sub(lambda match: f"{match[1]}\n{content}\n\n{match[2]}", before)


def update(readme: Path, name: str, report_dir: Path) -> bool:
    """Replace what stands between `name`'s markers; whether anything changed.

    Raises:
        ValueError: as `filled`.
    """
    before, after = readme.read_text(encoding="utf-8"), filled(readme, name, report_dir)
    readme.write_text(after, encoding="utf-8", newline="\n")
    return after != before


def _pictures(name: str) -> tuple[str, ...]:
    """What the report's grid shows in a README; the usual ones for a grid that is not shipped."""
    path = GRIDS / f"{name.removesuffix('-smoke')}.toml"
    values = tomllib.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return Layout.of(values.get("report", {})).readme


def _main(readme: Path, reports: Path) -> None:
    for name in names(readme):
        changed = update(readme, name, reports / name)
        print(f"{name}: {'updated' if changed else 'as it was'}")


if __name__ == "__main__":
    try:
        _main(Path(sys.argv[1]), Path(sys.argv[2]))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
