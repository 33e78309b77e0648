"""Two handwritten digits overlaid, as in MultiMNIST, from the 1797 that scikit-learn brings.

Source: UCI's "Optical recognition of handwritten digits" (Alpaydin and Kaynak, 1998), 8x8 pixels of
17 grey levels; overlaid as by Sener and Koltun (NeurIPS 2018): one up to the left, one down to the
right, of each pixel the brighter. Real data that need no download. Departure: none publishes a
split, so three fifths of the digits, drawn by the data's seed, make training pairs, and a fifth
each those of validation and test. No digit is in two splits.
"""

from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import DecodedFrame, Kind
from mtl_bench.core.labels import Label, LabelSet
from mtl_bench.core.plugins import lack
from mtl_bench.data._in_memory import InMemory

SHARES = (0.6, 0.8)  # of the digits: where training ends, and validation
FILE = "datasets/data/digits.csv.gz"  # in scikit-learn: 64 grey levels and a class a line
SIZE = 8  # pixels of a digit
SHIFT = 4  # pixels between the two, both ways


class Digits(InMemory):
    """Grey images of two digits each; what the left and the right one are, and how they look."""

    labels = LabelSet("digits", tuple(Label(str(d), d, False, (25 * d, 90, 90)) for d in range(10)))
    layout = "Digits that scikit-learn brings"
    predicts: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "classify": ("left", "right"),
        "reconstruct": ("left_picture", "right_picture"),
    }
    fields: ClassVar[Mapping[str, Kind]] = {
        **dict.fromkeys(predicts["classify"], Kind.VECTOR),
        **dict.fromkeys(predicts["reconstruct"], Kind.PICTURE),
    }

    def open_split(self) -> None:
        data, least = self.data, SIZE + SHIFT
        if min(data.height, data.width) < least:
            raise ValueError(
                f"recipe.data.height x width = {data.height}x{data.width}: two digits take "
                f"{least}x{least} pixels"
            )
        pictures_N88, classes_N = _bundled()
        place = self.split_index(self.split)
        count = (data.train_scenes, data.val_scenes, data.test_scenes)[place]
        order = np.random.default_rng([data.seed, 0]).permutation(len(pictures_N88))
        ends = [0, *(round(share * len(order)) for share in SHARES), len(order)]
        own = order[ends[place] : ends[place + 1]]
        pairs_N2 = np.random.default_rng([data.seed, 1, place]).choice(own, (count, 2))
        self.pictures_N2HW = np.zeros((len(pairs_N2), 2, data.height, data.width), np.uint8)
        top, left = (data.height - least) // 2, (data.width - least) // 2
        for side, shift in enumerate((0, SHIFT)):
            y, x = top + shift, left + shift
            self.pictures_N2HW[:, side, y : y + SIZE, x : x + SIZE] = pictures_N88[
                pairs_N2[:, side]
            ]
        self.classes_N2 = classes_N[pairs_N2]
        self.names = [f"{self.split}{number}" for number in range(len(pairs_N2))]

    def read(self, name: str) -> DecodedFrame:
        index = int(name.removeprefix(self.split))
        pictures_2HW = torch.from_numpy(self.pictures_N2HW[index])
        classes_2 = torch.from_numpy(self.classes_N2[index])
        fields = {
            **dict(zip(self.predicts["classify"], classes_2.split(1), strict=True)),
            **dict(zip(self.predicts["reconstruct"], pictures_2HW / 255, strict=True)),
        }
        return DecodedFrame(
            images_N3HW=[pictures_2HW.amax(0).expand(3, -1, -1)],
            fields={key: value for key, value in fields.items() if key in self.needs},
        )


@lru_cache(maxsize=1)
def _bundled() -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Pictures [1797,8,8] and classes [1797].

    Raises:
        ValueError: scikit-learn is not installed.
    """
    missing = lack(["sklearn"], ["mtl-bench[problems]"])
    if missing:
        raise ValueError(f"the data set of digits {missing}")
    package = find_spec("sklearn")  # its file alone: importing it takes longer than a cell's steps
    assert package is not None
    assert package.origin is not None
    table_N65 = np.loadtxt(Path(package.origin).parent / FILE, delimiter=",", dtype=np.int64)
    pictures_N88 = table_N65[:, :-1].reshape(-1, SIZE, SIZE)
    return (pictures_N88 * 255 / 16).round().astype(np.uint8), table_N65[:, -1]
