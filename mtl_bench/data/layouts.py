"""Which data sets there are, and how their files lie; imports nothing heavy."""

import re
from pathlib import Path

CITYSCAPES, KITTI = "Cityscapes", "KITTI raw"
LAYOUTS = {  # by recipe.data.dataset; two names of each layout
    "synthetic": CITYSCAPES,
    "cityscapes": CITYSCAPES,
    "synthetic-kitti": KITTI,
    "kitti": KITTI,
}
BUILT_IN = ("synthetic", "synthetic-kitti")  # rendered on first use; others need --data
IMAGES = "leftImg8bit"
_DATE = re.compile(r"\d{4}_\d\d_\d\d")


def layout_of(root: Path) -> str | None:
    """CITYSCAPES, KITTI, or None: told by the names of the root's folders, whatever is in them."""
    if not root.is_dir():
        return None
    names = [path.name for path in root.iterdir()]
    if IMAGES in names:
        return CITYSCAPES
    return KITTI if any(map(is_date, names)) else None


def is_date(name: str) -> bool:
    """Whether a folder is called as KITTI's days of recording: 2011_09_26."""
    return bool(_DATE.fullmatch(name))
