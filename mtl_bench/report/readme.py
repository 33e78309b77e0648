"""Puts a report's table and pictures into a README, between two marker lines.

<!-- results:backbones -->
(replaced)
<!-- /results -->
"""

import os
import re
from pathlib import Path

PICTURES = {
    "pq_fps": "Panoptic quality against frames per second",
    "rmse_fps": "Depth error against frames per second",
}


def update(readme: Path, name: str, report_dir: Path) -> bool:
    """Replace what stands between `name`'s markers; whether anything changed.

    Raises:
        ValueError: no such markers, or no report to take the table from.
    """
    table = report_dir / "table.md"
    if not table.is_file():
        raise ValueError(f"no {table}: make the report first (mtl-bench report --grid {name})")
    before = readme.read_text(encoding="utf-8")
    start = f"<!-- results:{name} -->"
    pattern = re.compile(rf"({re.escape(start)}\n).*?(<!-- /results -->)", re.DOTALL)
    if not pattern.search(before):
        raise ValueError(f"{readme} has no line '{start}' with a line '<!-- /results -->' after it")
    where = Path(os.path.relpath(report_dir, readme.parent)).as_posix()
    pictures = [
        f"![{alternative}]({where}/{stem}.png)"
        for stem, alternative in PICTURES.items()
        if (report_dir / f"{stem}.png").is_file()
    ]
    page = f"The whole report: [{where}/index.html]({where}/index.html)"
    parts = [table.read_text(encoding="utf-8").rstrip("\n"), *pictures, page]
    content = "\n\n".join(parts)
    after = pattern.sub(lambda match: f"{match[1]}\n{content}\n\n{match[2]}", before)
    readme.write_text(after, encoding="utf-8", newline="\n")
    return after != before
